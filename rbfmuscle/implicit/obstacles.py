"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is inside it."""

import numba
import numpy as np

from rbfmuscle.implicit.band import BandGrid


def push_off_points(vertices, faces, obstacles, spacing, tolerance, rounds=4):
    """Move the vertices of triangles that obstacle points have come through, into the surface.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` moves its three corners along the
    normal, by barycentric weights, until it is not. Only points less than 0.35 ``spacing`` deep are seen: a chord
    is never farther from its surface, and a deeper point is behind some other part of the muscle.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Changed in place [scene unit].
    faces : (m, 3) ndarray
        Closed, outward.
    obstacles : (k, 3) ndarray
        Points that must stay outside.
    spacing, tolerance : float

    Returns
    -------
    (n,) ndarray of bool
        Vertices that were moved.
    """
    moved = np.zeros(len(vertices), dtype=bool)
    low, high = vertices.min(axis=0) - spacing, vertices.max(axis=0) + spacing
    near = obstacles[((obstacles > low) & (obstacles < high)).all(axis=1)]
    if len(near) == 0:
        return moved
    shape = tuple(int(n) for n in np.ceil((high - low) / spacing) + 2)
    grid = BandGrid(low, spacing, shape, np.eye(3))
    cell = grid.cells(vertices[faces].mean(axis=1))
    order = np.argsort(cell, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=int(np.prod(shape))))])
    where = grid.cells(near)
    for _ in range(rounds):
        if not _push_loop(
            vertices, faces, near, where, order, start, grid.strides, spacing, tolerance, moved
        ):
            break
    return moved


@numba.njit(cache=True, nogil=True)
def _push_loop(vertices, faces, points, where, order, start, strides, reach, tolerance, moved):
    """One pass over the points in ``where >= 0``; returns how many had to be pushed off.

    Points that are well outside are taken off the list (where = -1).
    """
    number = 0
    weight, normal = np.empty(3), np.empty(3)
    best_weight, best_normal = np.empty(3), np.empty(3)
    far = (3.0 * reach) ** 2
    for p in range(len(points)):
        if where[p] < 0:
            continue
        best, least, signed = -1, reach, -reach
        for i in range(-1, 2):
            for j in range(-1, 2):
                # The three cells along the last axis lie side by side.
                cell = where[p] + i * strides[0] + j * strides[1]
                first, last = max(cell - 1, 0), min(cell + 2, len(start) - 1)
                if last <= first:
                    continue
                for n in range(start[first], start[last]):
                    square = 0.0
                    for c in range(3):
                        square += (points[p, c] - vertices[faces[order[n], 0], c]) ** 2
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
        if signed <= tolerance or signed > 0.35 * reach:
            continue
        number += 1
        square = best_weight[0] ** 2 + best_weight[1] ** 2 + best_weight[2] ** 2
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            for c in range(3):
                vertices[v, c] -= best_normal[c] * (signed - 0.5 * tolerance) * best_weight[k] / square
    return number


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
