"""Looking a scene over before it is solved: sizes, overlaps at rest, bones that meet in the
motion.
"""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import moved_box
from rbfmuscle.scene.articular import articular_share, scene_surfaces
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.build import validate
from rbfmuscle.scene.guesses import doubtful
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import Muscle, SceneData
from rbfmuscle.validation import MeshError, RBFMuscleError, SceneError

Item: TypeAlias = Bone | Muscle | ReadMesh

SMALLEST_MM = 2.0  # across: the bones of a mouse
LARGEST_MM = 3000.0  # across: a person with arms raised
FAR_AWAY = (
    1.0  # a muscle further from the bones than this many diagonals of their box is in another frame
)
FARTHEST_CENTRE = (
    1000.0  # the same for the centre of a joint: a nearly straight path has one far away
)
MOST_ARTICULAR = 0.5  # share of an attachment that may lie on an articular surface
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


def check_scene(scene: SceneData) -> list[Finding]:
    """Return all findings about a scene, the first error among them, the worst first; nothing is
    solved or changed.
    """
    items: list[Bone | Muscle] = [*scene.bones, *scene.muscles]
    findings = [Finding("note", item.name, note) for item in items for note in item.notes]
    findings += [Finding("note", scene.name, note) for note in scene.notes]
    opened = "the bone is open, its inside follows from winding numbers"
    unusable = "no mesh of this bone could be used: muscles pass through it"
    findings += [Finding("warning", bone.name, opened) for bone in scene.bones if not bone.closed]
    findings += [Finding("warning", name, unusable) for name in scene.left_out]
    findings += [Finding("warning", scene.name, doubt) for doubt in scene.doubts]
    findings += [Finding("warning", "motion", note) for note in scene.motion.notes]
    findings += _rest_overlaps(scene)
    findings += _guess_findings(scene)
    if scene.links and not scene.bones:
        words = "no bone has a mesh, so nothing can be run; give the bones meshes"
        return sort_findings([*findings, Finding("note", scene.name, words)])
    findings += _attachment_findings(scene)
    try:
        findings += bone_findings(bone_collisions(scene), scene.units)
        check_extents(scene)
        validate(scene)
    except RBFMuscleError as error:
        findings.append(Finding("error", scene.name, str(error)))
    return sort_findings(findings)


def _guess_findings(scene):
    """A warning for each doubtful guess of the file."""
    said = "look at it (--picture), correct it or remove the word GUESS from its line"
    return [
        Finding(
            "warning",
            f"{table} {guess.name}",
            f"a doubtful guess ({guess.confidence:.1f}): {guess.text}; {said}",
        )
        for table in ("joint", "muscle")
        for guess in doubtful(scene.guesses, table)
    ]


def _attachment_findings(scene):
    """A warning for each attachment on an articular surface."""
    surfaces = scene_surfaces(scene)
    shares = ((muscle.name, *articular_share(muscle, scene, surfaces)) for muscle in scene.muscles)
    return [
        Finding(
            "warning",
            name,
            f"{100 * share:.0f} % of an attachment lies on an articular surface of {bone!r}; "
            "correct the attachment",
        )
        for name, share, bone in shares
        if share > MOST_ARTICULAR
    ]


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, the worst first."""
    return sorted(findings, key=lambda finding: ("error", "warning", "note").index(finding.level))


def check_extents(scene: SceneData) -> None:
    """Raise MeshError for a mesh whose size or place shows a wrong unit or another frame."""
    for bone in scene.bones:
        check_size(scene, "bone", bone.name, bone)
    for muscle in scene.muscles:
        check_size(scene, "muscle", muscle.name, muscle)
        check_place(scene, muscle.name, muscle)


def check_size(scene: SceneData, kind: str, name: str, item: Item) -> None:
    """Raise MeshError for a mesh smaller than a mouse's or larger than a person's."""
    size = float(np.linalg.norm(np.ptp(item.mesh.vertices, axis=0)))
    millimetres = size / scene.length(1.0)
    if not SMALLEST_MM <= millimetres <= LARGEST_MM:
        best = 10.0 ** round(math.log10(300.0 / max(millimetres, 1e-12)))
        raise MeshError(
            f"{kind} {name!r} ({item.source or 'built in code'}) is {size:.4g} {scene.units} "
            "across, which "
            f"cannot be right; correct the scene's units, or set its scale ({best:g} times the "
            "present one would "
            f"make it {millimetres * best:.4g} mm)"
        )


def check_place(scene: SceneData, name: str, muscle: Item) -> None:
    """Raise MeshError for a muscle that lies far away from all bones."""
    away, size = _away_from_bones(scene, *muscle.mesh.bounds)
    if away > FAR_AWAY * size:
        raise MeshError(
            f"muscle {name!r} ({muscle.source or 'built in code'}) lies {away:.4g} {scene.units} "
            "away from "
            "all bones; bring the meshes into one frame and unit (scale)"
        )


def check_centre(scene: SceneData, name: str, centre: Floats) -> None:
    """Raise SceneError for a joint whose centre lies so far from all bones that poses lose their
    digits.
    """
    away, size = _away_from_bones(scene, centre, centre)
    if away > FARTHEST_CENTRE * size:
        raise SceneError(
            f"joint {name!r}: centre {np.asarray(centre).tolist()} lies {away:.4g} {scene.units} "
            "away from all bones; "
            f"correct it, it is in the scene's unit ({scene.units})"
        )


def _away_from_bones(scene, low, high):
    """Distance of a box from that of all bones, and the diagonal of that; no distance without
    bones.
    """
    if not scene.bones:
        return 0.0, 0.0
    corners = np.concatenate([bone.mesh.bounds for bone in scene.bones])
    least, most = corners.min(axis=0), corners.max(axis=0)
    away = np.maximum(least - high, low - most).clip(min=0)
    return float(np.linalg.norm(away)), float(np.linalg.norm(most - least))


def _rest_overlaps(scene):
    """Muscle vertices inside bones at rest."""
    findings = []
    for muscle, bone in itertools.product(scene.muscles, scene.bones):
        depth = _depths(np.asarray(muscle.mesh.vertices), bone)
        for attachment in muscle.attachments:
            depth[attachment.vertices] = 0.0
        inside = np.count_nonzero(depth)
        if not inside:
            continue
        share = inside / len(depth)
        level = "note" if scene.contact.initial == "resolve" else "warning"
        if scene.contact.initial == "error" or share > 0.5:
            level = "error"
        message = (
            f"{inside} free vertices ({100 * share:.2g} %) start inside bone {bone.name!r}, "
            f"up to {depth.max():.3g} {scene.units} deep"
        )
        findings.append(Finding(level, muscle.name, message))
    return findings


def check_initial(scene: SceneData) -> None:
    """Raise SceneError if a muscle lies mostly inside a bone.

    With ``initial = "error"`` a muscle may not lie in a bone at all.
    """
    for finding in _rest_overlaps(scene):
        if finding.level == "error":
            remedy = "move it, or set [contact] initial"
            raise SceneError(f"muscle {finding.place!r}: {finding.message}; {remedy}")


def _depths(points, bone):
    """Depth of points inside a bone, zero outside; only points in its box are measured."""
    depth = np.zeros(len(points))
    low, high = bone.bounds
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    if len(near):
        depth[near] = -np.minimum(bone.distances(points[near]), 0.0)
    return depth


def bone_collisions(
    scene: SceneData, frames: Iterable[int] | None = None
) -> list[tuple[int, str, str, float]]:
    """Return where a motion drives bones into each other, as (frame, bone, other, depth [scene
    unit]).

    The depth is that of the deepest vertex of either bone in the other; pairs that do not move are
    left out. ``frames`` are about ten of the motion by default.
    """
    found = []
    for frame in sampled_frames(scene) if frames is None else frames:
        depths = _pair_depths(scene, bone_poses(scene, scene.motion.frames[frame]))
        least = scene.length(COUNTED_DEPTH_MM)
        found += [(frame, *pair, depth) for pair, depth in depths.items() if depth > least]
    return found


def sampled_frames(scene: SceneData) -> list[int]:
    """About ten frames along a motion, the first and the last among them."""
    chosen = np.linspace(0, len(scene.motion) - 1, MOTION_SAMPLES).round().astype(int)
    return [int(frame) for frame in np.unique(chosen)]


def _pair_depths(scene, poses):
    """Deepest vertex of either bone in the other, for the pairs that move against each other and
    overlap.
    """
    depths = {}
    for first, second in itertools.combinations(scene.bones, 2):
        relative = np.linalg.solve(poses[second.name], poses[first.name])
        if np.allclose(relative, np.eye(4), atol=1e-12):
            continue
        back = np.linalg.inv(relative)
        (low, high), other = moved_box(first.mesh.bounds, relative), second.mesh.bounds
        if np.any(low > other[1]) or np.any(high < other[0]):
            continue
        one = np.asarray(first.mesh.vertices) @ relative[:3, :3].T + relative[:3, 3]
        two = np.asarray(second.mesh.vertices) @ back[:3, :3].T + back[:3, 3]
        deepest = max(_depths(one, second).max(), _depths(two, first).max())
        if deepest > 0:
            depths[first.name, second.name] = float(deepest)
    return depths


def bone_findings(collisions: list[tuple[int, str, str, float]], units: str) -> list[Finding]:
    """Return a warning for each pair of bones that the motion drives into each other, from
    `bone_collisions`.
    """
    worst = {}
    for frame, first, second, depth in collisions:
        start, deepest = worst.get((first, second), (frame, 0.0))
        worst[first, second] = (start, max(deepest, depth))
    said = "the motion drives the bones into each other"
    return [
        Finding(
            "warning",
            f"{a} and {b}",
            f"{said}, from about frame {start}, up to {deepest:.3g} {units}",
        )
        for (a, b), (start, deepest) in worst.items()
    ]
