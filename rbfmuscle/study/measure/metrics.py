"""What is measured of every written frame, in long form."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.geometry.threads import each
from rbfmuscle.sim.joints.skeleton import all_coordinates
from rbfmuscle.sim.scene.motion import shown_value
from rbfmuscle.study.measure.centreline import Centreline, MuscleAtRest, moving_joints
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.study.measure.penetration import BoneProbe, bone_depth, surface_depth
from rbfmuscle.study.measure.quantities import ALL, FIBRES, QUANTITIES, Row, unit_text
from rbfmuscle.study.measure.topology import SurfaceForm

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.frame import Frame
    from rbfmuscle.sim.scene.scene import Scene


_FROM_MODEL = ("solver_penetration_max", "unfitted_fraction", "condition", "time_fit", "time_extract")

# Events whose points stayed beyond a bone; those turned back or halved away are in events.csv only.
_THROUGH = ("reported", "unresolved")


class MetricsRecorder:
    """Measures frames one by one; memory does not grow with surfaces.

    Parameters
    ----------
    scene : Scene
    carried : dict of str to (vertices, faces)
        Each model's carried mesh at rest, before the motion.
    """

    def __init__(self, scene: Scene, carried: dict[str, Any]) -> None:
        self.scene, self.units = scene, scene.units
        self.motion = scene.motion
        self.probes = [BoneProbe(bone.name, bone.mesh) for bone in scene.bones]
        self.trackers = {
            muscle.name: _Tracker(muscle, scene, *carried[muscle.name])
            for muscle in scene.muscles
            if muscle.name in carried
        }
        self._path = []
        self._waiting = []

    def add(self, frame: Frame) -> list[Any]:
        """Measure a frame.

        Parameters
        ----------
        frame : Frame

        Returns
        -------
        list of Row
            Rows of the frame before, which is complete once its successor is known (moment arms).
        """
        coordinate, angle = self._leading(frame)
        at_rest = all(np.abs(pose - np.eye(4)).max() < 1e-9 for pose in frame.poses.values())
        rows = []
        trackers = list(self.trackers.values())
        measured = each(lambda tracker: tracker.measure(frame, self.probes, at_rest), trackers)
        for name, found in zip(self.trackers, measured):
            rows += [self._row(frame, coordinate, angle, name, q, v) for q, v in found.items()]
        if self.motion.times is not None:
            now = self.motion.times[frame.index]
            rows.append(self._row(frame, coordinate, angle, ALL, "time", now))
        rows.append(self._row(frame, coordinate, angle, ALL, "time_frame", frame.wall))
        lengths = {name: tracker.length for name, tracker in self.trackers.items()}
        lengths.update({(FIBRES, name): lines.lengths for name, lines in frame.fibres.items()})
        self._path = [*self._path[-2:], (dict(frame.coordinates), lengths, frame.index)]
        done = self._waiting + (self._arms(len(self._path) - 2) if self._waiting else [])
        self._waiting = rows
        return done

    def state(self) -> dict[str, Any]:
        """What `go_on` needs behind the frame measured last."""
        path = [(coordinates, list(lengths.items()), index) for coordinates, lengths, index in self._path]
        return {
            "path": path,
            "waiting": self._waiting,
            "trackers": {name: tracker.state() for name, tracker in self.trackers.items()},
        }

    def go_on(self, state: dict[str, Any]) -> None:
        """Take over what another recorder knew."""
        self._path = [(coordinates, dict(lengths), index) for coordinates, lengths, index in state["path"]]
        self._waiting = [Row(*row) for row in state["waiting"]]
        for name, found in state["trackers"].items():
            self.trackers[name].go_on(found)

    def finish(self) -> list[Row]:
        """Rows of the last frame."""
        done = self._waiting + (self._arms(len(self._path) - 1) if self._waiting else [])
        self._waiting = []
        return done

    def _arms(self, here):
        coordinates, _, index = self._path[here]
        unit = unit_text("length", self.units)
        rows = []
        for muscle, tracker in self.trackers.items():
            rows += tracker.arms.pop(index, [])
            by_difference = [] if tracker.nudged else moment_arms([n[:2] for n in self._path], here, muscle)
            for name, arm in by_difference:
                angle = shown_value(self.scene, name, coordinates.get(name, 0.0))
                rows.append(Row(index, name, angle, muscle, "moment_arm", arm, unit))
            if (FIBRES, muscle) not in self._path[here][1]:
                continue
            for name, arms in moment_arms([node[:2] for node in self._path], here, (FIBRES, muscle)):
                angle = shown_value(self.scene, name, coordinates.get(name, 0.0))
                for quantity, value in (("mean", np.mean(arms)), ("std", np.std(arms))):
                    quantity = f"fibre_moment_arm_{quantity}"
                    rows.append(Row(index, name, angle, muscle, quantity, float(value), unit))
        return rows

    def _row(self, frame, coordinate, angle, muscle, quantity, value):
        unit = unit_text(QUANTITIES[quantity][0], self.units)
        return Row(frame.index, coordinate, angle, muscle, quantity, float(value), unit)

    def _leading(self, frame):
        """The coordinate that moved most to reach this frame, and its angle [degree]."""
        before = self._path[-1][0] if self._path else {}
        names = self.motion.coordinates or list(frame.coordinates)
        if not names:
            return "", 0.0
        moved = {n: abs(frame.coordinates.get(n, 0.0) - before.get(n, 0.0)) for n in names}
        name = max(names, key=moved.get) if self._path else names[0]
        return name, shown_value(self.scene, name, frame.coordinates.get(name, 0.0))


class _Tracker:
    """What has to be kept of one muscle from frame to frame."""

    def __init__(self, muscle: Any, scene: Any, vertices: Floats, faces: Integers) -> None:
        self.name = muscle.name
        self.rest_volume = float(muscle.mesh.volume)
        self.mesh = muscle.mesh
        self.edges = unique_edges(faces)
        self.rest_lengths = edge_lengths(vertices, self.edges)
        has_line = len(muscle.attachments) > 1
        rest = MuscleAtRest(muscle, scene.joints, vertices, faces, moving_joints(scene))
        self.line = Centreline(rest) if has_line else None
        self.contraction = _contraction(rest)
        self.length = math.nan
        self.rest_measured = False
        output = getattr(scene, "output", None)
        self.nudged = output is not None and bool(output.moment_arms) and has_line
        # By frame, until the frame's rows are complete.
        self.arms = {}
        self.scene = scene
        self.offset = None
        self.form = SurfaceForm()

    def state(self) -> tuple[Any, ...]:
        return self.length, self.rest_measured, self.offset, list(self.arms.items())

    def go_on(self, state: tuple[Any, ...]) -> None:
        self.length, self.rest_measured, self.offset, arms = state
        self.arms = {frame: [Row(*row) for row in rows] for frame, rows in arms}

    def length_of(self, frame: Frame) -> float:
        if self.line is None:
            return math.nan
        return self.line.length(frame.carried[self.name][0], frame.poses)

    def measure(self, frame: Frame, probes: list[BoneProbe], at_rest: bool) -> dict[str, float]:
        """Quantities of this muscle in a frame, in the order of `QUANTITIES`."""
        found = {}
        if self.name in frame.surfaces:
            surface = frame.surfaces[self.name]
            found.update(self._of_surface(surface, frame, probes, at_rest and not self.rest_measured))
            self.rest_measured = self.rest_measured or at_rest
            found.update({q: surface.quantities[q] for q in _FROM_MODEL if q in surface.quantities})
        mine = [event for event in frame.events if event.muscle == self.name]
        found["tunnelled"] = sum(event.count for event in mine if event.action in _THROUGH)
        found["edge_strain_rms"] = edge_strain(frame.carried[self.name][0], self.edges, self.rest_lengths)
        self.length = self.length_of(frame)
        if self.line is not None:
            found["length"] = self.length
        if self.nudged:
            self.arms[frame.index] = self._nudged_arms(frame)
        if self.contraction is not None:
            found["activation"] = frame.activations[self.name]
            surface = frame.surfaces.get(self.name)
            found.update(self.contraction.measure(frame.carried[self.name][0], frame.poses, surface))
        if self.name in frame.fibres:
            lengths = frame.fibres[self.name].lengths
            found.update(fibre_length_mean=np.mean(lengths), fibre_length_std=np.std(lengths))
        times = frame.times.get(self.name, {})
        if times:
            found["time_solve"] = times.get("time_predict", 0.0) + times.get("time_solve", 0.0)
            found["time_frame"] = times["time_frame"]
        return {quantity: found[quantity] for quantity in QUANTITIES if quantity in found}

    def _nudged_arms(self, frame):
        """A row for each coordinate that moves the muscle: minus the change of length with it."""
        facts, rows = all_coordinates(self.scene.joints), []
        for name, (span, below, above) in frame.nudged.get(self.name, {}).items():
            arm = -(self.line.length(*above) - self.line.length(*below)) / span
            unit = "1" if facts[name].motion == "translation" else self.scene.units
            value = shown_value(self.scene, name, frame.coordinates.get(name, facts[name].rest))
            rows.append(Row(frame.index, name, value, self.name, "moment_arm", arm, unit))
        return rows

    def _of_surface(self, surface, frame, probes, first_rest):
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        volume = mesh_volume(vertices, faces)
        distance = MeshDistance(vertices, faces)
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
    from rbfmuscle.study.measure.contraction import ContractionStudy

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


def moment_arms(
    path: list[tuple[dict[str, Any], dict[Any, Any]]], here: int, muscle: str | tuple[str, str]
) -> list[Any]:
    """Tendon-excursion moment arms -dl/dq at one place of a path.

    Parameters
    ----------
    path : list of (coordinates, lengths)
        Neighbouring frames in order: angles [radian] by coordinate, lengths [scene unit] by muscle; a length
        may be an array, of fibres.
    here : int
        Place in the path.
    muscle : str

    Returns
    -------
    list of (coordinate, arm)
        [scene unit per radian]. Central where the coordinate goes on in one direction, else one-sided. Two
        frames between which several coordinates change cannot tell them apart and give none.
    """
    slopes = defaultdict(list)
    for k in (here - 1, here):
        if not 0 <= k < len(path) - 1:
            continue
        (q0, l0), (q1, l1) = path[k], path[k + 1]
        changed = [n for n in {*q0, *q1} if abs(q1.get(n, 0.0) - q0.get(n, 0.0)) > 1e-9]
        if len(changed) == 1 and np.isfinite(l0[muscle]).all() and np.isfinite(l1[muscle]).all():
            step = q1.get(changed[0], 0.0) - q0.get(changed[0], 0.0)
            slopes[changed[0]].append((step, (l1[muscle] - l0[muscle]) / step))
    return [(name, -_combine(found)) for name, found in slopes.items()]


def _combine(slopes):
    """Second-order derivative from the slopes on both sides; the earlier one alone at a turning point."""
    if len(slopes) == 1 or slopes[0][0] * slopes[1][0] < 0:
        return slopes[0][1]
    (a, left), (b, right) = slopes
    return (b * left + a * right) / (a + b)
