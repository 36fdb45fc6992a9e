"""What is measured of every muscle in a written frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import Layout
from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.centreline import Centreline, MuscleAtRest, moving_joints
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.metrics.penetration import BoneProbe, bone_depth, surface_depth
from rbfmuscle.metrics.quantities import QUANTITIES
from rbfmuscle.metrics.topology import SurfaceForm

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.frame import Frame


_FROM_MODEL = ("solver_penetration_max", "unfitted_fraction", "condition", "time_fit", "time_extract")

# Events whose points stayed beyond a bone; those turned back or halved away are in events.csv only.
_THROUGH = ("reported", "unresolved")


class Measured(NamedTuple):
    """What was measured of one muscle in a frame.

    Attributes
    ----------
    values : dict of str to float
        By quantity, in the order of `QUANTITIES`.
    length : float
        Along its centreline [scene unit], NaN where it has none.
    """

    values: dict[str, float]
    length: float


class MuscleMeasures:
    """Measures muscles frame by frame; memory does not grow with surfaces.

    Parameters
    ----------
    scene : Scene
    carried : dict of str to (vertices, faces)
        Carried meshes at rest, before the motion, of the models that are measured here.
    """

    def __init__(self, scene: Scene, carried: dict[str, Any]) -> None:
        self.probes = [BoneProbe(bone.name, bone.mesh) for bone in scene.bones]
        self.trackers = {
            muscle.name: _Tracker(muscle, scene, *carried[muscle.name])
            for muscle in scene.muscles
            if muscle.name in carried
        }

    def measure(self, frame: Frame) -> dict[str, Measured]:
        """Measure a frame: dict of muscle name to Measured."""
        at_rest = all(np.abs(pose - np.eye(4)).max() < 1e-9 for pose in frame.poses.values())
        trackers = list(self.trackers.values())
        found = each(lambda tracker: tracker.measure(frame, self.probes, at_rest), trackers)
        return dict(zip(self.trackers, found))


class _Tracker:
    """What has to be kept of one muscle from frame to frame."""

    def __init__(self, muscle: Any, scene: Any, vertices: Floats, faces: Integers) -> None:
        self.name = muscle.name
        self.rest_volume = float(muscle.mesh.volume)
        self.mesh = muscle.mesh
        self.edges = unique_edges(faces)
        self.rest_lengths = edge_lengths(vertices, self.edges)
        rest = MuscleAtRest(muscle, scene.joints, vertices, faces, moving_joints(scene))
        self.line = Centreline(rest) if len(muscle.attachments) > 1 else None
        self.contraction = _contraction(rest)
        self.rest_measured = False
        self.offset = None
        self.form = SurfaceForm()
        # Of the last surface: its faces, and what its distance can be had quicker with while they stay.
        self.layout: tuple[Integers, Layout] | None = None

    def length_of(self, frame: Frame) -> float:
        if self.line is None:
            return math.nan
        return self.line.length(frame.carried[self.name][0], frame.poses)

    def measure(self, frame: Frame, probes: list[BoneProbe], at_rest: bool) -> Measured:
        """What there is to measure of this muscle in a frame."""
        found = {}
        if self.name in frame.surfaces:
            surface = frame.surfaces[self.name]
            found.update(self._of_surface(surface, frame, probes, at_rest and not self.rest_measured))
            self.rest_measured = self.rest_measured or at_rest
            found.update({q: surface.quantities[q] for q in _FROM_MODEL if q in surface.quantities})
        mine = [event for event in frame.events if event.muscle == self.name]
        found["tunnelled"] = sum(event.count for event in mine if event.action in _THROUGH)
        found["edge_strain_rms"] = edge_strain(frame.carried[self.name][0], self.edges, self.rest_lengths)
        length = self.length_of(frame)
        if self.line is not None:
            found["length"] = length
        if self.contraction is not None:
            found["activation"] = frame.activations[self.name]
            surface = frame.surfaces.get(self.name)
            found.update(self.contraction.measure(frame.carried[self.name][0], frame.poses, surface))
        times = frame.times.get(self.name, {})
        if times:
            found["time_solve"] = times.get("time_predict", 0.0) + times.get("time_solve", 0.0)
            found["time_frame"] = times["time_frame"]
        values = {quantity: found[quantity] for quantity in QUANTITIES if quantity in found}
        return Measured(values, length)

    def _of_surface(self, surface, frame, probes, first_rest):
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        volume = mesh_volume(vertices, faces)
        known = self.layout is not None and np.array_equal(self.layout[0], faces)
        distance = MeshDistance(vertices, faces, layout=self.layout[1] if known else None)
        self.layout = faces, distance.layout
        depth = surface_depth(vertices, probes, frame.poses)
        found = {
            "volume": volume,
            "volume_error": volume / self.rest_volume - 1.0,
            "penetration_max": depth.max(),
            "penetration_fraction": np.mean(depth > 0.0),
            "bone_penetration_max": bone_depth(vertices, faces, probes, frame.poses, distance=distance),
            **self.form.measure(surface),
        }
        found["flicker_rms"], found["flicker_max"] = self._flicker(distance, frame.carried[self.name][0])
        if first_rest:
            rms, worst = surface_distance(vertices, faces, self.mesh.vertices, self.mesh.faces)
            found.update(rest_error_rms=rms, rest_error_max=worst)
        return found

    def _flicker(self, distance, carried):
        """Change of the signed distances of the carried mesh's vertices to the surface since the last frame."""
        before = self.offset
        self.offset = distance.signed(carried)
        change = self.offset - before if before is not None else np.zeros(1)
        return float(np.sqrt(np.mean(change**2))), float(np.abs(change).max())


def _contraction(rest):
    if rest.muscle.contraction is None:
        return None
    from rbfmuscle.metrics.contraction import ContractionStudy

    return ContractionStudy(rest)


def edge_strain(vertices: Floats, edges: Integers, rest_lengths: Floats) -> float:
    """Root mean square of the relative change of edge lengths."""
    used = rest_lengths > 0
    strain = edge_lengths(vertices, edges)[used] / rest_lengths[used] - 1.0
    return float(np.sqrt(np.mean(strain**2)))


def surface_distance(
    vertices: Floats, faces: Integers, other_vertices: Floats, other_faces: Integers
) -> tuple[float, float]:
    """Distance between two surfaces, both ways, at their vertices.

    Returns
    -------
    rms, worst : float
        Root of the mean of both directions' mean squares, and the greatest distance of either [scene unit].
    """
    there = MeshDistance(other_vertices, other_faces).unsigned(vertices)
    back = MeshDistance(vertices, faces).unsigned(other_vertices)
    rms = math.sqrt((np.mean(there**2) + np.mean(back**2)) / 2)
    return rms, float(max(there.max(), back.max()))
