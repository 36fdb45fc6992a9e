"""Marching cubes on the cells of a regular grid that a level set crosses, found by following it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.validation import check_points

# More nodes than this are refused: 13 bytes each.
MAX_NODES = 50_000_000
# A vertex both of whose nodes are farther than this from the cut, in cells, stays clear of it.
NEAR_CUT = 1.2
# Values nearer to zero than this share of their mean are moved away from it: no vertex then lies on a node.
LEAST_VALUE = 1e-6
# Offsets of the corners of a cell from its lower node, and of the cells around it and itself.
CORNERS = np.array(list(product((0, 1), repeat=3)))
AROUND = np.array(list(product((-1, 0, 1), repeat=3)))


@dataclass(frozen=True)
class Grid:
    """A regular grid of cubic cells.

    Attributes
    ----------
    origin : (3,) ndarray
        Position of node (0, 0, 0) [scene unit].
    spacing : float
        Edge of a cell [scene unit].
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
    ) -> Grid:
        """Grid around points, with ``resolution`` cells along their longest side.

        Parameters
        ----------
        points : (n, 3) array_like
        resolution : int
            At least 4.
        padding : int
            Cells added on each side, at least 1.
        axes : (3, 3) array_like, optional
            Rotation whose rows are the grid's axes; those of the world by default.

        Raises
        ------
        ValueError
            On no or coinciding points, numbers out of range, or too many nodes.
        """
        points = check_points(points)
        axes = np.eye(3) if axes is None else np.asarray(axes, dtype=np.float64)
        if axes.shape != (3, 3) or not np.abs(axes @ axes.T - np.eye(3)).max() < 1e-5:
            raise ValueError("axes must be a (3, 3) rotation")
        if int(resolution) < 4 or int(padding) < 1:
            raise ValueError(f"resolution must be >= 4 and padding >= 1, got {resolution} and {padding}")
        if len(points) == 0:
            raise ValueError("points must hold at least one point on the surface")
        along = points @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
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

    def positions(self, coordinates: Floats) -> Floats:
        """World positions (n, 3) of grid coordinates, in cells from the origin."""
        return coordinates @ (self.spacing * self.axes) + self.origin

    def cells(self, points: Floats) -> Integers:
        """Flat numbers (n,) of the cells that hold points; outside the grid its outermost cells."""
        where = np.floor((points - self.origin) @ self.axes.T / self.spacing)
        return np.clip(where, 0, np.array(self.shape) - 2).astype(np.int64) @ self.strides


class Band:
    """Values of a field, and of what cuts it, at the nodes of the cells that were visited.

    A cell has the flat number of its lower node.

    Parameters
    ----------
    grid : Grid
    field : Field
        Negative inside.
    cut : ClipDistance, optional

    Attributes
    ----------
    cells : (k,) ndarray of int
        Visited cells.
    """

    def __init__(self, grid: Grid, field: Field, cut: ClipDistance | None = None) -> None:
        self.grid, self.field, self.cut = grid, field, cut
        self.cells = np.zeros(0, dtype=np.int64)
        # Single precision, as marching cubes has it; its vertices are projected afterwards.
        self._f = np.full(int(np.prod(grid.shape)), np.nan, dtype=np.float32)
        self._c = np.full(len(self._f), np.inf, dtype=np.float32)
        # The last nodes along each axis are no cells: they keep the walk inside the grid.
        visited = np.ones(grid.shape, dtype=np.bool_)
        visited[:-1, :-1, :-1] = False
        self._visited = visited.ravel()
        self._corners = CORNERS @ grid.strides

    def visit(self, cells: Integers) -> Integers:
        """Evaluate the nodes of cells; those (k,) that were not visited before."""
        new = np.unique(cells)
        new = new[~self._visited[new]]
        self._visited[new] = True
        self.cells = np.concatenate([self.cells, new])
        nodes = np.unique(new[:, None] + self._corners)
        nodes = nodes[np.isnan(self._f[nodes])]
        if len(nodes):
            points = self.grid.positions(np.stack(np.unravel_index(nodes, self.grid.shape), 1))
            value = self.field(points)
            distance = np.full(len(nodes), np.inf) if self.cut is None else self.cut(points)
            bad = np.isnan(value) | np.isnan(distance)
            if bad.any():
                where = points[np.argmax(bad)]
                raise ValueError(
                    f"field or cut is NaN at {where}; check the fit (its condition) and the bone fields"
                )
            self._f[nodes], self._c[nodes] = value, distance
        return new

    def visit_all(self) -> None:
        """Visit every cell of the grid."""
        self.visit(np.flatnonzero(~self._visited))

    def widen(self) -> bool:
        """Visit all neighbours of the visited cells; whether there were any."""
        around = (self.cells[:, None] + AROUND @ self.grid.strides).ravel().astype(np.int64)
        return len(self.visit(around[(around >= 0) & (around < len(self._f))])) > 0

    def follow(self, level: float) -> None:
        """Visit the cells behind crossed faces until none is left."""
        front = self.cells
        while len(front):
            inside = self._values(front[:, None] + self._corners, level) < 0.0
            behind = []
            for axis, stride in enumerate(self.grid.strides):
                for side in (0, 1):
                    face = inside[:, CORNERS[:, axis] == side]
                    behind.append(front[face.any(axis=1) & ~face.all(axis=1)] + (2 * side - 1) * stride)
            front = self.visit(np.concatenate(behind))

    def _values(self, nodes: Integers, level: float) -> Floats:
        """The function whose zero set is sought, max(f - level, -c), at nodes."""
        return np.maximum(self._f[nodes] - np.float32(level), -self._c[nodes])

    def crosses(self, level: float) -> bool:
        """Whether the level set meets any visited cell."""
        value = self._values(np.flatnonzero(~np.isnan(self._f)), level)
        return bool((value < 0).any() and (value >= 0).any())

    def march(self, level: float) -> tuple[Floats, Integers, Booleans, Booleans]:
        """Closed triangles of the level set in the visited cells.

        Returns
        -------
        coordinates : (n, 3) ndarray
            Vertices in grid coordinates.
        triangles : (m, 3) ndarray
            Outward.
        is_open : (n,) ndarray of bool
            Vertices on the outermost cells, where the surface leaves the grid.
        near_cut : (n,) ndarray of bool
            Vertices that a shift by a cell may bring to the cut.
        """
        from skimage.measure import marching_cubes

        known = np.flatnonzero(~np.isnan(self._f))
        value = self._values(known, level)
        least = LEAST_VALUE * np.abs(value[np.isfinite(value)]).mean()
        volume = np.ones(len(self._f), dtype=np.float32)
        volume[known] = np.where(value < 0.0, np.minimum(value, -least), np.maximum(value, least))
        # scikit-image masks a cell by its upper node.
        mask = np.zeros(len(self._f), dtype=np.bool_)
        mask[self.cells + self._corners[-1]] = True
        shape = self.grid.shape
        vertices, faces, _, _ = marching_cubes(volume.reshape(shape), 0.0, mask=mask.reshape(shape))
        coordinates = np.ascontiguousarray(vertices, dtype=np.float64)
        is_open = np.any((coordinates <= 0.0) | (coordinates >= np.array(shape) - 1.0), axis=1)
        ends = (np.floor(coordinates), np.ceil(coordinates))
        clear = np.minimum(*(self._c[end.astype(np.int64) @ self.grid.strides] for end in ends))
        near_cut: Booleans = clear < NEAR_CUT * self.grid.spacing
        return coordinates, faces.astype(np.int64), is_open, near_cut
