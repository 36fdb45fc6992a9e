"""How often a mesh winds around a point: once inside a closed one, not at all outside."""

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers


def inside_test(vertices: Floats, faces: Integers) -> Callable[[Floats], Booleans]:
    """``inside(points) -> (n,) bool`` by fast generalised winding numbers (Barill 2018), for meshes with holes too."""
    import igl

    tree = igl.FastWindingNumberBVH()
    tree.init(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64), 2)

    def inside(points: Floats) -> Booleans:
        return tree.winding_number(np.ascontiguousarray(points)) > 0.5

    return inside
