"""Which muscles can reach which bones in a motion, by swept boxes; the fields of these bones."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import moved_box
from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.motion import bone_poses, completed, rest_coordinates
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.simulation.substeps import check_substeps, path_angle

# Poses of a motion that a swept box is made of; arcs between them are covered by the padding.
SAMPLED_POSES = 48
# Padding of a swept box, relative to the muscle's diagonal: a muscle bulges beyond its bones'
# motions.
PADDING = 0.1

# By muscle and bone: box (2, 3) in the bone's coordinates.
Regions = dict[tuple[str, str], Floats]


def swept_boxes(
    muscle: Muscle, bones: Sequence[str], poses: Sequence[Mapping[str, Floats]]
) -> Floats:
    """Boxes (b, 2, 3), in the coordinates of some bones, that hold a muscle in all these poses of
    the bones.
    """
    there = np.linalg.inv(np.array([[pose[name] for pose in poses] for name in bones]))
    held = np.array(
        [
            [pose[name] for pose in poses]
            for name in {a.attachment_frame for a in muscle.attachments}
        ]
    )
    bounds = np.asarray(muscle.mesh.bounds, dtype=np.float64)
    boxes = moved_box(bounds, there[:, None] @ held)
    pad = PADDING * float(np.linalg.norm(bounds[1] - bounds[0]))
    low, high = boxes[..., 0, :].min(axis=(1, 2)) - pad, boxes[..., 1, :].max(axis=(1, 2)) + pad
    return np.stack([low, high], axis=1)


def sampled_poses(scene: Scene) -> list[Poses]:
    """Poses along the scene's motion, the rest pose first, thinned to a bounded number."""
    frames = scene.motion.frames
    chosen = sorted(
        {round(k) for k in np.linspace(0, len(frames) - 1, min(len(frames), SAMPLED_POSES))}
    )
    stops = [rest_coordinates(scene), *(completed(scene, frames[k]) for k in chosen)]
    poses = [bone_poses(scene, {})]
    for before, after in itertools.pairwise(stops):
        count = max(1, math.ceil(path_angle(scene, before, after) / math.radians(10.0)))
        poses.extend(
            bone_poses(scene, interpolate(before, after, (k + 1) / count)) for k in range(count)
        )
    return poses


def find_contact_pairs(scene: Scene) -> Regions:
    """Region of each bone that each muscle can reach: dict of (muscle name, bone name) to (2, 3)
    box.
    """
    check_substeps(scene)
    poses, names = sampled_poses(scene), [bone.name for bone in scene.bones]
    boxes = np.array([bone.mesh.bounds for bone in scene.bones])
    regions = {}
    for muscle in scene.muscles:
        swept = swept_boxes(muscle, names, poses)
        met = np.all((swept[:, 0] <= boxes[:, 1]) & (swept[:, 1] >= boxes[:, 0]), axis=1)
        regions.update({(muscle.name, names[b]): swept[b] for b in np.flatnonzero(met)})
    return regions


def build_fields(scene: Scene, regions: Regions) -> dict[str, BoneSDF]:
    """Distance fields of the bones that some muscle can reach: dict of bone name to field."""
    reached = {name for _, name in regions}
    bones = [bone for bone in scene.bones if bone.name in reached]
    fields = each(lambda bone: BoneSDF.from_mesh(bone.mesh, name=bone.name), bones)
    return {bone.name: field for bone, field in zip(bones, fields)}
