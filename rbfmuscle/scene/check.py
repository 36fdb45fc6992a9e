"""Looking a scene over before it is solved: sizes, overlaps at rest, bones that meet in the
motion.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers, box_size
from rbfmuscle.geometry.frames import moved_box
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.muscles import attachment_ends, check_place, check_size
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene, doubtful, guessed_muscles, require_complete
from rbfmuscle.validation import RBFMuscleError, SceneError


class InputOverlap(NamedTuple):
    """Where the input meshes of two muscles overlap at rest: vertices (n, 3) of either inside the
    other, and their depths (n,) [scene unit].
    """

    places: Floats
    depths: Floats


def input_distances(muscles: Sequence[Muscle]) -> dict[str, MeshDistance]:
    """Distance to the input mesh of each muscle, by name."""
    return {m.name: MeshDistance(m.mesh.vertices, m.mesh.faces) for m in muscles}


def input_overlaps(
    distances: Mapping[str, MeshDistance],
) -> dict[tuple[str, str], InputOverlap]:
    """The pairs of muscles whose input meshes overlap, from `input_distances`."""
    found = {}
    for one, other in itertools.combinations(distances, 2):
        pair = distances[one], distances[other]
        vertices = np.concatenate([each.vertices for each in pair])
        depths = np.concatenate([pair[1].depth(pair[0].vertices), pair[0].depth(pair[1].vertices)])
        inside = depths > 0.0
        if inside.any():
            found[one, other] = InputOverlap(vertices[inside], depths[inside])
    return found


# Faces within this of the least gap face each other [mm], if the gap is no joint's beyond FARTHEST.
BAND, FARTHEST = 6.0, 15.0
# Least cosine between a face's normal and the direction to the other bone.
LOOK = 0.5
# Radii of a head [mm]; what belongs to it and to its socket, in radii from the centre.
HEAD = (12.0, 35.0)
SHELL = 1.08
SOCKET = 1.4
# The nearest points of a bone to the centre, of which the radius is the median.
NEAREST = 50
# What is attached lies on an articular surface where that is farther by no more than this than the
# bone itself [mm].
BESIDE = 1.5
TOUCHED = 8.0  # what is farther from the bone than this [mm] lies on none of its surfaces


def articular_points(
    joints: Iterable[tuple[str, str, Floats | None]],
    meshes: Mapping[str, trimesh.Trimesh],
    millimetre: float,
) -> dict[str, Floats]:
    """Points (n, 3) of the articular surfaces by bone.

    ``joints`` are (parent, child, centre of a ball or None) of the joints that move; bones without
    a mesh are left out.
    """
    found: dict[str, list[Floats]] = {name: [] for name in meshes}
    for parent, child, centre in joints:
        if parent not in meshes or child not in meshes:
            continue
        pair = meshes[parent], meshes[child]
        radius = 0.0
        if centre is not None:
            away = np.linalg.norm(np.asarray(pair[1].triangles_center) - centre, axis=1)
            radius = float(np.median(np.sort(away)[:NEAREST])) / millimetre
        if HEAD[0] <= radius <= HEAD[1]:
            found[parent].append(_about(pair[0], centre, SOCKET * radius * millimetre, -1.0))
            found[child].append(_about(pair[1], centre, SHELL * radius * millimetre, 1.0))
        else:
            found[parent].append(_facing(pair[0], pair[1], millimetre))
            found[child].append(_facing(pair[1], pair[0], millimetre))
    return {name: np.concatenate([np.empty((0, 3)), *parts]) for name, parts in found.items()}


def scene_surfaces(scene: Scene) -> dict[str, Floats]:
    """The same of a scene, by its joints that move."""
    meshes = {bone.name: bone.mesh for bone in scene.bones}
    joints = [
        (joint.parent, joint.child, joint.centre if len(joint.coordinates) > 1 else None)
        for joint in scene.joints
        if joint.coordinates
    ]
    return articular_points(joints, meshes, from_mm(1.0, scene.units))


def articular_share(
    muscle: Muscle, scene: Scene, surfaces: Mapping[str, Floats]
) -> tuple[float, str]:
    """Greatest share of an attachment that lies on an articular surface, and its bone.

    ``surfaces`` are as of `scene_surfaces`.
    """
    worst = (0.0, "")
    for held in (a for a in muscle.attachments if not a.via):
        surface = surfaces.get(held.bone, np.empty((0, 3)))
        if held.tendon is None and len(surface):
            points = np.asarray(muscle.mesh.vertices)[held.vertices]
            near, _ = cKDTree(surface).query(points)
            touched, beside = from_mm(TOUCHED, scene.units), from_mm(BESIDE, scene.units)
            some = near < touched + beside  # others cannot lie on it
            away = scene.bone(held.bone).exact.unsigned(points[some])
            lies = (near[some] <= away + beside) & (away < touched)
            share = float(lies.sum()) / len(points)
            worst = max(worst, (share, held.bone))
    return worst


class AttachmentFacts(NamedTuple):
    """What an attachment holds: which end of the muscle ("origin" where its first attachment is,
    "insertion", or "way" between them), how (on, via or by a tendon to) which bone, the number of
    vertices, their area [cm^2] and its share of the muscle's surface.
    """

    muscle: str
    end: str
    how: str
    bone: str
    vertices: int
    area: float
    share: float


def attachment_facts(scene: Scene) -> list[AttachmentFacts]:
    """What the attachments of a scene hold, muscle by muscle."""
    found = []
    for muscle in scene.muscles:
        areas = vertex_areas(np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces))
        first, last = attachment_ends(muscle, scene.joints) or (muscle.attachments, [])
        begins = next((a for a in muscle.attachments if not a.via), None)
        origin = last if any(held is begins for held in last) else first
        for held in muscle.attachments:
            end = "origin" if any(held is one for one in origin) else "insertion"
            how = "on" if held.tendon is None else "by a tendon to"
            if held.via:
                end, how = "way", "via"
            area = float(areas[held.vertices].sum())
            row = (end, how, held.bone, len(held.vertices), area / from_mm(10.0, scene.units) ** 2)
            found.append(AttachmentFacts(muscle.name, *row, area / float(areas.sum())))
    return found


def _about(mesh, centre, reach, sign):
    """Middles of the triangles within reach of a centre that look away from it (1) or at it
    (-1).
    """
    points = np.asarray(mesh.triangles_center)
    away = points - centre
    distance = np.linalg.norm(away, axis=1)
    look = np.einsum("ij,ij->i", np.asarray(mesh.face_normals), away) * sign
    return points[(distance < reach) & (look > LOOK * distance)]


def _facing(mesh, other, millimetre):
    """Middles of the triangles that look at another bone within `BAND` of the least gap."""
    points, tree = np.asarray(mesh.triangles_center), cKDTree(other.triangles_center)
    reach = (FARTHEST + BAND) * millimetre
    close, distance, _, look = looking_at(points, mesh.face_normals, tree, other.bounds, reach)
    if distance.min(initial=np.inf) > FARTHEST * millimetre:
        return points[:0]
    return points[close[(distance < distance.min() + BAND * millimetre) & (look > LOOK)]]


def looking_at(
    points: Floats, normals: Floats, others: cKDTree, bounds: Floats, reach: float
) -> tuple[Integers, Floats, Integers, Floats]:
    """Which points (n, 3) lie within ``reach`` of others, which have a box (2, 3): their numbers
    (k,), the distances to the nearest of the others, its numbers, and the cosines between normals
    (n, 3) and the directions there.
    """
    low, high = bounds
    close = np.flatnonzero(((points > low - reach) & (points < high + reach)).all(axis=1))
    distance, nearest = others.query(points[close], distance_upper_bound=reach)
    found = np.isfinite(distance)
    close, distance, nearest = close[found], distance[found], nearest[found]
    away = (others.data[nearest] - points[close]) / np.maximum(distance, 1e-12)[:, None]
    look = np.einsum("ij,ij->i", np.asarray(normals)[close], away)
    return close, distance, nearest, look


MOST_ARTICULAR = 0.5  # share of an attachment that may lie on an articular surface
# An end without a tendon lies no farther from its bone than this [mm], and than this share of the
# muscle's length.
END_GAP_MM, END_SHARE = 25.0, 0.1
MOTION_SAMPLES = 10  # frames in which bones are checked against each other
# Of the size of a scene: farther from the origin, single precision shows, and the digits of double
# precision do not suffice.
FAR_SINGLE, FAR_DIGITS = 1e3, 1e6
COUNTED_DEPTH_MM = 0.05  # bones that touch by less are not reported


@dataclass
class Finding:
    """One thing found: ``level`` is "error", "warning" or "note"; ``place`` names the object."""

    level: str
    place: str
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.place}: {self.message}"


def check_scene(scene: Scene) -> list[Finding]:
    """Return all findings about a scene, the first error among them, the worst first; nothing is
    solved or changed.

    Parameters
    ----------
    scene : Scene

    Examples
    --------
    >>> from rbfmuscle import check_scene, phantom_scene
    >>> [finding for finding in check_scene(phantom_scene()) if finding.level == "error"]
    []
    """
    items: list[Bone | Muscle] = [*scene.bones, *scene.muscles]
    findings = [Finding("note", item.name, note) for item in items for note in item.notes]
    findings += [Finding("note", scene.name, note) for note in scene.notes]
    opened = "the bone is open, its inside follows from winding numbers"
    unusable = "no mesh of this bone could be used: muscles pass through it"
    findings += [Finding("warning", bone.name, opened) for bone in scene.bones if not bone.closed]
    findings += [Finding("warning", name, unusable) for name in scene.missing_bones]
    findings += [Finding("warning", scene.name, doubt) for doubt in scene.doubts]
    findings += [Finding("warning", place, doubt) for place, doubt in _mesh_doubts(scene)]
    away, size = _far(scene)
    if away > FAR_SINGLE * size:
        error = away * float(np.finfo(np.float32).eps) / 2.0
        findings.append(
            Finding(
                "warning",
                scene.name,
                f"it lies {away:.3g} {scene.units} from the origin: in files of single precision "
                f"(STL, PLY, GLB) places are wrong by up to {error:.2g} {scene.units}; move it "
                "near the origin",
            )
        )
    findings += [Finding("warning", "motion", note) for note in scene.motion.notes]
    findings += _rest_overlaps(scene)
    overlaps = input_overlaps(input_distances(scene.muscles))
    findings += [
        Finding(
            "note",
            f"{one} and {other}",
            f"the meshes of these muscles overlap by {found.depths.max():.3g} {scene.units}, "
            f"{len(found.depths)} vertices lie in the other: what does so at rest counts apart",
        )
        for (one, other), found in sorted(overlaps.items(), key=lambda row: -row[1].depths.max())
    ]
    findings += [
        Finding(
            "warning",
            f"{table} {guess.name}",
            f"a doubtful guess ({guess.confidence:.1f}): {guess.text}; look at it in a picture, "
            "correct it or remove its key guess",
        )
        for table in ("joint", "muscle")
        for guess in doubtful(scene.guesses, table)
    ]
    if scene.meshless_bones and not scene.bones:
        unrunnable = "no bone has a mesh, so nothing can be run; give the bones meshes"
        return sort_findings([*findings, Finding("note", scene.name, unrunnable)])
    surfaces = scene_surfaces(scene)
    for muscle in scene.muscles:
        share, bone_name = articular_share(muscle, scene, surfaces)
        if share > MOST_ARTICULAR:
            findings.append(
                Finding(
                    "warning",
                    muscle.name,
                    f"{100 * share:.0f} % of an attachment lies on an articular surface of "
                    f"{bone_name!r}; correct the attachment",
                )
            )
    findings += [Finding("warning", name, text) for name, text in open_ends(scene).items()]
    try:
        findings += bone_findings(bone_collisions(scene), scene.units)
        for bone in scene.bones:
            check_size("bone", bone.name, bone, scene.units)
        for muscle in scene.muscles:
            check_place(muscle.name, muscle, scene.bones, scene.units)
        require_complete(scene)
    except RBFMuscleError as error:
        findings.append(Finding("error", scene.name, str(error)))
    return sort_findings(findings)


def end_gap(muscle: Muscle, scene: Scene) -> tuple[float, str]:
    """Distance of the end without a tendon that lies farthest from its bone at rest [scene unit],
    and that bone.
    """
    bones = {bone.name: bone for bone in scene.bones}
    points = np.asarray(muscle.mesh.vertices)
    gaps = [
        (float(bones[a.bone].exact.unsigned(points[a.vertices]).min()), a.bone)
        for a in muscle.attachments
        if a.tendon is None and not a.via and a.bone in bones
    ]
    return max(gaps, default=(0.0, ""))


def open_ends(scene: Scene) -> dict[str, str]:
    """What is said of each muscle that ends short of its bone without a tendon, by name."""
    found = {}
    for muscle in scene.muscles:
        gap, bone = end_gap(muscle, scene)
        most = from_mm(END_GAP_MM, scene.units)
        ends = attachment_ends(muscle, scene.joints)
        if ends is not None:
            first, last = (
                muscle.mesh.vertices[np.concatenate([a.vertices for a in held])].mean(axis=0)
                for held in ends
            )
            most = min(most, END_SHARE * float(np.linalg.norm(last - first)))
        if gap > most:
            found[muscle.name] = (
                f"an end lies {gap:.3g} {scene.units} from {bone!r}, which holds it; correct the "
                "attachment, or give it a tendon"
            )
    return found


def stated_doubts(scene: Scene) -> list[tuple[str, str]]:
    """What is doubtful about a scene though no line of it is a guess, each with its muscle: without
    one the ``doubts`` of the scene and of its bones' meshes; ends that lie away from their bones,
    as those who wrote it stated.
    """
    guessed = guessed_muscles(scene.guesses)
    ends = [(name, text) for name, text in open_ends(scene).items() if name not in guessed]
    meshes = [f"{place}: {doubt}" for place, doubt in _mesh_doubts(scene)]
    return [*(("", doubt) for doubt in (*scene.doubts, *meshes)), *ends]


def _mesh_doubts(scene: Scene) -> list[tuple[str, str]]:
    """Bones of which it is not known what is inside, and scenes so far from the origin that results
    lose digits, as (name, doubt).
    """
    found = [(bone.name, bone.doubt) for bone in scene.bones if bone.doubt]
    away, size = _far(scene)
    if away > FAR_DIGITS * size:
        found.append(
            (
                scene.name,
                f"it lies {away:.3g} {scene.units} from the origin, {away / size:.0e} times its "
                "size: results lose digits; move it near the origin",
            )
        )
    return found


def _far(scene: Scene) -> tuple[float, float]:
    """The largest coordinate of the bones, and the diagonal of the box about all [scene unit]."""
    if not scene.bones:
        return 0.0, 0.0
    corners = np.concatenate([bone.bounds for bone in scene.bones])
    return float(np.abs(corners).max()), box_size(corners)


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, the worst first."""
    return sorted(findings, key=lambda finding: ("error", "warning", "note").index(finding.level))


def _rest_overlaps(scene):
    """Muscle vertices inside bones at rest."""
    findings = []
    for muscle, bone in itertools.product(scene.muscles, scene.bones):
        depth = bone.exact.depth(muscle.mesh.vertices)
        for attachment in muscle.attachments:
            depth[attachment.vertices] = 0.0
        inside = np.count_nonzero(depth)
        if not inside:
            continue
        share = inside / len(depth)
        level = "error" if scene.contact.initial == "error" or share > 1 / 2 else "note"
        findings.append(
            Finding(
                level,
                muscle.name,
                f"{inside} free vertices ({100 * share:.2g} %) start inside bone {bone.name!r}, "
                f"up to {depth.max():.3g} {scene.units} deep",
            )
        )
    return findings


def check_initial(scene: Scene) -> None:
    """Raise SceneError if a muscle lies mostly inside a bone.

    With ``initial = "error"`` a muscle may not lie in a bone at all.
    """
    for finding in _rest_overlaps(scene):
        if finding.level == "error":
            raise SceneError(
                f"muscle {finding.place!r}: {finding.message}; move it, or set [contact] initial"
            )


def bone_collisions(
    scene: Scene, frames: Iterable[int] | None = None
) -> list[tuple[int, str, str, float]]:
    """Return where a motion drives bones into each other, as (frame, bone, other, depth [scene
    unit]).

    The depth is that of the deepest vertex of either bone in the other; pairs that do not move are
    left out. ``frames`` are about ten of the motion by default.
    """
    found = []
    for frame in sampled_frames(scene) if frames is None else frames:
        poses = bone_poses(scene, scene.motion.frames[frame])
        for first, second in itertools.combinations(scene.bones, 2):
            relative = np.asarray(np.linalg.solve(poses[second.name], poses[first.name]), float)
            if np.allclose(relative, np.eye(4), atol=1e-12):
                continue
            (low, high), other = moved_box(first.bounds, relative), second.bounds
            if np.any(low > other[1]) or np.any(high < other[0]):
                continue
            back = np.asarray(np.linalg.inv(relative), float)
            deepest = max(
                second.exact.depth(first.mesh.vertices, pose=relative).max(),
                first.exact.depth(second.mesh.vertices, pose=back).max(),
            )
            if deepest > from_mm(COUNTED_DEPTH_MM, scene.units):
                found.append((frame, first.name, second.name, float(deepest)))
    return found


def sampled_frames(scene: Scene) -> list[int]:
    """About ten frames along a motion, the first and the last among them."""
    chosen = np.linspace(0, len(scene.motion) - 1, MOTION_SAMPLES).round().astype(int)
    return [int(frame) for frame in np.unique(chosen)]


def bone_findings(collisions: list[tuple[int, str, str, float]], units: str) -> list[Finding]:
    """Return a warning for each pair of bones that the motion drives into each other, from
    `bone_collisions`.
    """
    worst = {}
    for frame, first, second, depth in collisions:
        start, deepest = worst.get((first, second), (frame, 0.0))
        worst[first, second] = (start, max(deepest, depth))
    return [
        Finding(
            "warning",
            f"{a} and {b}",
            f"the motion drives the bones into each other, from about frame {start}, up to "
            f"{deepest:.3g} {units}",
        )
        for (a, b), (start, deepest) in worst.items()
    ]
