"""Whether a surface is what a muscle should be: in one piece without handles, and nowhere through itself."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.crossing import crossing_faces


class Crossings(NamedTuple):
    """Triangles of a surface that cross others of it.

    Attributes
    ----------
    count : int
        Triangles that take part in a crossing.
    area : float
        Their share of the surface's area.
    """

    count: int  # type: ignore[assignment]  # a field by the name of tuple's own method
    area: float


def euler_characteristic(faces: np.ndarray) -> int:
    """Vertices less edges plus triangles; 2 for a sphere, two less for each handle.

    Parameters
    ----------
    faces : (m, 3) ndarray of int
        Vertices that no triangle uses do not count.
    """
    faces = np.asarray(faces, dtype=np.int64)
    ends = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    edges = np.unique(ends[:, 0] * (faces.max(initial=0) + 1) + ends[:, 1])
    return len(np.unique(faces)) - len(edges) + len(faces)


def self_crossing(vertices: np.ndarray, faces: np.ndarray) -> Crossings:
    """Triangles that cross others of the same surface, as `rbfmuscle.geometry.crossing.crossing_faces` sees them.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        [scene unit]
    faces : (m, 3) ndarray of int
    """
    marked = crossing_faces(vertices, faces)
    a, b, c = np.moveaxis(np.asarray(vertices)[faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = area[marked].sum() / max(area.sum(), np.finfo(float).tiny)
    return Crossings(int(marked.sum()), float(share))
