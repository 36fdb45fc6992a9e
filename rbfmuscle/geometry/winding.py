"""How often a mesh winds around a point: once inside a closed one, not at all outside."""

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.jit import compiled


def inside_test(vertices: Floats, faces: Integers) -> Callable[[Floats], Booleans]:
    """``inside(points) -> (n,) bool`` by fast generalised winding numbers (Barill 2018), for meshes with holes too."""
    import igl

    tree = igl.FastWindingNumberBVH()
    tree.init(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), 2)

    def inside(points: Floats) -> Booleans:
        return tree.winding_number(np.ascontiguousarray(points)) > 0.5

    return inside


@compiled
def wound_around(points, vertices, faces, found):
    """Mark in ``found`` (n,) the points that the mesh winds around: those inside, also where it is folded.

    The winding number is the sum of the triangles' solid angles (van Oosterom 1983).
    """
    for n in range(len(points)):
        total = 0.0
        for f in range(len(faces)):
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            ax, ay, az = a[0] - points[n, 0], a[1] - points[n, 1], a[2] - points[n, 2]
            bx, by, bz = b[0] - points[n, 0], b[1] - points[n, 1], b[2] - points[n, 2]
            cx, cy, cz = c[0] - points[n, 0], c[1] - points[n, 1], c[2] - points[n, 2]
            p = np.sqrt(ax * ax + ay * ay + az * az)
            q = np.sqrt(bx * bx + by * by + bz * bz)
            r = np.sqrt(cx * cx + cy * cy + cz * cz)
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            below = p * q * r + (ax * bx + ay * by + az * bz) * r
            below += (bx * cx + by * cy + bz * cz) * p + (cx * ax + cy * ay + cz * az) * q
            total += np.arctan2(triple, below)
        found[n] = total > np.pi
