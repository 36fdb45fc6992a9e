"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is inside it."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Array, Booleans, Floats, Integers
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_points

if TYPE_CHECKING:
    from rbfmuscle.implicit.extraction.band import BandGrid


# A chord is never farther from its surface than this share of a cell.
CHORD = 0.35
# Points in one pack, whose box is tested first, and cells along a side by which points are sorted.
PACK, SORTING_CELLS = 128, 16
# Cells along a side of the blocks that are looked at before the cells themselves.
BLOCK = 4


class ObstaclePoints:
    """Points that must stay outside a surface, sorted so that those near it are found quickly.

    Parameters
    ----------
    points : (k, 3) array_like
        In coordinates of their own, as a bone's vertices.
    """

    def __init__(self, points: ArrayLike) -> None:
        points = check_points(points)
        low = points.min(axis=0, initial=np.inf)
        size = float(np.ptp(points, axis=0).max(initial=0.0)) if len(points) else 0.0
        cell = np.minimum((points - low) * (SORTING_CELLS / max(size, 1e-300)), SORTING_CELLS - 1).astype(
            np.int64
        )
        self.order = np.lexsort(cell.T)
        self.points = np.ascontiguousarray(points[self.order])
        ends = np.minimum(np.arange(0, len(points) + PACK, PACK), len(points))
        self.boxes = np.array(
            [(self.points[a:b].min(axis=0), self.points[a:b].max(axis=0)) for a, b in pairwise(ends) if b > a]
        ).reshape(-1, 2, 3)


class Visited(NamedTuple):
    """Way from points to grid coordinates, ``turn @ p + shift``, and what was visited: state of each cell, and blocks
    of cells that hold a visited one or touch one.
    """

    turn: Floats
    shift: Floats
    shape: Integers
    strides: Integers
    state: Array
    blocks: Booleans


class Sorted(NamedTuple):
    """Triangles sorted by the cell of their middle: those of cell c are order[start[c] : start[c + 1]], with their
    middles in that order; ``cell`` (m,) is each triangle's own.
    """

    cell: Array
    start: Array
    order: Array
    middle: Floats


def points_near_cells(
    obstacles: list[tuple[ObstaclePoints, Floats]], grid: BandGrid, state: Array, cells: Integers
) -> Floats:
    """Obstacle points in or beside the cells that a band has visited, in world positions.

    Parameters
    ----------
    obstacles : list of pairs of ObstaclePoints and (4, 4) ndarrays
        Points, and the pose that takes them to the world.
    grid : BandGrid
    state : (cells,) ndarray
        1 where a cell was visited.
    cells : (v,) ndarray
        Flat numbers of the visited cells.

    Returns
    -------
    (m, 3) ndarray
    """
    found = [np.zeros((0, 3))]
    shape = np.array(grid.shape)
    blocks = np.zeros(tuple(shape // BLOCK + 1), dtype=np.bool_)
    _mark_blocks_loop(cells, grid.strides, blocks)
    for obstacle, pose in obstacles:
        points = obstacle.points
        turn = grid.axes @ pose[:3, :3] / grid.spacing
        shift = grid.axes @ (pose[:3, 3] - grid.origin) / grid.spacing
        index = np.empty(len(points), dtype=np.int64)
        visited = Visited(turn, shift, shape, grid.strides, state, blocks)
        count = _near_cells_loop(points, obstacle.boxes, visited, index)
        # In the caller's order: pushes follow one another, and a turned scene is sorted in another one.
        near = index[:count][np.argsort(obstacle.order[index[:count]])]
        found.append(points[near] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(found)


@compiled(error_model="numpy")
def _mark_blocks_loop(cells, strides, blocks):
    """Mark the blocks of BLOCK^3 cells that hold a visited cell or touch one."""
    for cell in cells:
        i, j, k = cell // strides[0], cell % strides[0] // strides[1], cell % strides[1]
        for a in range(max(i - 1, 0) // BLOCK, (i + 1) // BLOCK + 1):
            for b in range(max(j - 1, 0) // BLOCK, (j + 1) // BLOCK + 1):
                for c in range(max(k - 1, 0) // BLOCK, (k + 1) // BLOCK + 1):
                    blocks[a, b, c] = True


@compiled(error_model="numpy", nogil=False)
def _near_cells_loop(points, boxes, visited, index):
    turn, shift, shape, blocks = visited.turn, visited.shift, visited.shape, visited.blocks
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    count = 0
    for pack in range(len(boxes)):
        apart = False
        for a in range(3):
            middle, half = shift[a], 0.0
            for b in range(3):
                middle += 0.5 * turn[a, b] * (boxes[pack, 0, b] + boxes[pack, 1, b])
                half += 0.5 * abs(turn[a, b]) * (boxes[pack, 1, b] - boxes[pack, 0, b])
            apart |= middle + half < 1.0 or middle - half > shape[a] - 2.0
            low[a] = int(max(middle - half, 0.0)) // BLOCK
            high[a] = int(max(min(middle + half, shape[a] - 1.0), 0.0)) // BLOCK
        if apart or not blocks[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1].any():
            continue
        last = min((pack + 1) * PACK, len(points))
        count = _near_points_loop(points, pack * PACK, last, visited, index, count)
    return count


@compiled(error_model="numpy")
def _near_points_loop(points, first, last, visited, index, count):
    turn, shift, shape, strides, state, blocks = visited
    for n in range(first, last):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u = shift[0] + turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
        v = shift[1] + turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
        w = shift[2] + turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
        if not (1.0 <= u <= shape[0] - 2.0 and 1.0 <= v <= shape[1] - 2.0 and 1.0 <= w <= shape[2] - 2.0):
            continue
        if not blocks[int(u) // BLOCK, int(v) // BLOCK, int(w) // BLOCK]:
            continue
        beside = False
        for i in range(int(u - CHORD), int(u + CHORD) + 1):
            for j in range(int(v - CHORD), int(v + CHORD) + 1):
                for k in range(int(w - CHORD), int(w + CHORD) + 1):
                    beside |= state[i * strides[0] + j * strides[1] + k * strides[2]] == 1
        if beside:
            index[count] = n
            count += 1
    return count


def faces_within(vertices: Floats, faces: Integers, distance: Floats, reach: float) -> Booleans:
    """Mask (m,) of the triangles that may come within reach of what their corners are at a distance from.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    distance : (n,) ndarray
        Of the vertices, at least.
    reach : float
    """
    found = np.empty(len(faces), dtype=np.bool_)
    _faces_within_loop(vertices, faces, distance, reach, found)
    return found


@compiled(error_model="numpy")
def _faces_within_loop(vertices, faces, distance, reach, found):
    """No point of a triangle is farther from a corner than its longest side over the root of three."""
    for f in range(len(faces)):
        longest = 0.0
        for k in range(3):
            a, b, square = faces[f, k], faces[f, (k + 1) % 3], 0.0
            for c in range(3):
                square += (vertices[a, c] - vertices[b, c]) ** 2
            longest = max(longest, square)
        nearest = min(distance[faces[f, 0]], distance[faces[f, 1]], distance[faces[f, 2]])
        found[f] = nearest <= 0.578 * np.sqrt(longest) + reach


def push_off_points(
    vertices: Floats, faces: Integers, points: Floats, grid: BandGrid, tolerance: float, rounds: int = 4
) -> Booleans:
    """Move the vertices of triangles that obstacle points have come through, into the surface.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` moves its three corners along the
    normal, by barycentric weights, until it is not. Only points less than ``CHORD`` of a cell deep are seen: a
    deeper point is behind some other part of the muscle.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Changed in place [scene unit].
    faces : (m, 3) ndarray
        Closed, outward.
    points : (k, 3) ndarray
        Points that must stay outside.
    grid : BandGrid
        In whose cells the triangles are sorted.
    tolerance : float

    Returns
    -------
    (n,) ndarray of bool
        Vertices that were moved.
    """
    moved = np.zeros(len(vertices), dtype=bool)
    if len(points) == 0:
        return moved
    start = np.zeros(int(np.prod(grid.shape)) + 1, dtype=np.int32)
    cell, order = np.empty(len(faces), dtype=np.int32), np.empty(len(faces), dtype=np.int32)
    cells = Sorted(cell, start, order, np.empty((len(faces), 3)))
    last = np.array(grid.shape) - 2
    _sort_faces_loop(vertices, faces, (grid.axes / grid.spacing, grid.origin, last, grid.strides), cells)
    where = grid.cells(points)
    touched = np.ones(len(start), dtype=np.bool_)
    scale = grid.strides, grid.spacing, tolerance
    for _ in range(rounds):
        if not _push_loop(vertices, faces, points, where, cells, scale, moved, touched):
            break
    return moved


@compiled(error_model="numpy")
def _sort_faces_loop(vertices, faces, frame, cells):
    """Sort triangles by the cell of their middle."""
    turn, origin, last, strides = frame
    cell, start, order, middle = cells
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        x = (vertices[i, 0] + vertices[j, 0] + vertices[k, 0]) / 3.0 - origin[0]
        y = (vertices[i, 1] + vertices[j, 1] + vertices[k, 1]) / 3.0 - origin[1]
        z = (vertices[i, 2] + vertices[j, 2] + vertices[k, 2]) / 3.0 - origin[2]
        number = 0
        for a in range(3):
            u = turn[a, 0] * x + turn[a, 1] * y + turn[a, 2] * z
            number += min(max(int(np.floor(u)), 0), last[a]) * strides[a]
        cell[f] = number
        start[number + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    for f in range(len(faces) - 1, -1, -1):
        # Filled from the end: what was the end of a cell's triangles becomes their beginning.
        start[cell[f] + 1] -= 1
        n = start[cell[f] + 1]
        order[n] = f
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        for a in range(3):
            middle[n, a] = (vertices[i, a] + vertices[j, a] + vertices[k, a]) / 3.0
    for c in range(len(start) - 1):
        start[c] = start[c + 1]
    start[-1] = len(faces)


@compiled(error_model="numpy")
def _push_loop(vertices, faces, points, where, cells, scale, moved, touched):
    """One pass over the points in ``touched`` cells; returns how many had to be pushed off.

    Points that are well outside are taken off the list (where = -1); ``touched`` then marks the cells around the
    triangles that were pushed.
    """
    strides, reach, tolerance = scale
    number = 0
    normal, weight = np.empty(3), np.empty(3)
    pushed = np.empty(len(points), dtype=np.int64)
    for p in range(len(points)):
        if where[p] < 0 or not touched[where[p]]:
            continue
        best, signed = _nearest_triangle(vertices, faces, points[p], where[p], cells, strides, reach)
        if signed < -0.1 * reach:
            where[p] = -1
        if signed <= tolerance or signed > CHORD * reach:
            continue
        pushed[number] = cells.cell[best]
        number += 1
        _weigh(vertices, faces, best, points[p], weight, normal)
        square = weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            for c in range(3):
                vertices[v, c] -= normal[c] * (signed - 0.5 * tolerance) * weight[k] / square
    _touch_loop(pushed[:number], strides, touched)
    return number


@compiled(error_model="numpy")
def _nearest_triangle(vertices, faces, p, where, cells, strides, reach):
    """Nearest triangle right above or below p, less than ``reach`` away, and how far p lies behind it."""
    _, start, order, middle = cells
    best, least, signed = -1, reach, -reach
    # A triangle lies in a cell: its middle is less than a cell from any point that is right behind it.
    far = (1.3 * reach) ** 2
    x, y, z = p[0], p[1], p[2]
    for i in range(-1, 2):
        for j in range(-1, 2):
            # The three cells along the last axis lie side by side.
            here = where + i * strides[0] + j * strides[1]
            first, last = max(here - 1, 0), min(here + 2, len(start) - 1)
            if last <= first:
                continue
            for n in range(start[first], start[last]):
                dx, dy, dz = x - middle[n, 0], y - middle[n, 1], z - middle[n, 2]
                if dx * dx + dy * dy + dz * dz > far:
                    continue
                depth = _depth_behind(vertices, faces, order[n], x, y, z)
                if abs(depth) < least:
                    best, least, signed = order[n], abs(depth), depth
    return best, signed


@compiled(error_model="numpy")
def _touch_loop(cells, strides, touched):
    """Mark the cells less than three from any given one: a corner's triangles are one away, their points two."""
    touched[:] = False
    for cell in cells:
        for i in range(-2, 3):
            for j in range(-2, 3):
                for k in range(-2, 3):
                    near = cell + i * strides[0] + j * strides[1] + k * strides[2]
                    if 0 <= near < len(touched):
                        touched[near] = True


@compiled(error_model="numpy", inline="always")
def _frame(vertices, faces, f, x, y, z):
    """Normal of a triangle, its square, the offset of a point from corner A, and twice the areas at B and C.

    The areas are those of the point's shadow in the triangle's plane, times the length of the normal.
    """
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    px, py, pz = x - ax, y - ay, z - az
    at_b = nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)
    at_c = nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)
    height = nx * px + ny * py + nz * pz
    return nx, ny, nz, nx * nx + ny * ny + nz * nz, height, at_b, at_c


@compiled(error_model="numpy")
def _depth_behind(vertices, faces, f, x, y, z):
    """How far a point lies behind a triangle; infinite if beside it."""
    _, _, _, square, height, at_b, at_c = _frame(vertices, faces, f, x, y, z)
    least = -1e-9 * square
    if square == 0.0 or at_b < least or at_c < least or square - at_b - at_c < least:
        return np.inf
    return -height / np.sqrt(square)


@compiled(error_model="numpy")
def _weigh(vertices, faces, f, p, weight, normal):
    """Fill the barycentric weights of a point's shadow in a triangle, and the triangle's unit normal."""
    nx, ny, nz, square, _, at_b, at_c = _frame(vertices, faces, f, p[0], p[1], p[2])
    weight[1], weight[2] = at_b / square, at_c / square
    weight[0] = 1.0 - weight[1] - weight[2]
    length = np.sqrt(square)
    normal[0], normal[1], normal[2] = nx / length, ny / length, nz / length
