"""Checks a motion before the run: attachments that it moves into another bone, too far apart or too
close together.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, to_world
from rbfmuscle.geometry.frames import moved_box
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.check import Finding
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene

# Greatest numbers of frames and of vertices of an attachment that are checked.
MOST_FRAMES, MOST_VERTICES = 25, 60
# Depth beyond that at rest from which an attachment counts as inside a bone [mm].
DEEPER = 1.0
# Bounds of the distance between attachments, relative to rest.
LONGEST, SHORTEST = 1.5, 0.5
# Attachments closer than this fraction of the muscle's extent lie side by side, not at its ends.
APART = 0.3


class Fault(NamedTuple):
    """An attachment that the motion moves into another bone, or two that it moves too far apart or
    together.
    """

    muscle: str
    bones: tuple[
        str, str
    ]  # that holds the attachment and that it enters, or those that hold the two
    rest: float  # distance between the two at rest [scene unit]; 0 for one that enters a bone
    value: float  # greatest depth beyond that at rest, or the distance farthest from that at rest
    frame: int  # where it is so
    first: int  # first frame of too great a value


def check_motion(scene: Scene) -> list[Fault]:
    """Follow the attachments of every muscle along the motion."""
    count = len(scene.motion)
    frames = sorted({round(k) for k in np.linspace(0, count - 1, min(count, MOST_FRAMES))})
    poses = [bone_poses(scene, {}), *(bone_poses(scene, scene.motion.frames[k]) for k in frames)]
    faults = []
    for muscle in scene.muscles:
        extent = float(np.linalg.norm(np.ptp(np.asarray(muscle.mesh.vertices), axis=0)))
        for bones, values, bad in _followed(scene, muscle, extent, poses):
            if bad.any():
                worst = int(np.abs(values[1:] - values[0]).argmax())
                first = int(np.flatnonzero(bad)[0])
                faults.append(
                    Fault(
                        muscle.name,
                        bones,
                        values[0],
                        values[1 + worst],
                        frames[worst],
                        frames[first],
                    )
                )
    return faults


def _followed(
    scene: Scene, muscle: Muscle, extent: float, poses: Sequence[Mapping[str, Floats]]
) -> Iterator[tuple[tuple[str, str], Floats, np.ndarray]]:
    """For an attachment and a bone, or two attachments: a value (1 + p,) along the motion, and
    where it is bad.
    """
    patches = _patches(muscle)
    for bone, points in patches.items():
        bounds = np.array([points.min(axis=0), points.max(axis=0)])
        for other in scene.bones:
            places = [np.linalg.inv(pose[other.name]) @ pose[bone] for pose in poses]
            if not all(np.allclose(place, places[0], atol=1e-9) for place in places[1:]):
                depths = np.array([_depth(points, bounds, place, other) for place in places])
                deeper = np.maximum(depths - depths[0], 0.0)
                yield (bone, other.name), deeper, deeper[1:] > from_mm(DEEPER, scene.units)
    for pair in itertools.combinations(patches, 2):
        one, other = (np.append(patches[bone].mean(axis=0), 1.0) for bone in pair)
        away = np.array(
            [np.linalg.norm((pose[pair[0]] @ one - pose[pair[1]] @ other)[:3]) for pose in poses]
        )
        if away[0] >= APART * extent:
            for bad, limit in (
                (away > LONGEST * away[0], np.maximum),
                (away < SHORTEST * away[0], np.minimum),
            ):
                yield pair, np.append(away[0], limit(away[1:], away[0])), bad[1:]


def _patches(muscle: Muscle) -> dict[str, Floats]:
    """Attached vertices by bone, thinned."""
    found: dict[str, list[np.ndarray]] = {}
    for attachment in muscle.attachments:
        found.setdefault(attachment.attachment_frame, []).append(attachment.vertices)
    thinned = {}
    for bone, parts in found.items():
        index = np.unique(np.concatenate(parts))
        step = max(1, math.ceil(len(index) / MOST_VERTICES))
        thinned[bone] = np.asarray(muscle.mesh.vertices, dtype=float)[index[::step]]
    return thinned


def _depth(points: Floats, bounds: Floats, place: Floats, bone: Bone) -> float:
    """Depth of the deepest point inside a bone, of points moved into its coordinates."""
    low, high = moved_box(bounds, place)
    if np.any(low > bone.bounds[1]) or np.any(high < bone.bounds[0]):
        return 0.0
    return max(0.0, -float(bone.distances(to_world(points, place)).min()))


def motion_findings(scene: Scene) -> list[Finding]:
    """The faults of `check_motion` as warnings with remedies, the worst of each kind first."""
    faults, units = check_motion(scene), scene.units
    inside = sorted((one for one in faults if not one.rest), key=lambda one: -one.value)
    apart = [one for one in faults if one.rest]
    said = []
    for one in [
        *inside,
        *sorted(apart, key=lambda one: -abs(math.log(max(one.value / one.rest, 1e-12)))),
    ]:
        bone, other = one.bones
        if not one.rest:
            text = (
                f"the motion drives the end held by {bone!r} into bone {other!r}, from about "
                f"frame {one.first}, by up "
                f"to {one.value:.3g} {units} at frame {one.frame}; give it a tendon, or its "
                "tendon via points, or end "
                "the motion sooner"
            )
        else:
            how = "take apart" if one.value > one.rest else "bring together"
            ratio = one.value / one.rest
            text = (
                f"{bone!r} and {other!r} {how} its ends to {ratio:.2f} times their distance at "
                f"rest ({one.rest:.4g} to "
                f"{one.value:.4g} {units} at frame {one.frame}, too far from about frame "
                f"{one.first}); a tendon may be "
                "missing between mesh and bone: give one to the attachment, or correct the "
                "attachments"
            )
        said.append(Finding("warning", one.muscle, text))
    return said
