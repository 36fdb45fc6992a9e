"""Whether a surface is what a muscle should be: in one piece without handles, and nowhere through itself."""

import numpy as np

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.surfaces import label_sheets
from rbfmuscle.simulation.frame import ModelSurface


def euler_characteristic(faces: Integers) -> int:
    """Vertices less edges plus triangles, of those that faces (m, 3) use; 2 for a sphere, two less for each handle."""
    faces = np.asarray(faces, dtype=np.int64)
    ends = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    edges = np.unique(ends[:, 0] * (faces.max(initial=0) + 1) + ends[:, 1])
    return len(np.unique(faces)) - len(edges) + len(faces)


def count_components(count: int, faces: Integers) -> int:
    """Number of connected pieces among ``count`` vertices; vertices that no face uses do not count."""
    return len(np.unique(label_sheets(faces, count)[1][faces[:, 0]]))


class SurfaceForm:
    """Pieces, handles and crossings of one muscle's surfaces, each looked for again only where it can have changed.

    Pieces and handles are those of the faces; crossings stay where a surface is moved rigidly.
    """

    def __init__(self) -> None:
        self._drawn: ModelSurface | None = None
        self._tree: FaceTree | None = None
        self._found: dict[str, float] = {}

    def measure(self, surface: "ModelSurface", *, same_faces: bool) -> dict[str, float]:
        """``components``, ``euler`` and ``self_crossings``; ``same_faces`` where the last surface had these faces."""
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        if self._tree is None or not same_faces:
            self._tree = FaceTree(vertices, faces)
            self._found["components"] = count_components(len(vertices), faces)
            self._found["euler"] = euler_characteristic(faces)
        drawn = surface.origin[0] if surface.origin is not None else surface
        if self._drawn is not drawn:
            self._found["self_crossings"] = int(self._tree.crossing(vertices).sum())
        self._drawn = drawn
        return dict(self._found)
