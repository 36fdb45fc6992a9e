"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is
inside it.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.jit import compiled

# A chord is never farther from its surface than this share of a cell. As vertices move while points
# are pushed off, points are looked for so far above and below triangles, and so far beside them in
# barycentric coordinates.
CHORD = 0.35
MARGIN = 0.5
BESIDE = 0.3
# Room for pairs of a point and a triangle near it, at first, for each triangle.
PAIRS = 2
# Cells of a grid for each point; passes over the points that are pushed off.
CELLS, ROUNDS = 5, 4


class PointGrid:
    """Points (k, 3), sorted by the cells of a grid: some times as many as points, as a surface
    leaves most empty.

    ``points`` are those given, cell by cell, ``start`` (c + 1,) the first of each cell; ``low``
    (3,), ``edge`` and ``shape`` (3,) are corner, edge length and number of cells.
    """

    def __init__(self, points: Floats) -> None:
        self.low = points.min(axis=0) if len(points) else np.zeros(3)
        extent = points.max(axis=0) - self.low if len(points) else np.zeros(3)
        size = float(extent.max()) or 1.0
        sides = np.maximum(extent / size, 1e-2)
        self.edge = size * float(sides.prod() / (CELLS * max(len(points), 1))) ** (1.0 / 3.0)
        self.shape = (extent / self.edge).astype(np.int64) + 1
        strides = self.shape[1] * self.shape[2], self.shape[2], 1
        cell = ((points - self.low) / self.edge).astype(np.int64) @ strides
        order = np.argsort(cell, kind="stable")
        self.points = np.ascontiguousarray(points[order])
        self.start = np.searchsorted(cell[order], np.arange(int(self.shape.prod()) + 1))


# Points with their pose (4, 4) to the world.
Obstacles = list[tuple[PointGrid, Floats]]


class NearTriangles(NamedTuple):
    """Points (p, 3) in the world that triangles are near: those of point k are ``faces[first[k] :
    first[k + 1]]``.
    """

    points: Floats
    first: Integers
    faces: Integers


def near_triangles(
    obstacles: Obstacles, vertices: Floats, faces: Integers, margin: float
) -> NearTriangles:
    """Obstacle points right above or below triangles in the world, or nearly, by at most ``margin``
    [scene unit].
    """
    points = [np.zeros((0, 3))]
    counts = [np.zeros(0, np.int64)]
    near = [np.zeros(0, np.int64)]
    for grid, pose in obstacles:
        local = np.ascontiguousarray((vertices - pose[:3, 3]) @ pose[:3, :3])
        cells, room = (grid.points, grid.start, grid.low, grid.edge, grid.shape), PAIRS * len(faces)
        while True:
            pairs = np.empty((2, room), dtype=np.int64)
            met = _near_loop(local, faces, margin, cells, pairs)
            if met <= room:
                break
            room = met
        order = np.argsort(pairs[0, :met], kind="stable")
        point = pairs[0, order]
        begin = np.flatnonzero(np.diff(point, prepend=-1))
        points.append(grid.points[point[begin]] @ pose[:3, :3].T + pose[:3, 3])
        counts.append(np.diff(begin, append=met))
        near.append(pairs[1, order])
    first = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    return NearTriangles(np.concatenate(points), first, np.concatenate(near))


def push_off_points(
    vertices: Floats, faces: Integers, near: NearTriangles, spacing: float, tolerance: float
) -> Booleans:
    """Move the vertices of triangles that obstacle points have come through, into the surface: a
    mask (n,) of these.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` [scene unit] moves its
    three corners along the normal, by barycentric weights, until it is not. Points deeper than
    ``CHORD`` of the spacing, the length of the triangles' edges, are left alone: they are behind
    another part of the muscle. ``vertices`` (n, 3) [scene unit] are changed in place; faces (m, 3)
    look outward.
    """
    moved = np.zeros(len(vertices), dtype=np.bool_)
    for _ in range(ROUNDS):
        if not _push_loop(vertices, faces, near, spacing, tolerance, moved):
            break
    return moved


@compiled(error_model="numpy")
def _near_loop(vertices, faces, margin, cells, pairs):
    """Pairs of a point and a triangle near it; how many there are, also beyond the room for
    them.
    """
    points, start, low, edge, shape = cells
    least, most = np.empty(3), np.empty(3)
    begin = np.empty(3, np.int64)
    end = np.empty(3, np.int64)
    met = 0
    for f in range(len(faces)):
        empty = False
        for a in range(3):
            x = vertices[faces[f, 0], a]
            y = vertices[faces[f, 1], a]
            z = vertices[faces[f, 2], a]
            least[a], most[a] = min(x, y, z) - margin, max(x, y, z) + margin
            empty |= not (most[a] >= low[a] and least[a] <= low[a] + edge * shape[a])
        if empty:
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
                    x = points[p, 0]
                    y = points[p, 1]
                    z = points[p, 2]
                    height = _height(plane, x, y, z)
                    if height * height > margin * margin * square:
                        continue
                    at_b, at_c = _areas(plane, x, y, z)
                    if min(at_b, at_c, square - at_b - at_c) < -BESIDE * square:
                        continue
                    if (
                        (least[0] <= x)
                        & (x <= most[0])
                        & (least[1] <= y)
                        & (y <= most[1])
                        & (least[2] <= z)
                        & (z <= most[2])
                    ):
                        if met < pairs.shape[1]:
                            pairs[0, met], pairs[1, met] = p, f
                        met += 1
    return met


@compiled(error_model="numpy")
def _push_loop(vertices, faces, near_points, spacing, tolerance, moved):
    """One pass over the points; returns whether any had to be pushed off."""
    points, first, near = near_points
    pushed = False
    for p in range(len(points)):
        x = points[p, 0]
        y = points[p, 1]
        z = points[p, 2]
        best = -1
        least = spacing
        signed = -spacing
        for f in near[first[p] : first[p + 1]]:
            plane = _plane(vertices, faces, f)
            square, (at_b, at_c) = _square(plane), _areas(plane, x, y, z)
            if square == 0.0 or min(at_b, at_c, square - at_b - at_c) < -1e-9 * square:
                continue  # beside it
            depth = -_height(plane, x, y, z) / np.sqrt(square)
            if abs(depth) < least:
                best = f
                least = abs(depth)
                signed = depth
        if signed <= tolerance or signed > CHORD * spacing:
            continue
        pushed = True
        plane = _plane(vertices, faces, best)
        square = _square(plane)
        (at_b, at_c) = _areas(plane, x, y, z)
        (nx, ny, nz) = plane[3]
        weight = 1.0 - (at_b + at_c) / square, at_b / square, at_c / square
        # Half the tolerance is left, so that rounding does not ask for another round.
        way = (signed - 0.5 * tolerance) / (weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2)
        way /= np.sqrt(square)
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            vertices[v, 0] -= nx * way * weight[k]
            vertices[v, 1] -= ny * way * weight[k]
            vertices[v, 2] -= nz * way * weight[k]
    return pushed


@compiled(error_model="numpy", inline="always")
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


@compiled(error_model="numpy", inline="always")
def _square(plane):
    """Square of the normal's length."""
    nx, ny, nz = plane[3]
    return nx * nx + ny * ny + nz * nz


@compiled(error_model="numpy", inline="always")
def _height(plane, x, y, z):
    """Height of a point above a triangle, times the normal's length."""
    (ax, ay, az), (nx, ny, nz) = plane[0], plane[3]
    return nx * (x - ax) + ny * (y - ay) + nz * (z - az)


@compiled(error_model="numpy", inline="always")
def _areas(plane, x, y, z):
    """Areas at B and C of a point's foot on a triangle's plane, times twice the normal's length."""
    (ax, ay, az), (ux, uy, uz), (vx, vy, vz), (nx, ny, nz) = plane
    px = x - ax
    py = y - ay
    pz = z - az
    at_b = nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)
    at_c = nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)
    return at_b, at_c
