"""Rings of triangles around the vertices of a closed surface, and where none covers another."""

import numpy as np

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.loops import loop


def vertex_rings(faces: Integers, opposite: Integers, count: int) -> tuple[Integers, Integers]:
    """Neighbours of each of ``count`` vertices of a closed surface in the order of the triangles
    between them: those of vertex v are ``other[start[v] : start[v + 1]]``.

    ``opposite`` are the opposite half-edges (3m,). A vertex at which several rings meet has none.
    """
    tail = faces.ravel()
    # From a half-edge to the next one that begins at the same vertex.
    half_edges = np.arange(len(tail))
    beside = opposite[half_edges - half_edges % 3 + (half_edges + 2) % 3]
    first = np.full(count, -1)
    first[tail] = half_edges
    walks, used = np.flatnonzero(first >= 0), np.bincount(tail, minlength=count)
    now = first[walks]
    rows, steps = [], []
    while len(walks):
        rows.append(walks)
        steps.append(now)
        now = beside[now]
        going = now != first[walks]
        walks, now = walks[going], now[going]
    row = np.concatenate([np.zeros(0, np.int64), *rows])
    step = np.concatenate([np.zeros(0, np.int64), *steps])
    whole = (np.bincount(row, minlength=count) == used)[row]
    row, step = row[whole], step[whole]
    order = np.argsort(row, kind="stable")
    start = np.searchsorted(row[order], np.arange(count + 1))
    return start, np.roll(faces, -1, axis=1).ravel()[step[order]]


@loop
def plain_loop(vertices, start, other, plain):
    """Mark (n,) the vertices whose triangles lie side by side when seen along the mean normal
    there; ``start`` and ``other`` are `vertex_rings`.

    Where all triangles of a ring are seen from outside and the ring goes round once, none covers
    another, so no two of them cross.
    """
    most = 0
    for v in range(len(plain)):
        most = max(most, start[v + 1] - start[v])
    sides, normals = np.empty((most + 1, 3)), np.empty((most, 3))
    for v in range(len(plain)):
        count = start[v + 1] - start[v]
        for k in range(count):
            n = other[start[v] + k]
            for a in range(3):
                sides[k, a] = vertices[n, a] - vertices[v, a]
        for a in range(3):
            sides[count, a] = sides[0, a]
        plain[v] = count > 0 and _side_by_side(sides, normals, count)


@loop
def _side_by_side(sides, normals, count):
    """Whether a ring of triangles between some sides, of which the last is the first again, goes
    round once, all seen from outside.
    """
    x = 0.0
    y = 0.0
    z = 0.0
    for k in range(count):
        normals[k, 0] = sides[k, 1] * sides[k + 1, 2] - sides[k, 2] * sides[k + 1, 1]
        normals[k, 1] = sides[k, 2] * sides[k + 1, 0] - sides[k, 0] * sides[k + 1, 2]
        normals[k, 2] = sides[k, 0] * sides[k + 1, 1] - sides[k, 1] * sides[k + 1, 0]
        x += normals[k, 0]
        y += normals[k, 1]
        z += normals[k, 2]
    # A vector at a right angle to the mean normal: the ring goes from below to above it once.
    least = min(abs(x), abs(y), abs(z))
    u, v, w = (0.0, z, -y) if abs(x) == least else ((-z, 0.0, x) if abs(y) == least else (y, -x, 0))
    square = 1e-12 * (x * x + y * y + z * z)
    turns, outside = 0, True
    above = u * sides[0, 0] + v * sides[0, 1] + w * sides[0, 2] >= 0.0
    for k in range(count):
        nx = normals[k, 0]
        ny = normals[k, 1]
        nz = normals[k, 2]
        along = nx * x + ny * y + nz * z
        outside &= (along > 0.0) & (along * along > square * (nx * nx + ny * ny + nz * nz))
        below = not above
        above = u * sides[k + 1, 0] + v * sides[k + 1, 1] + w * sides[k + 1, 2] >= 0.0
        turns += below & above
    return outside & (turns == 1)
