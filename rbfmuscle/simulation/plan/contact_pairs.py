"""Which muscles can reach which bones in a motion, by swept boxes; the fields of these bones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import moved_box
from rbfmuscle.scene.motion import bone_poses, completed, interpolate, rest_coordinates
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.simulation.substeps import check_substeps, path_angle

if TYPE_CHECKING:
    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene


# Poses of a motion that a swept box is made of; arcs between them are covered by the padding.
SAMPLED_POSES = 48
# Padding of a swept box, relative to the muscle's diagonal: a muscle bulges beyond its bones' motions.
PADDING = 0.1


def swept_region(muscle: Muscle, bone_name: str, poses: Sequence[Mapping[str, Floats]]) -> Floats:
    """Box (2, 3) in a bone's coordinates that holds a muscle through a motion.

    Parameters
    ----------
    muscle : Muscle
    bone_name : str
    poses : list of dict
        Poses of all bones, the rest pose among them.
    """
    back = np.linalg.inv(np.array([pose[bone_name] for pose in poses]))
    held = np.array([[pose[name] for pose in poses] for name in {a.holder for a in muscle.attachments}])
    return _swept(muscle, back[None], held)[0]


def _swept(muscle, back, held):
    """Boxes (b, 2, 3) for the inverse poses (b, p, 4, 4) of bones, and the poses (h, p, 4, 4) of those that hold it."""
    bounds = np.asarray(muscle.mesh.bounds, dtype=np.float64)
    boxes = moved_box(bounds, back[:, None] @ held)
    pad = PADDING * float(np.linalg.norm(bounds[1] - bounds[0]))
    low, high = boxes[..., 0, :].min(axis=(1, 2)) - pad, boxes[..., 1, :].max(axis=(1, 2)) + pad
    return np.stack([low, high], axis=1)


def sampled_poses(scene: Scene) -> list[Poses]:
    """Poses along the scene's motion, the rest pose first, thinned to a bounded number."""
    frames = scene.motion.frames
    chosen = sorted({round(k) for k in np.linspace(0, len(frames) - 1, min(len(frames), SAMPLED_POSES))})
    stops = [rest_coordinates(scene), *(completed(scene, frames[k]) for k in chosen)]
    poses = [bone_poses(scene, {})]
    for before, after in itertools.pairwise(stops):
        count = max(1, math.ceil(path_angle(scene, before, after) / math.radians(10.0)))
        poses.extend(bone_poses(scene, interpolate(before, after, (k + 1) / count)) for k in range(count))
    return poses


def find_contact_pairs(scene: Scene) -> dict[tuple[Any, ...], Floats]:
    """Region of each bone that each muscle can reach: dict of (muscle name, bone name) to (2, 3) box."""
    check_substeps(scene)
    poses = sampled_poses(scene)
    there = {bone.name: np.array([pose[bone.name] for pose in poses]) for bone in scene.bones}
    back = np.linalg.inv(np.array(list(there.values())))
    boxes = np.array([bone.mesh.bounds for bone in scene.bones])
    regions = {}
    for muscle in scene.muscles:
        held = np.array([[pose[name] for pose in poses] for name in {a.holder for a in muscle.attachments}])
        swept = _swept(muscle, back, held)
        met = np.all((swept[:, 0] <= boxes[:, 1]) & (swept[:, 1] >= boxes[:, 0]), axis=1)
        regions.update({(muscle.name, scene.bones[b].name): swept[b] for b in np.flatnonzero(met)})
    return regions


def build_fields(scene: Scene, regions: dict[tuple[Any, ...], Floats]) -> dict[str, BoneSDF]:
    """Distance fields of the parts of bones that some muscle can reach, in parallel: dict of bone name to field."""

    def build(bone):
        boxes = [box for (_, name), box in regions.items() if name == bone.name]
        return BoneSDF.from_mesh(bone.mesh, region=union_of(boxes))

    bones = [bone for bone in scene.bones if any(name == bone.name for _, name in regions)]
    if len(bones) < 2:
        return {bone.name: build(bone) for bone in bones}
    with ThreadPoolExecutor(max_workers=numba.get_num_threads()) as pool:
        return dict(zip([bone.name for bone in bones], pool.map(build, bones)))


def union_of(boxes: list[Floats]) -> Floats:
    """Least box (2, 3) that holds all boxes."""
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])
