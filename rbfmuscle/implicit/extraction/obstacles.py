"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is inside it."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.jit import compiled

# A chord is never farther from its surface than this share of a cell. As vertices move while points are pushed off,
# points are looked for so far above and below triangles, and so far beside them in barycentric coordinates.
CHORD, MARGIN, BESIDE = 0.35, 0.5, 0.3
# Room for pairs of a point and a triangle near it, at first, for each triangle.
PAIRS = 2
# Cells of a grid for each point; passes over the points that are pushed off.
CELLS, ROUNDS = 5, 4


class PointGrid:
    """Points (k, 3), sorted by the cells of a grid: some times as many as points, as a surface leaves most empty.

    ``points`` are those given, cell by cell, ``start`` (c + 1,) the first of each cell; ``low`` (3,), ``edge`` and
    ``shape`` (3,) are corner, edge length and number of cells.
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
    """Points (p, 3) in the world that triangles are near: those of point k are ``faces[first[k] : first[k + 1]]``."""

    points: Floats
    first: Integers
    faces: Integers


def near_triangles(obstacles: Obstacles, vertices: Floats, faces: Integers, margin: float) -> NearTriangles:
    """Obstacle points right above or below triangles in the world, or nearly, by at most ``margin`` [scene unit]."""
    points, counts, near = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for grid, pose in obstacles:
        local = np.ascontiguousarray((vertices - pose[:3, 3]) @ pose[:3, :3])
        cells, room = (grid.points, grid.start, grid.low, grid.edge, grid.shape), PAIRS * len(faces)
        while True:
            count, pairs = np.zeros(len(grid.points), dtype=np.int64), np.empty((room, 2), dtype=np.int64)
            met = _near_loop(local, faces, margin, cells, count, pairs)
            if met <= room:
                break
            room = met
        found = np.empty(met, dtype=np.int64)
        _sort_loop(pairs[:met], np.cumsum(count) - count, found)
        rows = np.flatnonzero(count)
        points.append(grid.points[rows] @ pose[:3, :3].T + pose[:3, 3])
        counts.append(count[rows])
        near.append(found)
    first = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
    return NearTriangles(np.concatenate(points), first, np.concatenate(near))


def push_off_points(
    vertices: Floats, faces: Integers, near: NearTriangles, spacing: float, tolerance: float
) -> Booleans:
    """Move the vertices of triangles that obstacle points have come through, into the surface: a mask (n,) of these.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` [scene unit] moves its three corners along
    the normal, by barycentric weights, until it is not. Points deeper than ``CHORD`` of the spacing, the length of the
    triangles' edges, are left alone: they are behind another part of the muscle. ``vertices`` (n, 3) [scene unit] are
    changed in place; faces (m, 3) look outward.
    """
    moved = np.zeros(len(vertices), dtype=np.bool_)
    for _ in range(ROUNDS):
        if not _push_loop(vertices, faces, near, spacing, tolerance, moved):
            break
    return moved


@compiled(error_model="numpy")
def _near_loop(vertices, faces, margin, cells, count, pairs):
    """Pairs of a point and a triangle near it; how many there are, also beyond the room for them."""
    points, start, low, edge, shape = cells
    least, most = np.empty(3), np.empty(3)
    begin, end, met = np.empty(3, np.int64), np.empty(3, np.int64), 0
    for f in range(len(faces)):
        empty = False
        for a in range(3):
            x, y, z = vertices[faces[f, 0], a], vertices[faces[f, 1], a], vertices[faces[f, 2], a]
            least[a], most[a] = min(x, y, z) - margin, max(x, y, z) + margin
            empty |= not (most[a] >= low[a] and least[a] <= low[a] + edge * shape[a])
        if empty:
            continue
        for a in range(3):
            begin[a] = np.int64(max(np.floor((least[a] - low[a]) / edge), 0.0))
            end[a] = min(np.int64(np.floor((most[a] - low[a]) / edge)), shape[a] - 1)
        for i in range(begin[0], end[0] + 1):
            for j in range(begin[1], end[1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(start[row + begin[2]], start[row + end[2] + 1]):
                    x, y, z = points[p, 0], points[p, 1], points[p, 2]
                    if not (
                        (least[0] <= x) & (x <= most[0]) & (least[1] <= y) & (y <= most[1])
                        & (least[2] <= z) & (z <= most[2])
                    ):  # fmt: skip
                        continue
                    _, _, _, square, height, at_b, at_c = _shadow(vertices, faces, f, x, y, z)
                    beside = min(at_b, at_c, square - at_b - at_c)
                    if height * height <= margin * margin * square and beside >= -BESIDE * square:
                        if met < len(pairs):
                            pairs[met, 0], pairs[met, 1] = p, f
                        count[p] += 1
                        met += 1
    return met


@compiled(error_model="numpy")
def _sort_loop(pairs, place, found):
    """Triangles of the pairs by point, whose first is at ``place``."""
    for k in range(len(pairs)):
        p = pairs[k, 0]
        found[place[p]] = pairs[k, 1]
        place[p] += 1


@compiled(error_model="numpy")
def _push_loop(vertices, faces, near_points, spacing, tolerance, moved):
    """One pass over the points; returns whether any had to be pushed off."""
    points, first, near = near_points
    pushed = False
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, least, signed, found = -1, spacing, -spacing, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for f in near[first[p] : first[p + 1]]:
            shadow = _shadow(vertices, faces, f, x, y, z)
            square, height, at_b, at_c = shadow[3], shadow[4], shadow[5], shadow[6]
            if square == 0.0 or min(at_b, at_c, square - at_b - at_c) < -1e-9 * square:
                continue  # beside it
            depth = -height / np.sqrt(square)
            if abs(depth) < least:
                best, least, signed, found = f, abs(depth), depth, shadow
        if signed <= tolerance or signed > CHORD * spacing:
            continue
        pushed = True
        nx, ny, nz, square, _, at_b, at_c = found
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


@compiled(error_model="numpy")
def _shadow(vertices, faces, f, x, y, z):
    """A triangle's normal, its square, and of a point height and shadow areas at B and C, times the normal's length."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    px, py, pz = x - ax, y - ay, z - az
    at_b = nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)
    at_c = nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)
    return nx, ny, nz, nx * nx + ny * ny + nz * nz, nx * px + ny * py + nz * pz, at_b, at_c
