"""Vertices of a closed surface around which no triangle covers another."""

import numpy as np

from rbfmuscle.geometry.triangles import triangle_normal
from rbfmuscle.jit import compiled


@compiled(error_model="numpy")
def plain_loop(vertices, faces, plain):
    """Unmark the vertices whose triangles do not lie side by side when seen along the mean normal
    there.

    Of a closed surface these triangles are a ring around the vertex. Where all of them are seen
    from outside and the ring goes round once, none covers another, so no two of them cross.
    """
    areas, normals = np.empty((len(faces), 3)), np.zeros_like(vertices)
    for f in range(len(faces)):
        x, y, z = triangle_normal(vertices, faces, f)
        areas[f, 0] = x
        areas[f, 1] = y
        areas[f, 2] = z
        for k in range(3):
            v = faces[f, k]
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    across = _across_loop(normals)
    square = np.empty(len(vertices))
    turns = np.zeros(len(vertices))
    for v in range(len(vertices)):
        square[v] = normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2
    for f in range(len(faces)):
        x = areas[f, 0]
        y = areas[f, 1]
        z = areas[f, 2]
        least = 1e-12 * (x * x + y * y + z * z)
        for k in range(3):
            v = faces[f, k]
            p = faces[f, (k + 1) % 3]
            q = faces[f, (k + 2) % 3]
            along = x * normals[v, 0] + y * normals[v, 1] + z * normals[v, 2]
            plain[v] &= (along > 0.0) & (along * along > least * square[v])
            # The side of a plane through the normal that a neighbour lies on: once round, once from
            # below to above.
            below, above = 0.0, 0.0
            for a in range(3):
                below += across[v, a] * (vertices[p, a] - vertices[v, a])
                above += across[v, a] * (vertices[q, a] - vertices[v, a])
            turns[v] += np.float64((below < 0.0) & (above >= 0.0))
    for v in range(len(plain)):
        plain[v] &= turns[v] == 1.0


@compiled(error_model="numpy")
def _across_loop(normals):
    """A vector (n, 3) at a right angle to each normal."""
    across = np.zeros_like(normals)
    for v in range(len(normals)):
        x = abs(normals[v, 0])
        y = abs(normals[v, 1])
        z = abs(normals[v, 2])
        a = 0 if x <= y and x <= z else (1 if y <= z else 2)
        b, c = (a + 1) % 3, (a + 2) % 3
        across[v, b], across[v, c] = normals[v, c], -normals[v, b]
    return across
