"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is
inside it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled

# A chord is never farther from its surface than this share of a cell. As vertices move while points
# are pushed off, points are looked for so far above and below triangles, and so far beside them in
# barycentric coordinates.
CHORD = 0.35
MARGIN = 0.4
BESIDE = 0.15
# Points deeper than the tolerance by less than this share are there but for rounding.
ASKED = 1.0 + 1e-6
# Room for pairs of a point and a triangle near it, at first, for each triangle.
PAIRS = 2
# Cells of a grid for each point; passes over the points that are pushed off.
CELLS, ROUNDS = 5, 4


class PointGrid(NamedTuple):
    """Points (k, 3), sorted by the cells of a grid: some times as many as points, as a surface
    leaves most empty.

    ``points`` are those given, cell by cell, ``start`` (c + 1,) the first of each cell; ``low``
    (3,), ``edge`` and ``shape`` (3,) are corner, edge length and number of cells, ``number`` (k,)
    the place of each point among those given.
    """

    points: np.ndarray
    start: np.ndarray
    low: np.ndarray
    edge: float
    shape: np.ndarray
    number: np.ndarray

    @classmethod
    def of(cls, points: Floats) -> "PointGrid":
        """The grid of some points."""
        low = points.min(axis=0) if len(points) else np.zeros(3)
        extent = points.max(axis=0) - low if len(points) else np.zeros(3)
        size = float(extent.max()) or 1.0
        sides = np.maximum(extent / size, 1e-2)
        edge = size * float(sides.prod() / (CELLS * max(len(points), 1))) ** (1.0 / 3.0)
        shape = (extent / edge).astype(np.int64) + 1
        cell = ((points - low) / edge).astype(np.int64) @ [shape[1] * shape[2], shape[2], 1]
        order = np.argsort(cell, kind="stable")
        start = np.searchsorted(cell[order], np.arange(int(shape.prod()) + 1))
        return cls(np.ascontiguousarray(points[order]), start, low, edge, shape, order)


class PointGrids(NamedTuple):
    """Several `PointGrid`, one behind the other; ``first`` (b + 1, 2) says where the points and the
    starts of each begin.
    """

    points: np.ndarray
    start: np.ndarray
    low: np.ndarray  # (b, 3)
    edge: np.ndarray  # (b,)
    shape: np.ndarray  # (b, 3)
    number: np.ndarray
    first: np.ndarray


def stack_grids(grids: Sequence[PointGrid]) -> PointGrids:
    """Grids as one set of arrays."""
    sizes = np.array([[len(grid.points), len(grid.start)] for grid in grids]).reshape(-1, 2)
    first = np.vstack([np.zeros((1, 2), np.int64), np.cumsum(sizes, axis=0)])
    return PointGrids(
        np.concatenate([np.zeros((0, 3)), *(grid.points for grid in grids)]),
        np.concatenate([np.zeros(0, np.int64), *(grid.start for grid in grids)]),
        np.array([grid.low for grid in grids]).reshape(-1, 3),
        np.array([grid.edge for grid in grids], dtype=np.float64),
        np.array([grid.shape for grid in grids], dtype=np.int64).reshape(-1, 3),
        np.concatenate([np.zeros(0, np.int64), *(grid.number for grid in grids)]),
        first.astype(np.int64),
    )


@compiled
def grid_of(grids, b):
    """Grid b: views into the arrays of all."""
    low, high = grids.first[b], grids.first[b + 1]
    return PointGrid(
        grids.points[low[0] : high[0]],
        grids.start[low[1] : high[1]],
        grids.low[b],
        grids.edge[b],
        grids.shape[b],
        grids.number[low[0] : high[0]],
    )


# Points with their pose (4, 4) to the world.
Obstacles = list[tuple[PointGrid, Floats]]


@compiled
def push_off_loop(vertices, faces, grid, pose, tolerance, moved):
    """Move the vertices (n, 3) of triangles (m, 3) that obstacle points have come through, into the
    surface, and mark them.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` [scene unit] moves its
    three corners along the normal, by barycentric weights, until it is not. Points deeper than
    ``CHORD`` of the length of the triangle's edges are left alone: they are behind another part of
    the muscle.
    """
    local, known = np.empty_like(vertices), np.zeros(len(vertices), np.bool_)
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            if known[v]:
                continue
            known[v] = True
            for a in range(3):
                local[v, a] = 0.0
                for b in range(3):
                    local[v, a] += (vertices[v, b] - pose[b, 3]) * pose[b, a]
    room = PAIRS * len(faces)
    pairs = np.empty((2, room), np.int64)
    met = _near_loop(local, faces, grid, pairs)
    if met > room:
        pairs = np.empty((2, met), np.int64)
        met = _near_loop(local, faces, grid, pairs)
    if met == 0:
        return
    point, first, near = _sort_loop(pairs[:, :met], grid.number, len(faces))
    places = np.empty((len(point), 3))
    for p in range(len(point)):
        for a in range(3):
            places[p, a] = pose[a, 3]
            for b in range(3):
                places[p, a] += pose[a, b] * grid.points[point[p], b]
    for _ in range(ROUNDS):
        if not _push_loop(vertices, faces, (places, first, near), tolerance, moved):
            break


@compiled
def _sort_loop(pairs, number, faces):
    """Points that triangles are near, and the triangles of point k: ``near[first[k] : first[k +
    1]]``.

    In the order of the points' ``number``, so that a scene that is turned is drawn alike.
    """
    met = pairs.shape[1]
    key = np.empty(met, np.int64)
    for m in range(met):
        key[m] = number[pairs[0, m]] * faces + pairs[1, m]
    point = np.empty(met, np.int64)
    first = np.empty(met + 1, np.int64)
    near = np.empty(met, np.int64)
    used = 0
    for place, m in enumerate(np.argsort(key)):
        if used == 0 or point[used - 1] != pairs[0, m]:
            point[used] = pairs[0, m]
            first[used] = place
            used += 1
        near[place] = pairs[1, m]
    first[used] = met
    return point[:used], first[: used + 1], near


@compiled(inline="always")
def _length(vertices, faces, f):
    """Length of the longest edge of a triangle."""
    square = 0.0
    for k in range(3):
        one, other = faces[f, k], faces[f, (k + 1) % 3]
        side = 0.0
        for a in range(3):
            side += (vertices[one, a] - vertices[other, a]) ** 2
        square = max(square, side)
    return np.sqrt(square)


@compiled
def _near_loop(vertices, faces, grid, pairs):
    """Pairs of a point and a triangle near it; how many there are, also beyond the room for
    them.
    """
    points, start, low, edge, shape, _ = grid
    least, most = np.empty(3), np.empty(3)
    begin = np.empty(3, np.int64)
    end = np.empty(3, np.int64)
    met = 0
    for f in range(len(faces)):
        margin = MARGIN * _length(vertices, faces, f)
        if not _box_of(vertices, faces, f, margin, grid, least, most):
            continue
        for a in range(3):
            begin[a] = np.int64(max(np.floor((least[a] - low[a]) / edge), 0.0))
            end[a] = min(np.int64(np.floor((most[a] - low[a]) / edge)), shape[a] - 1)
        plane = _plane(vertices, faces, f)
        square = _square(plane)
        for i in range(begin[0], end[0] + 1):
            for j in range(begin[1], end[1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(start[row + begin[2]], start[row + end[2] + 1]):
                    if _is_near(plane, square, margin, points[p], least, most):
                        if met < pairs.shape[1]:
                            pairs[0, met], pairs[1, met] = p, f
                        met += 1
    return met


@compiled(inline="always")
def _box_of(vertices, faces, f, margin, grid, least, most):
    """Fill the corners (3,) of a triangle's box, larger by a margin; False where it is outside of
    the grid.
    """
    inside = True
    for a in range(3):
        x = vertices[faces[f, 0], a]
        y = vertices[faces[f, 1], a]
        z = vertices[faces[f, 2], a]
        least[a], most[a] = min(x, y, z) - margin, max(x, y, z) + margin
        inside &= most[a] >= grid[2][a] and least[a] <= grid[2][a] + grid[3] * grid[4][a]
    return inside


@compiled(inline="always")
def _is_near(plane, square, margin, point, least, most):
    """Whether a point is within a margin of a triangle: of its plane, not beside it, in its box."""
    x = point[0]
    y = point[1]
    z = point[2]
    height = _height(plane, x, y, z)
    at_b, at_c = _areas(plane, x, y, z)
    over = height * height <= margin * margin * square
    over = over and min(at_b, at_c, square - at_b - at_c) >= -BESIDE * square
    return over and (
        (least[0] <= x)
        & (x <= most[0])
        & (least[1] <= y)
        & (y <= most[1])
        & (least[2] <= z)
        & (z <= most[2])
    )


@compiled
def _push_loop(vertices, faces, near_points, tolerance, moved):
    """One pass over the points; returns whether any had to be pushed off."""
    points, first, near = near_points
    pushed = False
    for p in range(len(points)):
        best, depth = _triangle_over(vertices, faces, points[p], near[first[p] : first[p + 1]])
        if best < 0 or depth <= ASKED * tolerance or depth > CHORD * _length(vertices, faces, best):
            continue
        pushed = True
        plane = _plane(vertices, faces, best)
        square = _square(plane)
        at_b, at_c = _areas(plane, points[p, 0], points[p, 1], points[p, 2])
        (nx, ny, nz) = plane[3]
        weight = 1.0 - (at_b + at_c) / square, at_b / square, at_c / square
        # The tolerance is left: what is a little deeper does not leap.
        way = (depth - tolerance) / (weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2)
        way /= np.sqrt(square)
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            vertices[v, 0] -= nx * way * weight[k]
            vertices[v, 1] -= ny * way * weight[k]
            vertices[v, 2] -= nz * way * weight[k]
    return pushed


@compiled(inline="always")
def _triangle_over(vertices, faces, point, near):
    """Of the triangles ``near`` a point the one whose plane is nearest, of those that it is not
    beside, -1 for none, and the point's depth below that.
    """
    x = point[0]
    y = point[1]
    z = point[2]
    best = -1
    least = np.inf
    signed = 0.0
    for f in near:
        plane = _plane(vertices, faces, f)
        square, (at_b, at_c) = _square(plane), _areas(plane, x, y, z)
        if square == 0.0 or min(at_b, at_c, square - at_b - at_c) < -1e-9 * square:
            continue  # beside it
        depth = -_height(plane, x, y, z) / np.sqrt(square)
        # Of triangles that are equally near, but for rounding, the first.
        if abs(depth) < least * (1.0 - 1e-6):
            best = f
            least = abs(depth)
            signed = depth
    return best, signed


@compiled(inline="always")
def _plane(vertices, faces, f):
    """Corner A of a triangle, its sides to B and C, and its normal, as long as twice its area."""
    a = faces[f, 0]
    b = faces[f, 1]
    c = faces[f, 2]
    ax = vertices[a, 0]
    ay = vertices[a, 1]
    az = vertices[a, 2]
    ux = vertices[b, 0] - ax
    uy = vertices[b, 1] - ay
    uz = vertices[b, 2] - az
    vx = vertices[c, 0] - ax
    vy = vertices[c, 1] - ay
    vz = vertices[c, 2] - az
    return (
        (ax, ay, az),
        (ux, uy, uz),
        (vx, vy, vz),
        (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx),
    )


@compiled(inline="always")
def _square(plane):
    """Square of the normal's length."""
    nx, ny, nz = plane[3]
    return nx * nx + ny * ny + nz * nz


@compiled(inline="always")
def _height(plane, x, y, z):
    """Height of a point above a triangle, times the normal's length."""
    (ax, ay, az), (nx, ny, nz) = plane[0], plane[3]
    return nx * (x - ax) + ny * (y - ay) + nz * (z - az)


@compiled(inline="always")
def _areas(plane, x, y, z):
    """Areas at B and C of a point's foot on a triangle's plane, times twice the normal's length."""
    (ax, ay, az), (ux, uy, uz), (vx, vy, vz), (nx, ny, nz) = plane
    px = x - ax
    py = y - ay
    pz = z - az
    at_b = nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)
    at_c = nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)
    return at_b, at_c
