"""Meshes with fewer triangles, for looks and for guesses."""

import igl
import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers


def simplified(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """A closed mesh of about as many triangles as wanted, near the given one; one that has no more
    as it is.

    Edges collapse in the order of their quadric error (Garland and Heckbert 1997, "Surface
    simplification using quadric error metrics"). A mesh that is not manifold, or that cannot
    collapse so far, as one of many parts, is `clustered`.
    """
    vertices, faces = np.array(vertices, dtype=float), np.array(faces, dtype=np.int64)
    if len(faces) <= count:
        return vertices, faces
    if not igl.is_edge_manifold(faces)[0]:
        return clustered(vertices, faces, count)
    fewer, kept, _, _ = igl.qslim(vertices, faces, count)
    if not len(kept):  # so it says that it cannot
        return clustered(vertices, faces, count)
    return np.ascontiguousarray(fewer), np.ascontiguousarray(kept)


def clustered(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """A mesh of about as many triangles as wanted, with holes and doubled edges; one that has no
    more as it is.

    Takes any mesh of any size. The vertices of each cell of a grid become their mean (Rossignac and
    Borrel 1993, "Multi-resolution 3D approximations for rendering complex scenes").
    """
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    if len(faces) <= count:
        return vertices, faces
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    cells = np.floor((vertices - vertices.min(axis=0)) / np.sqrt(2.0 * area / count)).astype(
        np.int64
    )
    keys = np.ravel_multi_index(cells.T, cells.max(axis=0) + 1)
    _, place, members = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(place, vertices[:, k]) / members for k in range(3)], axis=1)
    new = place[faces]
    return means, new[(new != np.roll(new, 1, axis=1)).all(axis=1)]
