"""Whether a surface is what a muscle should be: in one piece without handles, and nowhere through itself."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.geometry.crossing import FaceTree, crossing_faces

if TYPE_CHECKING:
    from rbfmuscle.simulation.frame import ModelSurface


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


def self_crossing(vertices: np.ndarray, faces: np.ndarray, tree: FaceTree | None = None) -> Crossings:
    """Triangles that cross others of the same surface, as `rbfmuscle.geometry.crossing.crossing_faces` sees them.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        [scene unit]
    faces : (m, 3) ndarray of int
    tree : FaceTree, optional
        Of these faces, from whatever moment, where it is at hand.
    """
    marked = crossing_faces(vertices, faces) if tree is None else tree.crossing(vertices)
    if not marked.any():
        return Crossings(0, 0.0)
    a, b, c = (np.asarray(vertices)[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = area[marked].sum() / max(area.sum(), np.finfo(float).tiny)
    return Crossings(int(marked.sum()), float(share))


def count_components(count: int, faces: Integers) -> int:
    """Number of connected pieces among ``count`` vertices; vertices that no face uses do not count."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = sparse.coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return len(np.unique(label[faces[:, 0]]))


class SurfaceForm:
    """Pieces, handles and crossings of one muscle's surfaces, each looked for again only where it can have changed.

    Pieces and handles are those of the faces; crossings stay where a surface is moved rigidly.
    """

    def __init__(self) -> None:
        self._drawn: ModelSurface | None = None
        self._faces: np.ndarray | None = None
        self._tree: FaceTree | None = None
        self._pieces: dict[str, float] = {}
        self._crossings: dict[str, float] = {}

    def measure(self, surface: "ModelSurface") -> dict[str, float]:
        """``components``, ``euler``, ``self_crossing`` and ``self_crossing_area``."""
        faces = np.asarray(surface.faces)
        if self._faces is None or not (self._faces is faces or np.array_equal(self._faces, faces)):
            self._tree = FaceTree(surface.vertices, faces)
            self._pieces = {
                "components": count_components(len(surface.vertices), faces),
                "euler": euler_characteristic(faces),
            }
        drawn = surface.origin[0] if surface.origin is not None else surface
        if self._drawn is not drawn:
            found = self_crossing(surface.vertices, faces, self._tree)
            self._crossings = {"self_crossing": found.count, "self_crossing_area": found.area}
        self._faces, self._drawn = faces, drawn
        return {**self._pieces, **self._crossings}
