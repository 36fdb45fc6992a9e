"""Chords that cut through a convex bone: vertices of the surface moved until no bone vertex is inside it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.jit import compiled

# Points with their pose (4, 4) to the world.
Obstacles = list[tuple[Floats, Floats]]

# A chord is never farther from its surface than this share of a cell.
CHORD = 0.35
# The middle of a triangle right above or below a point is less than so many cells away; so many of them are looked at.
NEAR, TRIANGLES = 1.3, 16


def points_near_faces(obstacles: Obstacles, vertices: Floats, faces: Integers, spacing: float) -> Floats:
    """Obstacle points near triangles.

    Parameters
    ----------
    obstacles : list of pairs of (k, 3) and (4, 4) ndarrays
        Points, and the pose that takes them to the world.
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    spacing : float
        No corner is farther than this from its triangle's middle, nearly [scene unit].

    Returns
    -------
    (p, 3) ndarray
        In the world, in the order given.
    """
    middle = vertices[faces].mean(axis=1)
    reach = NEAR * spacing
    found = [np.zeros((0, 3))]
    for points, pose in obstacles:
        local = (middle - pose[:3, 3]) @ pose[:3, :3]
        rows = np.arange(len(points))
        for axis, along in enumerate(local.T):
            x = points[rows, axis]
            rows = rows[(x >= along.min() - reach) & (x <= along.max() + reach)]
        found.append(points[rows] @ pose[:3, :3].T + pose[:3, 3])
    near = np.concatenate(found)
    return near[np.isfinite(cKDTree(middle).query(near, distance_upper_bound=reach)[0])]


def push_off_points(
    vertices: Floats, faces: Integers, points: Floats, spacing: float, tolerance: float, rounds: int = 4
) -> Booleans:
    """Move the vertices of triangles that obstacle points have come through, into the surface.

    A point behind a triangle (inside the mesh) by more than ``tolerance`` moves its three corners along the
    normal, by barycentric weights, until it is not. Points deeper than ``CHORD`` of the spacing are left alone: they
    are behind another part of the muscle.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Changed in place [scene unit].
    faces : (m, 3) ndarray
        Outward.
    points : (k, 3) ndarray
        Points that must stay outside.
    spacing : float
        As for `points_near_faces`.
    tolerance : float
        [scene unit]

    Returns
    -------
    (n,) ndarray of bool
        Vertices that were moved.
    """
    moved = np.zeros(len(vertices), dtype=np.bool_)
    if len(points) == 0:
        return moved
    tree = cKDTree(vertices[faces].mean(axis=1))
    near = tree.query(points, k=np.arange(1, TRIANGLES + 1), distance_upper_bound=NEAR * spacing)[1]
    for _ in range(rounds):
        if not _push_loop(vertices, faces, points, near, spacing, tolerance, moved):
            break
    return moved


@compiled(error_model="numpy")
def _push_loop(vertices, faces, points, near, spacing, tolerance, moved):
    """One pass over the points; returns whether any had to be pushed off. ``near`` ends at the number of faces."""
    pushed = False
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, least, signed = -1, spacing, -spacing
        for f in near[p]:
            if f == len(faces):
                break
            depth = _depth_behind(vertices, faces, f, x, y, z)
            if abs(depth) < least:
                best, least, signed = f, abs(depth), depth
        if signed <= tolerance or signed > CHORD * spacing:
            continue
        pushed = True
        nx, ny, nz, square, _, at_b, at_c = _shadow(vertices, faces, best, x, y, z)
        weight = 1.0 - (at_b + at_c) / square, at_b / square, at_c / square
        # Half the tolerance is left, so that rounding does not ask for another round.
        way = (
            (signed - 0.5 * tolerance) / (weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2) / np.sqrt(square)
        )
        for k in range(3):
            v = faces[best, k]
            moved[v] = True
            vertices[v, 0] -= nx * way * weight[k]
            vertices[v, 1] -= ny * way * weight[k]
            vertices[v, 2] -= nz * way * weight[k]
    return pushed


@compiled(error_model="numpy", inline="always")
def _shadow(vertices, faces, f, x, y, z):
    """Normal of a triangle, its square, the height of a point above it, and twice the areas at B and C.

    The areas are those of the point's shadow in the triangle's plane, times the length of the normal, as the height is.
    """
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    px, py, pz = x - ax, y - ay, z - az
    at_b = nx * (py * vz - pz * vy) + ny * (pz * vx - px * vz) + nz * (px * vy - py * vx)
    at_c = nx * (uy * pz - uz * py) + ny * (uz * px - ux * pz) + nz * (ux * py - uy * px)
    return nx, ny, nz, nx * nx + ny * ny + nz * nz, nx * px + ny * py + nz * pz, at_b, at_c


@compiled(error_model="numpy")
def _depth_behind(vertices, faces, f, x, y, z):
    """How far a point lies behind a triangle; infinite if beside it."""
    _, _, _, square, height, at_b, at_c = _shadow(vertices, faces, f, x, y, z)
    least = -1e-9 * square
    if square == 0.0 or at_b < least or at_c < least or square - at_b - at_c < least:
        return np.inf
    return -height / np.sqrt(square)
