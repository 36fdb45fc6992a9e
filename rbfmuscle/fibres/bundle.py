"""The fibres of one muscle over a motion: traced at rest, carried by the material and the bones."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.fibres.trace import POINTS, trace_fibres
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.centreline import moving_joints, split_ends
from rbfmuscle.metrics.rows import bones_about
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import NODES, TendonLine
from rbfmuscle.simulation.frame import FibreLines, MuscleModel
from rbfmuscle.validation import SceneWarning

PATCH_POINTS = 3000  # of an end


class FibreBundle:
    """Fibres of a muscle at rest, and what carries them.

    Inner points go with the material, as the ``model`` says; the ends go with the bones, or with
    the ends of tendons, that hold the patches they lie on. Where the muscle has aponeuroses the
    ends of fibres lie on these and go with the material, and a straight line joins each to the
    nearest point that a bone holds.
    """

    def __init__(self, muscle: Muscle, scene: Scene, model: MuscleModel, count: int) -> None:
        mesh = MeshDistance(muscle.mesh.vertices, muscle.mesh.faces)
        groups = split_ends(muscle, scene.joints, moving_joints(scene))
        patches = [_end_points(mesh, [a.vertices for a in group]) for group in groups]
        sheets = [_end_points(mesh, [patch])[0] for patch in muscle.aponeuroses]
        probes = [bone.exact for bone in scene.bones]
        near = bones_about(mesh.vertices, probes, {probe.name: np.eye(4) for probe in probes})
        first, last = sheets or [points for points, _ in patches]
        traced = trace_fibres(mesh, (first, last), count, polylines=muscle.fibres, bones=near)
        self.rest = traced.lines
        self.attachment_frames = [a.attachment_frame for group in groups for a in group]
        self.pennate = bool(sheets)
        held = [
            cKDTree(points).query(self.rest[:, place])[1]
            for (points, _), place in zip(patches, (0, -1))
        ]
        # Where each end (N, 2, 3) is held at rest, and the place of what holds it in
        # attachment_frames.
        self._anchors = np.stack([patch[0][at] for patch, at in zip(patches, held)], axis=1)
        number = [patch[1][at] for patch, at in zip(patches, held)]
        self._held = np.stack([number[0], len(groups[0]) + number[1]], axis=1)
        self._segments = _segments(self.rest)
        self._follow = model.follower(np.ascontiguousarray(self.rest.reshape(-1, 3)))
        self._tendon = [[a.tendon is not None for a in group] for group in groups]

    def at(self, poses: Mapping[str, Floats], tendons: Mapping[str, TendonLine]) -> FibreLines:
        """The fibres where the model is now, at poses (4, 4) of bones and ends of tendons, and the
        tendons by the end that each holds.
        """
        belly = self._follow().reshape(self.rest.shape)
        held = [self._carried(end, poses) for end in (0, 1)]
        if not self.pennate:
            belly[:, 0], belly[:, -1] = held
        now = _segments(belly)
        ratio = now / self._segments
        local = np.empty((len(belly), POINTS))
        local[:, 1:-1] = 0.5 * (ratio[:, 1:] + ratio[:, :-1])
        local[:, [0, -1]] = ratio[:, [0, -1]]
        before, after = (
            self._beyond(end, belly[:, place], held[end], tendons)
            for end, place in ((0, 0), (1, -1))
        )
        points = np.concatenate([before[:, ::-1], belly, after], axis=1)
        still = [np.ones(part.shape[:2]) for part in (before, after)]
        stretch = now.sum(axis=1) / self._segments.sum(axis=1)
        return FibreLines(points, stretch, np.concatenate([still[0], local, still[1]], axis=1))

    def _carried(self, end: int, poses: Mapping[str, Floats]) -> Floats:
        """Held points (N, 3) of an end where their bones, or ends of tendons, carry them."""
        pose = np.array([poses[name] for name in self.attachment_frames])[self._held[:, end]]
        turned = np.einsum("nij,nj->ni", pose[:, :3, :3], self._anchors[:, end])
        return np.asarray(turned + pose[:, :3, 3])

    def _beyond(
        self, end: int, tips: Floats, held: Floats, tendons: Mapping[str, TendonLine]
    ) -> Floats:
        """Points (N, k, 3) of each fibre's aponeurosis and tendon beyond its tips (N, 3) at an end,
        away from the belly: none where no fibre has these there, the last one repeated for fibres
        that have no tendon. The aponeurosis ends at the held points (N, 3).
        """
        sheet = held[:, None] if self.pennate else np.empty((len(tips), 0, 3))
        if not any(self._tendon[end]):
            return sheet
        out = np.repeat((held if self.pennate else tips)[:, None], NODES - 1, axis=1)
        for place, name in enumerate(self.attachment_frames):
            if name in tendons:
                out[self._held[:, end] == place] = tendons[name].points[1:]
        return np.concatenate([sheet, out], axis=1)


def build_bundles(scene: Scene, models: Sequence[MuscleModel]) -> dict[str, FibreBundle]:
    """Fibres of each model's muscle, as many as the scene asks for; a muscle in which none can be
    traced is left out with a warning.
    """
    count = scene.output.fibres
    if count == 0:
        return {}

    def build(model: MuscleModel) -> FibreBundle | None:
        muscle = scene.muscle(model.name)
        if len([a for a in muscle.attachments if not a.via]) < 2:
            return None
        try:
            return FibreBundle(muscle, scene, model, count)
        except np.linalg.LinAlgError as error:
            warnings.warn(
                f"muscle {muscle.name!r} has no fibres: {error}", SceneWarning, stacklevel=2
            )
            return None

    found = zip(models, each(build, models))
    return {model.name: bundle for model, bundle in found if bundle is not None}


def _segments(lines: Floats) -> Floats:
    """Length (N, k - 1) of each segment of lines (N, k, 3)."""
    return np.asarray(np.linalg.norm(np.diff(lines, axis=1), axis=2))


def _end_points(mesh: MeshDistance, patches: Sequence[Integers]) -> tuple[Floats, Integers]:
    """Points (n, 3) evenly over the area of some patches of vertices, and the number (n,) of each
    one's.
    """
    owner = np.full(len(mesh.vertices), -1)
    for number, patch in enumerate(patches):
        owner[patch] = number
    corners = owner[mesh.faces]
    whole = (corners[:, 0] >= 0) & (corners == corners[:, :1]).all(axis=1)
    points, face = _on_faces(mesh.vertices, mesh.faces[whole], PATCH_POINTS)
    number = corners[whole][face, 0]
    # Patches without a whole triangle count by their vertices.
    for k, patch in enumerate(patches):
        if not (number == k).any():
            points = np.concatenate([points, mesh.vertices[patch]])
            number = np.concatenate([number, np.full(len(patch), k)])
    return points, number


def _on_faces(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """So many points (n, 3) evenly over the area of triangles, and the triangle (n,) of each."""
    if not len(faces):
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    number = np.arange(count) + 0.5
    face = np.searchsorted(area, number / count * area[-1])
    # The additive recurrence of the plastic number spreads points evenly (Roberts 2018).
    share = (number[:, None] * [0.7548776662466927, 0.5698402909980532]) % 1.0
    over = share.sum(axis=1) > 1.0
    share[over] = 1.0 - share[over]
    s, t = share.T[:, :, None]
    return a[face] + s * (b - a)[face] + t * (c - a)[face], face
