"""Points in the cells of a grid, and vertices of a surface moved until no such point is inside:
chords that cut through a convex bone.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, to_world
from rbfmuscle.geometry.frames import cross, dot, local_point, minus, row_of
from rbfmuscle.geometry.surfaces import triangle_plane
from rbfmuscle.loops import loop

# A chord is never farther from its surface than this share of a cell. As vertices move while points
# are pushed off, points are looked for so far above and below triangles, and so far beside them in
# barycentric coordinates.
CHORD = 0.35
MARGIN = 0.4
BESIDE = 0.15
# How deep a point may stay, in mean edges.
TOLERANCE = 0.01
# Last part of the way to the greatest depth on which the motion of a point's triangle fades.
FADE = 0.3
# Points deeper than the tolerance by less than this share are there but for rounding.
ASKED = 1.0 + 1e-6
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


# Points with their pose (4, 4) to the world.
Obstacles = list[tuple[PointGrid, Floats]]


def push_off(
    vertices: Floats,
    faces: Integers,
    grid: PointGrid,
    pose: Floats,
    edge: float,
    moved: Booleans,
    some: Integers | None = None,
) -> None:
    """Move the vertices (n, 3) of triangles (m, 3) that points in a pose (4, 4) have come
    through, into the surface, and mark them.

    A point behind a triangle (inside the mesh) by more than ``TOLERANCE`` of ``edge``, the mean
    length of an edge [scene unit], moves its three corners along the normal, by barycentric
    weights, until it is not. The way fades to zero where a point is at first as deep as ``CHORD``
    of that, or of the triangle's longest edge where that is shorter: what is deeper is behind
    another part of the muscle. With ``some`` (k,) only these triangles.
    """
    if some is None:
        some = np.arange(len(faces))
    given = vertices, faces, some, pose, grid
    pairs = np.empty((2 * len(some), 2), dtype=np.int64)
    met = _near_loop(*given, pairs)
    if met > len(pairs):
        pairs = np.empty((met, 2), dtype=np.int64)
        met = _near_loop(*given, pairs)
    if met == 0:
        return
    # In the order of the points' numbers, so that a scene that is turned is drawn alike.
    point, face = pairs[:met].T
    order = np.argsort(grid.number[point] * len(faces) + face)
    point, near = point[order], np.ascontiguousarray(face[order])
    first = np.flatnonzero(np.diff(point, prepend=-1))
    places = to_world(grid.points[point[first]], pose)
    first = np.append(first, met)
    allowed = np.full(len(places), np.nan)
    for _ in range(ROUNDS):
        if not _push_loop(vertices, faces, places, first, near, edge, allowed, moved):
            break


@loop
def _length(vertices, faces, f):
    """Length of the longest edge of a triangle."""
    square = 0.0
    for k in range(3):
        one, other = faces[f, k], faces[f, (k + 1) % 3]
        side = minus(row_of(vertices, one), row_of(vertices, other))
        square = max(square, dot(side, side))
    return np.sqrt(square)


@loop
def _near_loop(vertices, faces, some, pose, grid, pairs):
    """Pairs of a point and one of some triangles near it; how many there are, also beyond what
    ``pairs`` (k, 2) holds.
    """
    points, start, low, edge, shape, _ = grid
    least = np.empty(3)
    most = np.empty(3)
    begin = np.empty(3, np.int64)
    end = np.empty(3, np.int64)
    boxed = np.empty(len(points) + 1, np.int64)
    met = 0
    for f in some:
        a = local_point(pose, row_of(vertices, faces[f, 0]))
        b = local_point(pose, row_of(vertices, faces[f, 1]))
        c = local_point(pose, row_of(vertices, faces[f, 2]))
        to_b = minus(b, a)
        to_c = minus(c, a)
        across = minus(c, b)
        margin = MARGIN * np.sqrt(max(dot(to_b, to_b), dot(to_c, to_c), dot(across, across)))
        inside = True
        for k in range(3):
            least[k] = min(a[k], b[k], c[k]) - margin
            most[k] = max(a[k], b[k], c[k]) + margin
            inside &= most[k] >= low[k] and least[k] <= low[k] + edge * shape[k]
            begin[k] = np.int64(max(np.floor((least[k] - low[k]) / edge), 0.0))
            end[k] = min(np.int64(np.floor((most[k] - low[k]) / edge)), shape[k] - 1)
        if not inside:
            continue
        normal = cross(to_b, to_c)
        plane = a, to_b, to_c, normal
        square = dot(normal, normal)
        count = 0
        for i in range(begin[0], end[0] + 1):
            for j in range(begin[1], end[1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(start[row + begin[2]], start[row + end[2] + 1]):
                    x, y, z = row_of(points, p)
                    # Without a branch: which of them are in the box cannot be foreseen.
                    boxed[count] = p
                    count += (
                        (least[0] <= x)
                        & (x <= most[0])
                        & (least[1] <= y)
                        & (y <= most[1])
                        & (least[2] <= z)
                        & (z <= most[2])
                    )
        for p in boxed[:count]:
            x, y, z = row_of(points, p)
            if _is_near(plane, square, margin, x, y, z):
                if met < len(pairs):
                    pairs[met, 0], pairs[met, 1] = p, f
                met += 1
    return met


@loop
def _is_near(plane, square, margin, x, y, z):
    """Whether a point is within a margin of a triangle's plane, and not beside it."""
    height = dot(plane[3], minus((x, y, z), plane[0]))
    at_b, at_c = _areas(plane, x, y, z)
    over = height * height <= margin * margin * square
    return over and min(at_b, at_c, square - at_b - at_c) >= -BESIDE * square


@loop
def _push_loop(vertices, faces, points, first, near, edge, allowed, moved):
    """One pass over the points; whether any had to be pushed off.

    How deep each may stay is ``allowed`` (k,), NaN until a triangle is first found over it.
    """
    pushed = False
    for p in range(len(points)):
        best, depth = _triangle_over(
            vertices, faces, row_of(points, p), near[first[p] : first[p + 1]]
        )
        if best < 0:
            continue
        deepest = CHORD * min(_length(vertices, faces, best), edge)
        if np.isnan(allowed[p]):
            share = min(max((deepest - depth) / (FADE * deepest), 0.0), 1.0)
            least = TOLERANCE * edge
            allowed[p] = max(share * least + (1.0 - share) * depth, least)
        if depth <= ASKED * allowed[p] or depth >= deepest:
            continue
        pushed = True
        plane = triangle_plane(vertices, faces, best)
        square = dot(plane[3], plane[3])
        at_b, at_c = _areas(plane, points[p, 0], points[p, 1], points[p, 2])
        weight = 1.0 - (at_b + at_c) / square, at_b / square, at_c / square
        # What is allowed is left: what is a little deeper does not leap.
        way = (depth - allowed[p]) / (weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2)
        way /= np.sqrt(square)
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            for a in range(3):
                vertices[v, a] -= plane[3][a] * way * weight[k]
    return pushed


@loop
def _triangle_over(vertices, faces, point, near):
    """Of the triangles ``near`` a point the one whose plane is nearest, of those that it is not
    beside, -1 for none, and the point's depth below that.
    """
    x, y, z = point
    best = -1
    least = np.inf
    signed = 0.0
    for f in near:
        plane = triangle_plane(vertices, faces, f)
        square, (at_b, at_c) = dot(plane[3], plane[3]), _areas(plane, x, y, z)
        if square == 0.0 or min(at_b, at_c, square - at_b - at_c) < -1e-9 * square:
            continue  # beside it
        depth = -dot(plane[3], minus((x, y, z), plane[0])) / np.sqrt(square)
        # Of triangles that are equally near, but for rounding, the first.
        if abs(depth) < least * (1.0 - 1e-6):
            best = f
            least = abs(depth)
            signed = depth
    return best, signed


@loop
def _areas(plane, x, y, z):
    """Areas at B and C of a point's foot on a triangle's plane, times twice the normal's length."""
    corner, to_b, to_c, normal = plane
    way = minus((x, y, z), corner)
    return dot(normal, cross(way, to_c)), dot(normal, cross(to_b, way))
