"""A narrow band on a regular grid: only the cells that a level set crosses, found by following it.

The band starts in the cells that hold predicted surface points and grows through every cell face the surface
crosses, so it follows the surface wherever it went, and the field is evaluated at no node that is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.implicit.extraction.marching import (
    FACE_CORNERS,
    Made,
    Samples,
    _combined,
    _march_loop,
    marching_tables,
)
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_points

# More nodes than this are refused: 2 bytes of state and 8 of index each.
MAX_NODES = 50_000_000
# Where both nodes of a vertex's edge are farther than this from the cut, in cells, it stays clear of the cut.
NEAR_CUT = 1.2
# Corners of each face of a cell, a bit for each.
FACE_MASKS = (1 << FACE_CORNERS).sum(axis=1)


@dataclass(frozen=True)
class BandGrid:
    """A regular grid of cubic cells.

    Attributes
    ----------
    origin : (3,) ndarray
        Position of node (0, 0, 0) [scene unit].
    spacing : float
        Edge of a cell.
    shape : tuple of int
        Nodes along each axis.
    axes : (3, 3) ndarray
        Rows are the grid's unit axes in world coordinates.
    """

    origin: np.ndarray
    spacing: float
    shape: tuple[int, ...]
    axes: np.ndarray

    @classmethod
    def around(
        cls, points: ArrayLike, *, resolution: int = 48, padding: int = 3, axes: ArrayLike | None = None
    ) -> BandGrid:
        """Grid around points, with ``resolution`` cells along their longest side.

        Parameters
        ----------
        points : (n, 3) array_like
        resolution : int
            At least 4.
        padding : int
            Cells added on each side, at least 1.
        axes : (3, 3) array_like, optional
            Rotation whose rows are the grid's axes; in a frame that moves with the scene the mesh does too.

        Raises
        ------
        ValueError
            On no or coinciding points, numbers out of range, or too many nodes.
        """
        points = check_points(points)
        axes = np.eye(3) if axes is None else np.ascontiguousarray(axes, dtype=np.float64)
        if axes.shape != (3, 3) or not np.abs(axes @ axes.T - np.eye(3)).max() < 1e-5:
            raise ValueError("axes must be a (3, 3) rotation")
        if int(resolution) < 4 or int(padding) < 1:
            raise ValueError(f"resolution must be >= 4 and padding >= 1, got {resolution} and {padding}")
        if len(points) == 0:
            raise ValueError("points must hold at least one point on the surface")
        low, high = box_along(points, axes)
        spacing = float((high - low).max()) / int(resolution)
        if not spacing > 0:
            raise ValueError("points must not all coincide: the grid's size is taken from them")
        cells = np.maximum(np.ceil((high - low) / spacing - 1e-9).astype(int), 1) + 2 * int(padding)
        if np.prod(cells + 1.0) > MAX_NODES:
            raise ValueError(f"a grid of {cells} cells is too large; lower the resolution")
        corner = 0.5 * (low + high) - 0.5 * spacing * cells
        return cls(corner @ axes, spacing, tuple(int(n) + 1 for n in cells), axes)

    @property
    def strides(self) -> Integers:
        """Step in flat node number along each axis."""
        return np.array([self.shape[1] * self.shape[2], self.shape[2], 1])

    def coordinates(self, points: Floats) -> Floats:
        """Positions in cells from the origin, (n, 3)."""
        return (points - self.origin) @ self.axes.T / self.spacing

    def positions(self, coordinates: Floats) -> Floats:
        """World positions of grid coordinates, the inverse of `coordinates`."""
        return coordinates @ (self.spacing * self.axes) + self.origin

    def nodes(self, flat: Integers) -> Floats:
        """World positions of flat node numbers."""
        out = np.empty((len(flat), 3))
        _nodes_loop(flat, self.strides, self.origin, self.spacing * self.axes, out)
        return out

    def cells(self, points: Floats) -> Integers:
        """Flat numbers of the cells that hold points; outside the grid its outermost cells."""
        out, last = np.empty(len(points), dtype=np.int64), np.array(self.shape) - 2
        _cells_loop(points, self.origin, self.axes / self.spacing, last, self.strides, out)
        return out


class Band:
    """Values of a field, and of what cuts it, at the nodes of the cells that were visited.

    Parameters
    ----------
    grid : BandGrid
    field, cut : callable
        ``(n, 3) -> (n,)``; ``cut`` may be None.
    """

    def __init__(self, grid: BandGrid, field: Field, cut: ClipDistance | None = None) -> None:
        total = int(np.prod(grid.shape))
        self.grid, self.field, self.cut = grid, field, cut
        self.index = np.full(total, -1, dtype=np.int32)
        self.state = np.zeros(total, dtype=np.uint8)
        # Never touched beyond the counts below, so only these pages take memory.
        self._flat = np.empty(total, dtype=np.int64)
        self._f, self._c = np.empty(total), np.empty(total)
        self._cells = np.empty(total, dtype=np.int64)
        self.node_count, self.cell_count = 0, 0
        _close_border_loop(self.state, *grid.shape)

    @property
    def _samples(self) -> Samples:
        return Samples(self.grid.strides, self.index, self._f, self._c)

    @property
    def cells(self) -> Integers:
        """Flat numbers of the visited cells."""
        return self._cells[: self.cell_count]

    def seed(self, points: Floats) -> None:
        """Visit the cells that hold points."""
        self._visit(np.unique(self.grid.cells(points)))

    def visit_all(self) -> None:
        """Visit every cell of the grid."""
        self._visit(np.flatnonzero(self.state == 0))

    def _visit(self, cells: Integers) -> None:
        cells = cells[self.state[cells] == 0]
        self.state[cells] = 1
        self._cells[self.cell_count : self.cell_count + len(cells)] = cells
        self.cell_count += len(cells)

    def grow(self, level: float) -> None:
        """Evaluate new nodes, and follow the level set into new cells until none is left."""
        swept = 0
        while swept < self.cell_count:
            self._evaluate(swept)
            begin, swept = swept, self.cell_count
            self.cell_count = _follow_loop(
                self._cells, begin, swept, self._samples, level, FACE_MASKS, self.state
            )

    def widen(self) -> bool:
        """Visit all neighbours of the visited cells; whether there were any."""
        before = self.cell_count
        self.cell_count = _widen_loop(self._cells, before, self.grid.strides, self.state)
        return self.cell_count > before

    def _evaluate(self, begin: int) -> None:
        first = self.node_count
        self.node_count = _add_nodes_loop(
            self._cells, begin, self.cell_count, self.grid.strides, self.index, self._flat, first
        )
        new = slice(first, self.node_count)
        if self.node_count == first:
            return
        points = self.grid.nodes(self._flat[new])
        self._f[new] = self.field(points)
        self._c[new] = np.inf if self.cut is None else self.cut(points)
        bad = np.isnan(self._f[new]) | np.isnan(self._c[new])
        if bad.any():
            where = points[np.argmax(bad)]
            raise ValueError(
                f"field or cut is NaN at {where}; check the fit (its condition) and the bone fields"
            )

    def crosses(self, level: float) -> bool:
        """Whether the level set meets any visited cell."""
        combined = np.maximum(self._f[: self.node_count] - level, -self._c[: self.node_count])
        return bool((combined < 0).any() and (combined >= 0).any())

    def march(self, level: float) -> tuple[Floats, Integers, Booleans, Booleans]:
        """Closed triangles of the level set in the visited cells.

        Returns
        -------
        coordinates : (n, 3) ndarray
            Vertices in grid coordinates.
        triangles : (m, 3) ndarray
        is_open : (n,) ndarray of bool
            Vertices on the outermost cells, where the surface leaves the grid.
        near_cut : (n,) ndarray of bool
            Vertices that a shift by a cell may bring to the cut.
        """
        count = self.cell_count
        made = Made(
            np.full((self.node_count, 3), -1, dtype=np.int32),
            np.empty(4 * self.node_count + 4, dtype=np.int64),
            np.empty((4 * self.node_count + 4, 3)),
            np.empty((12 * count + 12, 3), dtype=np.int64),
        )
        n_vertices, n_triangles = _march_loop(self.cells, self._samples, level, marching_tables(), made)
        coordinates = made.shift[:n_vertices]
        is_open, near_cut = np.empty(n_vertices, dtype=np.bool_), np.empty(n_vertices, dtype=np.bool_)
        shape, near = np.array(self.grid.shape), NEAR_CUT * self.grid.spacing
        _place_loop(made.node, shape, self._samples, near, coordinates, is_open, near_cut)
        return coordinates, made.triangles[:n_triangles], is_open, near_cut


def box_along(points: Floats, axes: Floats) -> Floats:
    """Least and greatest coordinates (2, 3) of points along the rows of ``axes``."""
    out = np.array([[np.inf] * 3, [-np.inf] * 3])
    _box_loop(points, axes, out)
    return out


@compiled(error_model="numpy")
def _box_loop(points, axes, out):
    for n in range(len(points)):
        for a in range(3):
            u = points[n, 0] * axes[a, 0] + points[n, 1] * axes[a, 1] + points[n, 2] * axes[a, 2]
            out[0, a] = min(out[0, a], u)
            out[1, a] = max(out[1, a], u)


@compiled(error_model="numpy")
def _cells_loop(points, origin, turn, last, strides, out):
    """Flat numbers of the cells that hold points, outside the grid of its outermost cells."""
    for n in range(len(points)):
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        out[n] = 0
        for a in range(3):
            u = np.floor(x * turn[a, 0] + y * turn[a, 1] + z * turn[a, 2])
            out[n] += int(min(max(u, 0.0), float(last[a]))) * strides[a]


@compiled(error_model="numpy")
def _nodes_loop(flat, strides, origin, edges, out):
    """World positions of nodes; ``edges`` are the edges of a cell along the grid's axes."""
    for n in range(len(flat)):
        i, j, k = flat[n] // strides[0], flat[n] % strides[0] // strides[1], flat[n] % strides[1]
        for a in range(3):
            out[n, a] = i * edges[0, a] + j * edges[1, a] + k * edges[2, a] + origin[a]


@compiled(error_model="numpy")
def _place_loop(node, shape, samples, near, coordinates, is_open, near_cut):
    """Turn shifts from the nodes into grid coordinates; mark vertices on the border and near the cut."""
    strides, index, _, c = samples
    for v in range(len(coordinates)):
        flat = node[v]
        other, axes = flat, 0
        for a in range(3):
            if coordinates[v, a] > 0.0:
                other += strides[a]
                axes += 1
        near_cut[v] = axes > 1 or min(c[index[flat]], c[index[other]]) < near
        coordinates[v, 0] += flat // strides[0]
        coordinates[v, 1] += flat % strides[0] // strides[1]
        coordinates[v, 2] += flat % strides[1]
        is_open[v] = False
        for a in range(3):
            is_open[v] |= coordinates[v, a] < 1e-9 or coordinates[v, a] > shape[a] - 1 - 1e-9


@compiled(error_model="numpy")
def _close_border_loop(state, nx, ny, nz):
    """Mark the node numbers that are no cells (the last of each row), so that no loop enters them."""
    for i in range(nx):
        for j in range(ny):
            state[(i * ny + j) * nz + nz - 1] = 2
            if i == nx - 1 or j == ny - 1:
                for k in range(nz):
                    state[(i * ny + j) * nz + k] = 2


@compiled(error_model="numpy")
def _add_nodes_loop(cells, begin, end, strides, index, flat, count):
    """Number the corners of cells that have no number yet; returns the new count of nodes."""
    for n in range(begin, end):
        for q in range(8):
            node = cells[n] + (q & 1) * strides[0] + (q >> 1 & 1) * strides[1] + (q >> 2) * strides[2]
            if index[node] < 0:
                index[node] = count
                flat[count] = node
                count += 1
    return count


@compiled(error_model="numpy")
def _follow_loop(cells, begin, end, samples, level, masks, state):
    """Append the cells behind crossed faces; returns the new count of cells.

    A state of 2 beyond the first or last row keeps the walk inside the grid: rows are closed by non-cells.
    """
    strides, index, f, c = samples
    count = end
    for n in range(begin, end):
        inside = 0
        for q in range(8):
            node = index[cells[n] + (q & 1) * strides[0] + (q >> 1 & 1) * strides[1] + (q >> 2) * strides[2]]
            if _combined(f[node], c[node], level) < 0:
                inside |= 1 << q
        if inside == 0 or inside == 255:
            continue
        for k in range(6):
            signs = inside & masks[k]
            if signs == 0 or signs == masks[k]:
                continue
            near = cells[n] + (strides[k // 2] if k % 2 else -strides[k // 2])
            if 0 <= near < len(state) and state[near] == 0:
                state[near] = 1
                cells[count] = near
                count += 1
    return count


@compiled(error_model="numpy")
def _widen_loop(cells, end, strides, state):
    """Append all unvisited neighbours of the cells; returns the new count of cells."""
    count = end
    for n in range(end):
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    near = cells[n] + i * strides[0] + j * strides[1] + k * strides[2]
                    if 0 <= near < len(state) and state[near] == 0:
                        state[near] = 1
                        cells[count] = near
                        count += 1
    return count
