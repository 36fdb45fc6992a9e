"""What a motion can bring together: swept boxes, the fields worth building, the sub-steps needed."""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np

from rbfmuscle.sim.contact import moved_box
from rbfmuscle.sim.detectors import build_detector
from rbfmuscle.sim.motion import bone_poses, interpolate

# Poses of a motion that a swept box is made of; arcs between them are covered by the padding.
SAMPLED_POSES = 48
# Padding of a swept box, as a share of the muscle's diagonal, as a muscle bulges beyond its bones' motions.
PADDING = 0.1
# No attached point moves farther against a bone in one sub-step than this share of its muscle's diagonal.
TRAVEL = 1.0 / 30.0


def swept_region(muscle, bone_name, poses):
    """Box (2, 3) in a bone's coordinates that holds a muscle through a motion.

    Parameters
    ----------
    muscle : Muscle
    bone_name : str
    poses : list of dict
        Poses of all bones, the rest pose among them.
    """
    bounds = np.asarray(muscle.mesh.bounds, dtype=np.float64)
    boxes = []
    for pose in poses:
        back = np.linalg.inv(pose[bone_name])
        boxes.extend(moved_box(bounds, back @ pose[name]) for name in {a.bone for a in muscle.attachments})
    pad = PADDING * float(np.linalg.norm(bounds[1] - bounds[0]))
    return np.array(
        [np.min([b[0] for b in boxes], axis=0) - pad, np.max([b[1] for b in boxes], axis=0) + pad]
    )


def sampled_poses(scene):
    """Poses along the scene's motion, the rest pose first, thinned to a bounded number."""
    frames = scene.motion.frames
    chosen = sorted({round(k) for k in np.linspace(0, len(frames) - 1, min(len(frames), SAMPLED_POSES))})
    stops = [{}, *(frames[k] for k in chosen)]
    poses = [bone_poses(scene, {})]
    for before, after in itertools.pairwise(stops):
        count = max(1, math.ceil(_largest_change(before, after) / math.radians(10.0)))
        poses.extend(bone_poses(scene, interpolate(before, after, (k + 1) / count)) for k in range(count))
    return poses


def reached_bones(scene):
    """Region of each bone that each muscle can reach: dict of (muscle name, bone name) to (2, 3) box."""
    poses = sampled_poses(scene)
    regions = {}
    for muscle in scene.muscles:
        for bone in scene.bones:
            region = swept_region(muscle, bone.name, poses)
            box = np.asarray(bone.mesh.bounds)
            if np.all(region[0] <= box[1]) and np.all(region[1] >= box[0]):
                regions[muscle.name, bone.name] = region
    return regions


def build_fields(scene, regions):
    """Distance fields of the bones that some muscle can reach, in parallel: dict of bone name to field.

    The scene's ``[contact] detector`` says of which kind; only the default is built for the reached part alone.
    """
    kind = getattr(scene.contact, "detector", "sdf")
    tolerance = getattr(scene.contact, "tolerance", None)

    def build(bone):
        if kind != "sdf":
            return build_detector(kind, bone.mesh)
        boxes = [box for (_, name), box in regions.items() if name == bone.name]
        options = {} if tolerance is None else {"tolerance": tolerance}
        return build_detector(kind, bone.mesh, region=_union(boxes), **options)

    bones = [bone for bone in scene.bones if any(name == bone.name for _, name in regions)]
    if len(bones) < 2:
        return {bone.name: build(bone) for bone in bones}
    with ThreadPoolExecutor(max_workers=numba.get_num_threads()) as pool:
        return dict(zip([bone.name for bone in bones], pool.map(build, bones)))


def split_step(scene, before, after):
    """Coordinates of the sub-steps from one frame to the next, ``before`` left out and ``after`` last.

    No bone turns by more than the scene's ``substep_angle`` in one, and no attached point moves far against
    a bone.

    Returns
    -------
    list of dict
        Empty where nothing moves.
    """
    limit = math.radians(scene.contact.substep_angle)
    change = _largest_change(before, after)
    if change == 0.0:
        return []
    count = max(1, math.ceil(change / limit - 1e-9))
    while True:
        stops = [interpolate(before, after, k / count) for k in range(count + 1)]
        poses = [bone_poses(scene, stop) for stop in stops]
        excess = max(_excess(scene, a, b, limit) for a, b in itertools.pairwise(poses))
        if excess <= 1.0 + 1e-9:
            return stops[1:]
        count = max(count + 1, math.ceil(count * min(excess, 4.0)))


def _largest_change(before, after):
    return max((abs(after.get(k, 0.0) - before.get(k, 0.0)) for k in {*before, *after}), default=0.0)


def _excess(scene, before, after, limit):
    """How far a step goes beyond what one sub-step may do: 1 is just allowed."""
    excess = 0.0
    for name in before:
        turn = after[name][:3, :3] @ before[name][:3, :3].T
        excess = max(excess, turned_angle(turn) / limit)
    for muscle in scene.muscles:
        diagonal = float(np.linalg.norm(np.ptp(np.asarray(muscle.mesh.bounds), axis=0)))
        for attachment in muscle.attachments:
            corners = _corners(muscle.mesh.vertices[attachment.vertices])
            for name in before:
                old = np.linalg.inv(before[name]) @ before[attachment.bone]
                new = np.linalg.inv(after[name]) @ after[attachment.bone]
                moved = corners @ (new - old)[:3, :3].T + (new - old)[:3, 3]
                excess = max(excess, float(np.linalg.norm(moved, axis=1).max()) / (TRAVEL * diagonal))
    return excess


def turned_angle(rotation):
    """Angle of a (3, 3) rotation [radian], accurate for small ones too."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return math.atan2(float(np.linalg.norm(skew)), float(np.trace(rotation)) - 1.0)


def _union(boxes):
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _corners(points):
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return np.array([[(low, high)[k >> a & 1][a] for a in range(3)] for k in range(8)])
