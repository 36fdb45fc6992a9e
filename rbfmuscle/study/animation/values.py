"""What can be told of every vertex of a muscle's surface: stretch of the fibres, activation, distance to the bones."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.study.measure.penetration import bone_coordinates
from rbfmuscle.study.show.paint import activations, local_stretch, near_segments
from rbfmuscle.validation import UsageError, did_you_mean

NAMES = ("stretch", "activation", "bone_distance")
# Those that are lengths, and so are converted with the unit.
LENGTHS = ("bone_distance",)


class VertexValues:
    """Values of the vertices of a saved run's surfaces, found where a caller wants to write them.

    Parameters
    ----------
    saved : SavedRun
    names : list of str
        Of `NAMES`. ``stretch`` is that of the nearest fibres, against the run's first frame; ``activation`` that of the
        muscle, 0 where it does not contract; ``bone_distance`` the exact distance to the nearest bone, negative
        inside [scene unit].

    Raises
    ------
    UsageError
        If a name is unknown, or the run did not write what it needs.
    """

    def __init__(self, saved: SavedRun, names: list[str]) -> None:
        for name in names:
            if name not in NAMES:
                raise UsageError(f"unknown value {name!r}, {did_you_mean(name, list(NAMES))}")
        self.saved, self.names = saved, list(names)
        if "stretch" in names and not saved.has_fibres():
            raise UsageError(
                f"{saved.directory} has no fibres to take stretch from: set output.fibres = true in the run's scene"
            )
        self._activation = activations(saved) if "activation" in names else {}
        if "activation" in names and not self._activation:
            raise UsageError(
                f"{saved.directory} has no activation: no muscle contracts, or output.metrics = false"
            )
        self._bones: dict[str, MeshDistance] = {}
        self._shares: dict[str, tuple[int, Integers, Floats]] = {}

    def of(self, muscle: str, frame: int, vertices: Floats, *, factor: float = 1.0) -> dict[str, Floats]:
        """Values (n,) by name of the vertices (n, 3) [scene unit] of a muscle in a frame, lengths times ``factor``."""
        ways: dict[str, Any] = {
            "stretch": self._stretch,
            "activation": self._uniform,
            "bone_distance": self._distance,
        }
        found = {name: ways[name](muscle, frame, vertices) for name in self.names}
        return {name: value * factor if name in LENGTHS else value for name, value in found.items()}

    def _uniform(self, muscle, frame, vertices):
        return np.full(len(vertices), self._activation.get((muscle, frame), 0.0))

    def _distance(self, _muscle, frame, vertices):
        out = np.full(len(vertices), np.inf)
        for bone in self.saved.bones:
            if bone not in self._bones:
                self._bones[bone] = _distance_to(*self.saved.bone(bone))
            local = bone_coordinates(vertices, self.saved.poses[frame][bone])
            np.minimum(out, self._bones[bone].signed(local), out=out)
        return out

    def _stretch(self, muscle, frame, vertices):
        known = self._shares.get(muscle)
        # A surface that keeps its vertices keeps their fibres, so that no colour wanders.
        if known is None or known[0] != len(vertices):
            known = self._shares[muscle] = (
                len(vertices),
                *near_segments(self.saved, muscle, frame, vertices),
            )
        return (local_stretch(self.saved, muscle, frame).ravel()[known[1]] * known[2]).sum(axis=1)


def _distance_to(vertices, faces):
    import trimesh

    closed = trimesh.Trimesh(vertices, faces, process=False).is_watertight
    return MeshDistance(vertices, faces, closed=bool(closed))
