"""From joint coordinates to the poses of bones; coordinates as files and tables show them."""

import math
from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints import (
    all_coordinates,
    coordinate_values,
    joint_poses,
    joint_values,
)
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.validation import SceneError, did_you_mean

SHIFT_LEVER = 50.0  # lever [mm] at which a shift of a joint is counted as a turn
# Range of a coordinate around rest where the scene's motion does not exceed it [degree, mm].
FREE_RANGE = 30.0


def rest_coordinates(scene: Scene) -> dict[str, float]:
    """Return the coordinates that follow no other and whose rest value is not zero [radian or scene
    unit].
    """
    followers = {coupling.coordinate for coupling in scene.couplings}
    rest = coordinate_values({}, all_coordinates(scene.joints), scene.couplings)
    return {name: value for name, value in rest.items() if value and name not in followers}


def completed(scene: Scene, coordinates: Mapping[str, float]) -> dict[str, float]:
    """Return coordinates with those that are absent at rest added, where rest is not zero."""
    return {**rest_coordinates(scene), **coordinates}


def bone_poses(scene: Scene, coordinates: dict[str, float]) -> Poses:
    """Return the pose (4, 4) of every bone, and of every end of a muscle that a tendon holds: rest
    -> world.

    A joint moves its child, and all that hangs on it, against its parent. Where the scene's meshes
    are (``rest``), every pose is the identity. A bone without a joint is fixed. ``coordinates`` are
    values of "joint.coordinate" [radian or scene unit]; absent ones are at rest.
    """
    known = all_coordinates(scene.joints)
    for name in coordinates:
        if name not in known:
            raise SceneError(f"unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}")
    poses = joint_poses(
        [bone.name for bone in scene.bones], scene.joints, scene.couplings, coordinates
    )
    return Poses(poses, {end.name: end for muscle in scene.muscles for end in muscle.tendons})


def coordinate_limits(scene: Scene) -> dict[str, tuple[float, float]]:
    """Return the range [radian or scene unit] of each free coordinate: its own with the rest value,
    or where it has none the motion's and 30 degrees (30 mm) both ways.

    Coordinates that are coupled or locked are left out.
    """
    followers = {coupling.coordinate for coupling in scene.couplings}
    limits = {}
    for name, coordinate in all_coordinates(scene.joints).items():
        if name in followers or coordinate.locked:
            continue
        free = (
            from_mm(FREE_RANGE, scene.units)
            if coordinate.motion == "translation"
            else math.radians(FREE_RANGE)
        )
        values = [frame.get(name, coordinate.rest) for frame in scene.motion.frames]
        low, high = min([coordinate.rest - free, *values]), max([coordinate.rest + free, *values])
        if coordinate.range is not None and coordinate.range[0] < coordinate.range[1]:
            low = min(coordinate.range[0], coordinate.rest)
            high = max(coordinate.range[1], coordinate.rest)
        limits[name] = (low, high)
    return limits


def step_angle(
    scene: Scene, before: dict[str, float], after: dict[str, float], *, shifts: bool = True
) -> float:
    """Return the largest turn of a bone against its parent between two sets of coordinates
    [radian].

    With ``shifts``, a shift counts as the turn that moves a place 50 mm from its axis as far.
    """
    first, second, rest = (
        joint_values(scene.joints, scene.couplings, q) for q in (before, after, {})
    )
    lever, largest = from_mm(SHIFT_LEVER, scene.units), 0.0
    for joint in scene.joints:
        name = joint.name
        if first[name] == second[name]:
            continue
        motion = joint.motion(second[name], rest[name]) @ np.linalg.inv(
            joint.motion(first[name], rest[name])
        )
        largest = max(largest, float(turned_angle(motion[:3, :3])))
        if shifts and joint.translations:
            shift = motion[:3, :3] @ joint.centre + motion[:3, 3] - joint.centre
            largest = max(largest, float(np.linalg.norm(shift)) / lever)
    return largest


def turned_angle(rotations: Floats) -> Floats:
    """Angles (...) of rotations (..., 3, 3) [radian], accurate for small ones too."""
    skew = rotations - np.swapaxes(rotations, -1, -2)
    length = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.arctan2(length, np.trace(rotations, axis1=-2, axis2=-1) - 1.0)


def shown_value(scene: Scene, name: str, value: float) -> float:
    """Return a coordinate's value as files and tables show it: degrees, or scene units as it is."""
    return math.degrees(value) if unit_sign(scene, name) == "°" else value


def inner_value(scene: Scene, name: str, value: float) -> float:
    """Return a coordinate's value [radian or scene unit] from what files and tables show."""
    return math.radians(value) if unit_sign(scene, name) == "°" else value


def unit_sign(scene: Scene, name: str) -> str:
    """Return what follows a coordinate's value in text: the sign for degrees, the scene's unit, or
    nothing.
    """
    coordinate = all_coordinates(scene.joints).get(name)
    return "°" if coordinate is None else coordinate.unit_sign(scene.units)
