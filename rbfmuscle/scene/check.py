"""Looking a scene over before it is solved: sizes, overlaps at rest, bones that meet in the motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.rest_frame import moved_box
from rbfmuscle.scene.attachments import ExactMeshes
from rbfmuscle.scene.build import validate
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import Bone, Muscle, SceneData
from rbfmuscle.validation import MeshError, RBFMuscleError, SceneError

if TYPE_CHECKING:
    import trimesh


SMALLEST_MM = 2.0  # across: the bones of a mouse
LARGEST_MM = 3000.0  # across: a person with arms raised
FAR_AWAY = 1.0  # a muscle further from the bones than this many diagonals of their box is in another frame
FARTHEST_CENTRE = 1000.0  # the same for the centre of a joint: a nearly straight path has one far away
MOTION_SAMPLES = 10
COUNTED_DEPTH_MM = 0.05  # bones that touch by less are not reported


@dataclass
class Finding:
    """One thing found: ``level`` is "error", "warning" or "note"; ``place`` names the object."""

    level: str
    place: str
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.place}: {self.message}"


def check_scene(scene: SceneData, exact: ExactMeshes | None = None) -> list[Any]:
    """Return all findings about a scene, the worst first; nothing is solved or changed.

    Parameters
    ----------
    scene : SceneData
    exact : ExactMeshes, optional
        Takes the distances to the bones' meshes, for further questions.
    """
    exact = exact or ExactMeshes()
    items: list[Bone | Muscle] = [*scene.bones, *scene.muscles]
    findings = [Finding("note", item.name, note) for item in items for note in item.notes]
    findings.extend(
        Finding("warning", b.name, "the bone is open, inside is told by winding numbers")
        for b in scene.bones
        if not b.closed
    )
    for test in (validate, check_extents):
        try:
            test(scene)
        except RBFMuscleError as error:
            findings.append(Finding("error", scene.name, str(error)))
    findings.extend(Finding("warning", "motion", note) for note in scene.motion.notes)
    findings.extend(_rest_overlaps(scene, exact))
    try:
        findings.extend(bone_findings(bone_collisions(scene, exact=exact), scene.units))
    except SceneError as error:
        if all(str(error) != finding.message for finding in findings):
            findings.append(Finding("error", scene.name, str(error)))
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(findings, key=lambda finding: order[finding.level])


def check_extents(scene: SceneData) -> None:
    """Raise MeshError for a mesh whose size or place shows a wrong unit or another frame."""
    for kind, items in (("bone", scene.bones), ("muscle", scene.muscles)):
        for item in items:
            check_size(scene, kind, item.name, item.mesh, item.source)
    for muscle in scene.muscles:
        check_place(scene, muscle.name, muscle.mesh, muscle.source)


def check_size(scene: SceneData, kind: str, name: str, mesh: trimesh.Trimesh, source: str) -> None:
    """Raise MeshError for a mesh smaller than a mouse's or larger than a person's."""
    size = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    millimetres = size / scene.length(1.0)
    if not SMALLEST_MM <= millimetres <= LARGEST_MM:
        raise MeshError(
            f"{kind} {name!r} ({source or 'built in code'}) is {size:.4g} {scene.units} across, which cannot be "
            f"right; correct the scene's units, or set its scale ({_likely_scale(millimetres)})"
        )


def check_place(scene: SceneData, name: str, mesh: trimesh.Trimesh, source: str) -> None:
    """Raise MeshError for a muscle that lies far away from all bones."""
    if not scene.bones:
        return
    corners = np.concatenate([bone.mesh.bounds for bone in scene.bones])
    low, high = corners.min(axis=0), corners.max(axis=0)
    away = np.linalg.norm(np.maximum(low - mesh.bounds[1], mesh.bounds[0] - high).clip(min=0))
    if away > FAR_AWAY * np.linalg.norm(high - low):
        raise MeshError(
            f"muscle {name!r} ({source or 'built in code'}) lies {away:.4g} {scene.units} away from all bones; "
            "bring the meshes into one frame and unit (scale)"
        )


def check_centre(scene: SceneData, name: str, centre: np.ndarray) -> None:
    """Raise SceneError for a joint whose centre lies so far from all bones that poses lose their digits."""
    if not scene.bones:
        return
    corners = np.concatenate([bone.mesh.bounds for bone in scene.bones])
    low, high = corners.min(axis=0), corners.max(axis=0)
    away = float(np.linalg.norm(np.maximum(low - centre, centre - high).clip(min=0)))
    if away > FARTHEST_CENTRE * np.linalg.norm(high - low):
        raise SceneError(
            f"joint {name!r}: centre {np.asarray(centre).tolist()} lies {away:.4g} {scene.units} away from all bones; "
            f"correct it, it is in the scene's unit ({scene.units})"
        )


def _likely_scale(millimetres):
    """The power of ten among the usual unit mistakes that brings the size nearest to 300 mm."""
    best = min(
        (0.001, 0.1, 0.01, 10.0, 100.0, 1000.0),
        key=lambda s: abs(math.log(max(millimetres, 1e-12) * s / 300)),
    )
    return f"{best:g} times the present one would make it {millimetres * best:.4g} mm"


def _rest_overlaps(scene, exact):
    """Muscle vertices inside bones at rest."""
    findings = []
    for muscle in scene.muscles:
        points = np.asarray(muscle.mesh.vertices)
        held = np.zeros(len(points), dtype=bool)
        for attachment in muscle.attachments:
            held[attachment.vertices] = True
        for bone in scene.bones:
            depth = _depths(points, bone.mesh, exact)
            inside = (depth > 0) & ~held
            if not inside.any():
                continue
            share = inside.sum() / len(points)
            message = (
                f"{inside.sum()} free vertices ({100 * share:.2g} %) start inside bone {bone.name!r}, "
                f"up to {depth[inside].max():.3g} {scene.units} deep"
            )
            level = "note" if scene.contact.initial == "resolve" else "warning"
            if scene.contact.initial == "error" or share > 0.5:
                level = "error"
            findings.append(Finding(level, muscle.name, message))
    return findings


def check_initial(scene: SceneData) -> None:
    """Raise SceneError if a muscle lies mostly inside a bone.

    With ``initial = "error"`` a muscle may not lie in a bone at all.
    """
    for finding in _rest_overlaps(scene, ExactMeshes()):
        if finding.level == "error":
            raise SceneError(
                f"muscle {finding.place!r}: {finding.message}; move it, or set [contact] initial"
            )


def _depths(points, mesh, exact):
    """Depth of points inside a mesh, zero outside; only points in its box are measured."""
    depth = np.zeros(len(points))
    low, high = mesh.bounds
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    if len(near):
        depth[near] = -np.minimum(exact.distances(points[near], mesh), 0.0)
    return depth


def bone_collisions(scene: SceneData, frames: Any = None, *, exact: ExactMeshes | None = None) -> list[Any]:
    """Return where a motion drives bones into each other.

    Parameters
    ----------
    scene : SceneData
    frames : iterable of int, optional
        Which frames to look at, about ten of the motion by default.
    exact : ExactMeshes, optional
        Distances to the bones' meshes.

    Returns
    -------
    list of (frame, bone, other, depth)
        Depth [scene unit]: the deepest vertex of either bone in the other, in excess of the depth at rest.
    """
    frames = sampled_frames(scene) if frames is None else frames
    exact = exact or ExactMeshes()
    rest: dict[Any, float] | None = None
    found = []
    for frame in frames:
        poses = bone_poses(scene, scene.motion.frames[frame])
        depths = _pair_depths(scene, poses, exact)
        if rest is None and depths:
            rest = _pair_depths(scene, bone_poses(scene, {}), exact)
        for pair, depth in depths.items():
            if depth - (rest or {}).get(pair, 0.0) > scene.length(COUNTED_DEPTH_MM):
                found.append((frame, *pair, depth))
    return found


def sampled_frames(scene: SceneData) -> list[int]:
    """About ten frames along a motion, the first and the last among them."""
    chosen = np.linspace(0, len(scene.motion) - 1, MOTION_SAMPLES).round().astype(int)
    return [int(frame) for frame in np.unique(chosen)]


def _pair_depths(scene, poses, exact):
    """Deepest vertex of either bone in the other, for the pairs that move against each other and overlap."""
    depths = {}
    for k, first in enumerate(scene.bones):
        for second in scene.bones[k + 1 :]:
            relative = np.linalg.solve(poses[second.name], poses[first.name])
            if np.allclose(relative, np.eye(4), atol=1e-12):
                continue
            back = np.linalg.inv(relative)
            (low, high), other = moved_box(first.mesh.bounds, relative), second.mesh.bounds
            if np.any(low > other[1]) or np.any(high < other[0]):
                continue
            one = np.asarray(first.mesh.vertices) @ relative[:3, :3].T + relative[:3, 3]
            two = np.asarray(second.mesh.vertices) @ back[:3, :3].T + back[:3, 3]
            deepest = max(_depths(one, second.mesh, exact).max(), _depths(two, first.mesh, exact).max())
            if deepest > 0:
                depths[first.name, second.name] = float(deepest)
    return depths


def bone_findings(collisions: list[Any], units: str) -> list[Any]:
    """Return a warning for each pair of bones that the motion drives into each other.

    Parameters
    ----------
    collisions : list
        From `bone_collisions`.
    units : str
    """
    worst = {}
    for frame, first, second, depth in collisions:
        start, deepest = worst.get((first, second), (frame, 0.0))
        worst[first, second] = (start, max(deepest, depth))
    return [
        Finding(
            "warning",
            f"{first} and {second}",
            f"the motion drives the bones into each other, from about frame {start}, up to {deepest:.3g} {units}",
        )
        for (first, second), (start, deepest) in worst.items()
    ]
