"""A lattice through a muscle's volume: shape functions, quadrature of the material in each cell,
regions.

The lattice belongs to the muscle's shape alone, not to its centres, so what is integrated over it
resists alike however many centres there are. Where material is, the signed distance to the rest
mesh tells.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance

FINE = 6  # points along a side of a cell that tell how much of it is muscle
GROUPS = 8  # quadrature points in a cell
LEAST_FILLED = 1e-3  # of a cell: the weight of one that only touches the surface
# Quadrature points move apart at most by this factor to give the material's second moments.
MOST_WIDENED = 1.3
# Points that find the cells which the surface crosses: so far apart, of a cell's least side.
DENSITY = 0.25
LEAST_REGION = 0.3  # of the mean volume of the regions


@dataclass(frozen=True)
class Embedding:
    """Shape functions at n points: 27 nodes of each, their values, their gradients (n, 27, 3) by
    rest coordinates.
    """

    indices: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray


class Lattice:
    """Cells of a box along a mesh's principal axes that hold some of its volume, and their nodes.

    Of vertices (n, 3) and faces (m, 3) of the rest mesh; ``nodes`` says about how many are wanted.
    Shape functions are quadratic B-splines along each axis, which reproduce linear functions from
    the nodes at rest, ``rest`` (N, 3). ``points`` (Q, 3) and ``weights`` (Q,) [volume of the mesh's
    unit] are the quadrature of the material, ``cell`` (Q,) the cell of each point; ``spacing`` (3,)
    holds the sides of a cell.
    """

    def __init__(self, vertices: Floats, faces: Integers, nodes: int) -> None:
        self.axes = _axes(vertices)
        box = vertices @ self.axes.T
        self.low, self.extent = box.min(axis=0), np.ptp(box, axis=0)
        self.distance = ExactDistance(vertices, faces).signed_distance
        key, triangles = content_key(vertices, faces, ("cells", nodes)), box[np.asarray(faces)]
        kept = load_arrays(key)
        count = self._choose_cells(triangles, nodes) if kept is None else kept["count"]
        if kept is None:
            store_arrays(key, {"count": count})
        self._lay_cells(triangles, count)
        self._number_nodes()
        self._integrate()

    def _choose_cells(self, triangles: Floats, wanted: float) -> Integers:
        """The fewest cells (3,) that give the wanted nodes, by bisection; ``triangles`` (m, 3,
        3).
        """
        small, large = 0.01 * self.extent.max(), self.extent.max()
        nodes: dict[tuple[int, ...], int] = {}  # by the number of cells along each axis
        for _ in range(25):  # a choice: sides to a millionth, which are whole numbers of cells
            side = np.sqrt(small * large)
            count = self._count_cells(side)
            if tuple(count) not in nodes:
                self._lay_cells(triangles, count)
                self._number_nodes()
                nodes[tuple(count)] = len(self.rest)
            small, large = (small, side) if nodes[tuple(count)] < wanted else (side, large)
        return self._count_cells(large)

    def _count_cells(self, side: float) -> Integers:
        """How many cells (3,) of at most this side lie along each axis."""
        return np.maximum(1, np.ceil(self.extent / side - 1e-9).astype(int))

    def _lay_cells(self, triangles: Floats, count: Integers) -> None:
        self.count = count
        self.spacing = self.extent / self.count
        every = np.indices(tuple(count)).reshape(3, -1).T
        middle = self.low + (every + 0.5) * self.spacing
        depth = self.distance(middle @ self.axes)
        half = 0.5 * float(np.linalg.norm(self.spacing))
        used = depth < 0.0
        # In units of the cells' sides, so that a thin sheet takes no more points than a thick one.
        surface = _points_on((triangles - self.low) / self.spacing, DENSITY)
        touched = self._key(np.clip(surface.astype(int), 0, self.count - 1))
        used[np.unique(touched)] = True
        self.full = (depth < -half)[used]
        self.cells = every[used]

    def _key(self, cells: Integers) -> Integers:
        return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(self.count)))

    def _number_nodes(self) -> None:
        corner = self.cells[:, None, :] + np.indices((3, 3, 3)).reshape(3, -1).T
        flat = np.ravel_multi_index(np.moveaxis(corner, -1, 0), self.count + 2)
        known, self.nodes = np.unique(flat, return_inverse=True)
        self.nodes = self.nodes.reshape(flat.shape).astype(np.int64)
        self.place = np.stack(np.unravel_index(known, self.count + 2), 1)
        self.rest = (self.low + (self.place - 0.5) * self.spacing) @ self.axes
        self.tree = cKDTree(self.cells + 0.5)

    def embed(self, points: Floats) -> Embedding:
        """Shape functions at points; beyond the cells, those of the nearest cell."""
        local = (points @ self.axes.T - self.low) / self.spacing
        key = np.full(int(np.prod(self.count)), -1)
        key[self._key(self.cells)] = np.arange(len(self.cells))
        cell = key[self._key(np.clip(local.astype(int), 0, self.count - 1))]
        lost = cell < 0
        if lost.any():
            cell[lost] = self.tree.query(local[lost])[1]
        return self._at(cell, local - self.cells[cell])

    def _at(self, cell: Integers, s: Floats) -> Embedding:
        value, slope = _basis(s)
        weights = np.einsum("na,nb,nc->nabc", value[:, 0], value[:, 1], value[:, 2])
        parts = [
            np.einsum(
                "na,nb,nc->nabc", *(slope[:, k] if k == axis else value[:, k] for k in range(3))
            )
            / self.spacing[axis]
            for axis in range(3)
        ]
        count = len(s)
        slopes = np.stack(parts, -1).reshape(count, -1, 3) @ self.axes
        return Embedding(
            np.ascontiguousarray(self.nodes[cell]),
            np.ascontiguousarray(weights.reshape(count, -1)),
            np.ascontiguousarray(slopes),
        )

    def _integrate(self) -> None:
        """Eight points a cell with the volume, the middle and the spread of the material in it."""
        fine = (np.indices((FINE, FINE, FINE)).reshape(3, -1).T + 0.5) / FINE
        # Those of a full cell are Gauss's.
        whole = _split(fine)
        points = []
        weights = []
        cells = []
        local = []
        mixed = np.flatnonzero(~self.full)
        where = self.low + (self.cells[mixed][:, None, :] + fine) * self.spacing
        inside = self.distance(where.reshape(-1, 3) @ self.axes).reshape(len(mixed), -1) < 0.0
        found = dict(zip(mixed, inside, strict=True))
        volume = float(np.prod(self.spacing))
        for c in range(len(self.cells)):
            share, filled = whole, 1.0
            if c in found:
                filled = float(found[c].mean())
                if filled * len(fine) >= GROUPS:
                    share = _split(fine[found[c]])
                filled = max(filled, LEAST_FILLED)
            spots, sizes = share
            local.append(spots)
            weights.append(sizes * filled * volume)
            cells.append(np.full(len(spots), c))
            points.append((self.low + (self.cells[c] + spots) * self.spacing) @ self.axes)
        self.points, self.weights = np.concatenate(points), np.concatenate(weights)
        self.cell = np.concatenate(cells)
        self.quadrature = self._at(self.cell, np.concatenate(local))

    def regions(self, count: int) -> Integers:
        """Region of each cell, halved by volume until there are ``count`` regions.

        A group of which no part is large enough stays whole: the pressure of a sliver would grow
        without bounds.
        """
        volume = np.bincount(self.cell, self.weights, minlength=len(self.cells))
        least = LEAST_REGION * volume.sum() / count
        open_groups = [np.arange(len(self.cells))]
        whole: list[Integers] = []
        while open_groups and len(open_groups) + len(whole) < count:
            group = open_groups.pop(int(np.argmax([volume[g].sum() for g in open_groups])))
            middle = self.cells[group] * self.spacing
            axis = int(np.argmax(np.ptp(middle, axis=0)))
            order = group[np.argsort(middle[:, axis], kind="stable")]
            below = np.cumsum(volume[order])[:-1]
            smaller = np.minimum(below, volume[group].sum() - below)
            if smaller.max(initial=0.0) < least:
                whole.append(group)
                continue
            cut = int(np.argmax(smaller)) + 1
            open_groups += [order[:cut], order[cut:]]
        out = np.empty(len(self.cells), dtype=np.int64)
        for k, group in enumerate(whole + open_groups):
            out[group] = k
        return out

    def second_differences(self) -> Floats:
        """Σ over axes of the squared second differences of the nodes along them, (N, N), zero for
        every linear map.

        It carries nodes whose support holds hardly any material along with their neighbours.
        """
        known = {tuple(p): k for k, p in enumerate(self.place)}
        out = np.zeros((len(self.rest), len(self.rest)))
        stencil = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
        for place, k in known.items():
            for axis in range(3):
                step = np.eye(3, dtype=int)[axis]
                before, after = known.get(tuple(place - step)), known.get(tuple(place + step))
                if before is not None and after is not None:
                    row = [before, k, after]
                    out[np.ix_(row, row)] += stencil
        return out


def _points_on(triangles: Floats, apart: float) -> Floats:
    """Corners and middles of triangles (m, 3, 3), and points on the large ones, ``apart`` at
    most.
    """
    sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(sides / apart).astype(int)
    found = [triangles.reshape(-1, 3), triangles.mean(axis=1)]
    # Of smaller ones corners and middles are near enough to each other.
    for count in np.unique(parts[parts > 2]):
        a, b = np.indices((count + 1, count + 1)).reshape(2, -1) / count
        shares = np.stack([a, b, 1.0 - a - b], axis=1)[a + b <= 1.0 + 1e-12]
        found.append((shares @ triangles[parts == count]).reshape(-1, 3))
    return np.concatenate(found)


def _axes(points: Floats) -> Floats:
    """Right-handed principal axes as rows, signs by the points' skewness; the identity where they
    are not clear.
    """
    offset = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(offset, full_matrices=False)
    if np.diff(sizes).max() > -0.02 * sizes[0]:
        return np.eye(3)
    skew = ((offset @ axes.T) ** 3).sum(axis=0)
    axes = axes * np.where(skew < 0.0, -1.0, 1.0)[:, None]
    axes[2] *= np.sign(np.linalg.det(axes))
    return axes


def _basis(s: Floats) -> tuple[Floats, Floats]:
    """Values and slopes (n, 3, 3) of the uniform quadratic B-splines of a cell at s in [0, 1]^3."""
    value = np.stack([0.5 * (1 - s) ** 2, 0.5 + s - s**2, 0.5 * s**2], -1)
    return value, np.stack([s - 1, 1 - 2 * s, s], -1)


def _split(points: Floats) -> tuple[Floats, Floats]:
    """Eight points with the middle and the spread of many: halved along each axis, then moved
    apart.
    """
    groups = [points]
    for axis in range(3):
        halves = []
        for group in groups:
            order = group[np.argsort(group[:, axis], kind="stable")]
            cut = (len(order) + 1) // 2
            halves += [order[:cut], order[cut:]]
        groups = halves
    groups = [group for group in groups if len(group)]
    size = np.array([len(group) for group in groups], dtype=float)
    size /= size.sum()
    spots = np.array([group.mean(axis=0) for group in groups])
    middle = size @ spots
    # A midpoint stands for a uniform piece of the cell's fine grid.
    spread = points.var(axis=0) + 1.0 / (12.0 * FINE**2)
    between = size @ (spots - middle) ** 2
    widen = np.minimum(np.sqrt(spread / np.maximum(between, 1e-12)), MOST_WIDENED)
    return middle + (spots - middle) * widen, size
