"""What is measured of every muscle in a written frame."""

import math
from typing import Any

import numpy as np
import scipy.sparse as sparse

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.belly import belly_measures
from rbfmuscle.metrics.centreline import Centreline, carried_middle, distance_along, moving_joints, resampled
from rbfmuscle.metrics.geodesic import NODES, shortest_path
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.metrics.penetration import BoneProbe, bone_depth, surface_depth
from rbfmuscle.metrics.quantities import QUANTITIES
from rbfmuscle.metrics.topology import SurfaceForm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame

Values = dict[str, float]

_FROM_MODEL = (
    "solver_penetration_max", "sweeps", "unfitted_fraction", "condition", "time_fit", "time_extract",
)  # fmt: skip

# Events whose points stayed beyond a bone; those turned back or halved away are in events.csv only.
_THROUGH = ("reported", "unresolved")

# Of these the greatest at rest is the overlap that is left there.
_OVERLAPS = ("penetration_max", "bone_penetration_max", "solver_penetration_max")


class MuscleMeasures:
    """Measures muscles frame by frame; memory does not grow with surfaces.

    ``carried`` holds the carried meshes (vertices, faces) at rest, before the motion, of the models that are measured
    here.
    """

    def __init__(self, scene: Scene, carried: dict[str, Any]) -> None:
        self.probes = [BoneProbe(bone.name, bone.mesh) for bone in scene.bones]
        self.trackers = {
            muscle.name: _Tracker(muscle, scene, *carried[muscle.name])
            for muscle in scene.muscles
            if muscle.name in carried
        }

    def measure(self, frame: Frame) -> dict[str, Values]:
        """Measure a frame: for each muscle its values by quantity, in the order of `QUANTITIES`."""
        at_rest = all(np.abs(pose - np.eye(4)).max() < 1e-9 for pose in frame.poses.values())
        trackers = list(self.trackers.values())
        found = each(lambda tracker: tracker.measure(frame, self.probes, at_rest), trackers)
        return dict(zip(self.trackers, found))


class _Tracker:
    """What has to be kept of one muscle from frame to frame."""

    def __init__(self, muscle: Any, scene: Any, vertices: Floats, faces: Integers) -> None:
        self.name, self.mesh, self.attachments = muscle.name, muscle.mesh, muscle.attachments
        self.rest_volume = float(muscle.mesh.volume)
        self.edges = _edge_operator(vertices, faces)
        self.contracts = muscle.contraction is not None
        moving = moving_joints(scene)
        self.line = None
        if len(muscle.attachments) > 1:
            self.line = Centreline(muscle, scene.joints, vertices, faces, moving=moving)
        self.form = SurfaceForm()
        self.rest_measured = False
        # Of the last surface.
        self.distance: MeshDistance | None = None
        self.offset: Floats | None = None
        self.near: Integers | None = None
        # Of the last shortest path, from the points along the centreline.
        self.pulled: Floats | None = None

    def _of_line(self, carried: Floats, probes: list[BoneProbe], frame: Frame) -> dict[str, float]:
        """Length from bone to bone, and of the belly's centreline over the shortest path between its ends."""
        if self.line is None:
            return {}
        line = self.line.points(carried, frame.poses)
        path = shortest_path(line, probes, frame.poses, offset=self.pulled)
        self.pulled = path - resampled(line, NODES - 1) if len(path) == NODES else None
        belly, shortest = distance_along(line)[-1], distance_along(path)[-1]
        length = belly + self.line.tendon_length(frame.tendons)
        return {"length": length, "slack": belly / shortest if shortest > 0.0 else math.nan}

    def measure(self, frame: Frame, probes: list[BoneProbe], at_rest: bool) -> dict[str, float]:
        """What there is to measure of this muscle in a frame."""
        found: dict[str, float] = {}
        carried, surface = frame.carried[self.name][0], frame.surfaces.get(self.name)
        if surface is not None:
            found.update(self._of_surface(surface, carried, probes, frame.poses))
            found.update({q: surface.quantities[q] for q in _FROM_MODEL if q in surface.quantities})
            if at_rest and not self.rest_measured:
                found.update(self._at_rest(surface, probes, frame.poses))
                found["initial_overlap"] = max(found.get(name, 0.0) for name in _OVERLAPS)
                self.rest_measured = True
        mine = [event for event in frame.events if event.muscle == self.name]
        found["tunnelled"] = sum(event.count for event in mine if event.action in _THROUGH)
        edges = self.edges @ carried
        stretch = np.sqrt(np.einsum("ij,ij->i", edges, edges))
        found["edge_strain_rms"] = math.sqrt(np.mean((stretch - 1.0) ** 2))
        found.update(self._of_line(carried, probes, frame))
        if self.contracts:
            found["activation"] = frame.activations[self.name]
            if surface is not None and self.line is not None:
                found.update(self._section(surface.vertices, surface.faces, frame.poses))
        times = frame.times.get(self.name, {})
        if times:
            found["time_solve"] = times.get("time_predict", 0.0) + times.get("time_solve", 0.0)
            found["time_frame"] = times["time_frame"]
        return {quantity: float(found[quantity]) for quantity in QUANTITIES if quantity in found}

    def _of_surface(self, surface, carried, probes, poses):
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        # Surfaces that keep their faces share the order of the tree.
        same = self.distance is not None and np.array_equal(self.distance.faces, faces)
        layout = self.distance.layout if same else None
        self.distance = MeshDistance(vertices, faces, layout=layout)
        volume = mesh_volume(vertices, faces)
        depth = surface_depth(vertices, probes, poses)
        return {
            "volume": volume,
            "volume_error": volume / self.rest_volume - 1.0,
            "penetration_max": depth.max(),
            "penetration_fraction": np.mean(depth > 0.0),
            "bone_penetration_max": bone_depth(self.distance, probes, poses),
            **self.form.measure(surface, same_faces=same),
            **self._flicker(carried, vertices, same),
        }

    def _flicker(self, carried, vertices, same):
        """Change of the signed distances of the carried vertices to the surface; of a mesh that is shown, none."""
        if np.array_equal(carried, vertices):
            return {}
        if self.near is None or not same:
            self.near = np.full(len(carried), -1)
        before, self.offset = self.offset, self.distance.signed(carried, near=self.near)
        return {"flicker": np.abs(self.offset - before).max() if before is not None else 0.0}

    def _at_rest(self, surface, probes, poses):
        """What is measured once, in the first frame in which all bones are at rest."""
        mesh = self.mesh.vertices, self.mesh.faces
        rms, worst = surface_distance(surface.vertices, surface.faces, *mesh)
        bones = {probe.name: probe for probe in probes}
        held = [a for a in self.attachments if a.tendon is None]
        gaps = [bones[a.bone].unsigned(mesh[0][a.vertices]).min() for a in held]
        found = {"rest_error_rms": rms, "rest_error_max": worst, "end_gap": max(gaps, default=0.0)}
        if self.line is not None:
            found["thickness"] = self._section(*mesh, poses)["belly_thickness"]
        return found

    def _section(self, vertices, faces, poses):
        """The greatest section of a surface across the line between the middles of origin and insertion."""
        first, last = (carried_middle(end, poses) for end in self.line.ends)
        return belly_measures(np.asarray(vertices), np.asarray(faces), first, last)


def _edge_operator(vertices: Floats, faces: Integers) -> sparse.csr_matrix:
    """Sparse matrix (e, n) that maps vertices to edge vectors in units of their lengths at rest."""
    edges = unique_edges(faces)
    lengths = edge_lengths(vertices, edges)
    edges, lengths = edges[lengths > 0.0], lengths[lengths > 0.0]
    rows, inverse = np.arange(len(edges)), 1.0 / lengths
    places = np.tile(rows, 2), edges.T.ravel()
    return sparse.csr_matrix((np.concatenate([inverse, -inverse]), places), (len(edges), len(vertices)))


def surface_distance(
    vertices: Floats, faces: Integers, other_vertices: Floats, other_faces: Integers
) -> tuple[float, float]:
    """Distance between two surfaces, from the vertices of each to the other [scene unit].

    Root of the mean of both directions' mean squares, and the greatest distance of either.
    """
    there = MeshDistance(other_vertices, other_faces).unsigned(vertices)
    back = MeshDistance(vertices, faces).unsigned(other_vertices)
    rms = math.sqrt((np.mean(there**2) + np.mean(back**2)) / 2)
    return rms, float(max(there.max(), back.max()))
