"""How often a mesh winds around a point: once inside a closed one, not at all outside."""

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.loops import loop


def winding_numbers(vertices: Floats, faces: Integers) -> Callable[[Floats], Floats]:
    """``winding(points) -> (n,)``: fast generalised winding numbers (Barill 2018) of a mesh, which
    may have holes.

    They are computed about the middle of the mesh, as igl's tree has single precision.
    """
    import igl

    middle = vertices.mean(axis=0)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.ascontiguousarray(vertices - middle), np.ascontiguousarray(faces, np.int64), 2)

    def winding(points: Floats) -> Floats:
        return np.asarray(tree.winding_number(np.ascontiguousarray(points - middle)))

    return winding


def inside_test(
    vertices: Floats, faces: Integers, *, least: float = 0.5
) -> Callable[[Floats], Booleans]:
    """``inside(points) -> (n,) bool`` by winding numbers above ``least``, for meshes with holes
    too.
    """
    winding = winding_numbers(vertices, faces)
    return lambda points: winding(points) > least


@loop
def winding_loop(vertices, faces, points, out):
    """Winding numbers (n,) of a few points by the sum over all triangles' solid angles, without a
    tree.

    Van Oosterom & Strackee 1983, "The solid angle of a plane triangle".
    """
    a = np.empty(3)
    b = np.empty(3)
    c = np.empty(3)
    for q in range(len(points)):
        total = 0.0
        for f in range(len(faces)):
            aa = 0.0
            bb = 0.0
            cc = 0.0
            ab = 0.0
            bc = 0.0
            ca = 0.0
            for k in range(3):
                a[k] = vertices[faces[f, 0], k] - points[q, k]
                b[k] = vertices[faces[f, 1], k] - points[q, k]
                c[k] = vertices[faces[f, 2], k] - points[q, k]
                aa += a[k] * a[k]
                bb += b[k] * b[k]
                cc += c[k] * c[k]
                ab += a[k] * b[k]
                bc += b[k] * c[k]
                ca += c[k] * a[k]
            x = np.sqrt(aa)
            y = np.sqrt(bb)
            z = np.sqrt(cc)
            volume = (
                a[0] * (b[1] * c[2] - b[2] * c[1])
                + a[1] * (b[2] * c[0] - b[0] * c[2])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
            )
            total += np.arctan2(volume, x * y * z + ab * z + bc * x + ca * y)
        out[q] = total / (2.0 * np.pi)
