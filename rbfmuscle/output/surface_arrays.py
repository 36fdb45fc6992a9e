"""Numbers at the vertices of a run's surfaces, to colour them by."""

from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.surfaces import EdgeStretch
from rbfmuscle.output.appearance import muscle_groups
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame, Mesh

FARTHEST = 20.0  # distance to the bones that is told from others [mm]


class VertexArrays:
    """The number of a muscle's ``group``, and ``stretch``, the mean change of the edges about each
    vertex against the first mesh, where the triangles are the same.
    """

    def __init__(self, first: Mesh, group: int) -> None:
        self._faces = first[1]
        self._group = float(group)
        self._stretch = EdgeStretch(*first)

    def of(self, mesh: Mesh) -> dict[str, Floats]:
        """Arrays (n,) of a mesh."""
        vertices, faces = mesh
        found = {"group": np.full(len(vertices), self._group)}
        if faces is self._faces or np.array_equal(faces, self._faces):
            found["stretch"] = self._stretch(vertices)
        return found


class RunArrays:
    """Arrays at the vertices of each muscle of a scene, frame by frame.

    Those of `VertexArrays` against the first frame; ``bone_distance`` to the nearest bone that the
    muscle can reach, negative inside, 20 mm at most [scene unit]; and what its model adds, as
    ``level_offset``.
    """

    def __init__(self, scene: Scene) -> None:
        held = {m.name: [end.bone for end in m.attachments] for m in scene.muscles}
        groups = muscle_groups(scene.joints, held)
        numbers = sorted(set(groups.values()))
        self._groups = {name: numbers.index(group) for name, group in groups.items()}
        self._farthest = from_mm(FARTHEST, scene.units)
        self._first: dict[str, VertexArrays] = {}

    def of(self, frame: Frame, name: str) -> Mapping[str, Floats]:
        """Arrays (n,) of a muscle; no distance where no bone is in reach."""
        surface = frame.surfaces[name]
        mesh = surface.vertices, surface.faces
        if name not in self._first:
            self._first[name] = VertexArrays(mesh, self._groups[name])
        found = self._first[name].of(mesh)
        bones = frame.bones.get(name)
        if bones is not None and bones.names:
            distance = bones.distance(surface.vertices, frame.poses, self._farthest)
            found["bone_distance"] = np.minimum(distance, self._farthest)
        return found | dict(surface.arrays)
