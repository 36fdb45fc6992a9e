"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is inside it."""

from itertools import pairwise

import numba
import numpy as np

from rbfmuscle.validation import check_points

# A chord is never farther from its surface than this share of a cell.
CHORD = 0.35
# Points in one pack, whose box is tested first, and cells along a side by which points are sorted.
PACK, SORTING_CELLS = 128, 16


class ObstaclePoints:
    """Points that must stay outside a surface, sorted so that those near it are found quickly.

    Parameters
    ----------
    points : (k, 3) array_like
        In coordinates of their own, as a bone's vertices.
    """

    def __init__(self, points):
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


def points_near_cells(obstacles, grid, state):
    """Obstacle points in or beside the cells that a band has visited, in world positions.

    Parameters
    ----------
    obstacles : list of pairs of ObstaclePoints and (4, 4) ndarrays
        Points, and the pose that takes them to the world.
    grid : BandGrid
    state : (cells,) ndarray
        1 where a cell was visited.

    Returns
    -------
    (m, 3) ndarray
    """
    found = [np.zeros((0, 3))]
    for obstacle, pose in obstacles:
        points = obstacle.points
        turn = grid.axes @ pose[:3, :3] / grid.spacing
        shift = grid.axes @ (pose[:3, 3] - grid.origin) / grid.spacing
        index = np.empty(len(points), dtype=np.int64)
        count = _near_cells_loop(
            points, obstacle.boxes, turn, shift, np.array(grid.shape), grid.strides, state, index
        )
        # In the caller's order: pushes follow one another, and a turned scene is sorted in another one.
        near = index[:count][np.argsort(obstacle.order[index[:count]])]
        found.append(points[near] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(found)


@numba.njit(cache=True, nogil=True)
def _near_cells_loop(points, boxes, turn, shift, shape, strides, state, index):
    count = 0
    for pack in range(len(boxes)):
        apart = False
        for a in range(3):
            middle, half = shift[a], 0.0
            for b in range(3):
                middle += 0.5 * turn[a, b] * (boxes[pack, 0, b] + boxes[pack, 1, b])
                half += 0.5 * abs(turn[a, b]) * (boxes[pack, 1, b] - boxes[pack, 0, b])
            apart |= middle + half < 1.0 or middle - half > shape[a] - 2.0
        if not apart:
            last = min((pack + 1) * PACK, len(points))
            count = _near_points_loop(
                points, pack * PACK, last, turn, shift, shape, strides, state, index, count
            )
    return count


@numba.njit(cache=True, nogil=True)
def _near_points_loop(points, first, last, turn, shift, shape, strides, state, index, count):
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for n in range(first, last):
        within = True
        for a in range(3):
            u = shift[a] + turn[a, 0] * points[n, 0] + turn[a, 1] * points[n, 1] + turn[a, 2] * points[n, 2]
            if u < 1.0 or u > shape[a] - 2.0:
                within = False
                break
            low[a], high[a] = int(u - CHORD), int(u + CHORD)
        if not within:
            continue
        visited = False
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    visited |= state[i * strides[0] + j * strides[1] + k] == 1
        if visited:
            index[count] = n
            count += 1
    return count


def push_off_points(vertices, faces, points, grid, tolerance, rounds=4):
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
    start = np.zeros(int(np.prod(grid.shape)) + 1, dtype=np.int64)
    cell, order = np.empty(len(faces), dtype=np.int64), np.empty(len(faces), dtype=np.int64)
    last = np.array(grid.shape) - 2
    turn = grid.axes / grid.spacing
    middle = np.empty((len(faces), 3))
    _sort_faces_loop(vertices, faces, turn, grid.origin, last, grid.strides, cell, start, order, middle)
    where = grid.cells(points)
    touched = np.ones(len(start), dtype=np.bool_)
    for _ in range(rounds):
        number = _push_loop(
            vertices, faces, points, where, order, start, middle, cell, grid.strides, grid.spacing, tolerance, moved,
            touched,
        )  # fmt: skip
        if not number:
            break
    return moved


@numba.njit(cache=True, nogil=True)
def _sort_faces_loop(vertices, faces, turn, origin, last, strides, cell, start, order, middle):
    """Sort triangles by the cell of their middle: those of cell c are order[start[c] : start[c + 1]]."""
    m = np.empty(3)
    for f in range(len(faces)):
        for a in range(3):
            m[a] = -origin[a]
            for k in range(3):
                m[a] += vertices[faces[f, k], a] / 3.0
        number = 0
        for a in range(3):
            u = turn[a, 0] * m[0] + turn[a, 1] * m[1] + turn[a, 2] * m[2]
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
        for a in range(3):
            middle[n, a] = (
                vertices[faces[f, 0], a] + vertices[faces[f, 1], a] + vertices[faces[f, 2], a]
            ) / 3.0
    start[:-1] = start[1:]
    start[-1] = len(faces)


@numba.njit(cache=True, nogil=True)
def _push_loop(
    vertices, faces, points, where, order, start, middle, cell, strides, reach, tolerance, moved, touched
):  # fmt: skip
    """One pass over the points in ``touched`` cells; returns how many had to be pushed off.

    Points that are well outside are taken off the list (where = -1); ``touched`` then marks the cells around the
    triangles that were pushed.
    """
    number = 0
    weight, normal = np.empty(3), np.empty(3)
    best_weight, best_normal = np.empty(3), np.empty(3)
    pushed = np.empty(len(points), dtype=np.int64)
    # A triangle lies in a cell: its middle is less than a cell from any point that is right behind it.
    far = (1.3 * reach) ** 2
    for p in range(len(points)):
        if where[p] < 0 or not touched[where[p]]:
            continue
        best, least, signed = -1, reach, -reach
        for i in range(-1, 2):
            for j in range(-1, 2):
                # The three cells along the last axis lie side by side.
                here = where[p] + i * strides[0] + j * strides[1]
                first, last = max(here - 1, 0), min(here + 2, len(start) - 1)
                if last <= first:
                    continue
                for n in range(start[first], start[last]):
                    square = 0.0
                    for c in range(3):
                        square += (points[p, c] - middle[n, c]) ** 2
                    if square > far:
                        continue
                    depth = _depth_behind(vertices, faces[order[n]], points[p], weight, normal)
                    if abs(depth) < least:
                        best, least = order[n], abs(depth)
                        best_weight[:] = weight
                        best_normal[:] = normal
                        signed = depth
        if signed < -0.1 * reach:
            where[p] = -1
        if signed <= tolerance or signed > CHORD * reach:
            continue
        pushed[number] = cell[best]
        number += 1
        square = best_weight[0] ** 2 + best_weight[1] ** 2 + best_weight[2] ** 2
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            for c in range(3):
                vertices[v, c] -= best_normal[c] * (signed - 0.5 * tolerance) * best_weight[k] / square
    _touch_loop(pushed[:number], strides, touched)
    return number


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _depth_behind(vertices, face, p, weight, normal):
    """How far p lies behind a triangle, with its barycentric weights; infinite if beside it."""
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    if square == 0.0:
        return np.inf
    px, py, pz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    weight[1] = (nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)) / square
    weight[2] = (nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)) / square
    weight[0] = 1.0 - weight[1] - weight[2]
    if weight[0] < -1e-9 or weight[1] < -1e-9 or weight[2] < -1e-9:
        return np.inf
    length = np.sqrt(square)
    normal[0], normal[1], normal[2] = nx / length, ny / length, nz / length
    return -(normal[0] * px + normal[1] * py + normal[2] * pz)
