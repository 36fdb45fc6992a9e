"""Poses of bones from coordinates: couplings, locks and ranges first, then joint after joint from the root."""

from graphlib import CycleError, TopologicalSorter

import numpy as np

from rbfmuscle.scene.joints.joint import Coordinate, Coupling, Joint
from rbfmuscle.validation import SceneError


def all_coordinates(joints: list[Joint]) -> dict[str, Coordinate]:
    """Return every coordinate by its full name "joint.coordinate", in order."""
    return {f"{joint.name}.{name}": facts for joint in joints for name, facts in joint.coordinates.items()}


def resolve(
    asked: dict[str, float], coordinates: dict[str, Coordinate], couplings: list[Coupling]
) -> dict[str, float]:
    """Return the value that every coordinate takes when some are asked for, by the same names [radian or scene unit].

    Locked ones stay, clamped ones are cut to their range, those that follow others follow; absent ones are at rest.
    """
    values = {n: facts.honoured(asked[n]) if n in asked else facts.rest for n, facts in coordinates.items()}
    for coupling in couplings:  # in an order in which what they follow is known
        values[coupling.coordinate] = coupling.function(*(values[name] for name in coupling.of))
    return values


def ordered(couplings: list[Coupling]) -> list[Coupling]:
    """Return the couplings in an order in which each follows what is known by then, or raise SceneError."""
    by_name: dict[str, Coupling] = {}
    for coupling in couplings:
        if by_name.setdefault(coupling.coordinate, coupling) is not coupling:
            raise SceneError(f"coupling of {coupling.coordinate!r} is given twice")
    try:
        order = list(TopologicalSorter({name: one.of for name, one in by_name.items()}).static_order())
    except CycleError as error:
        ring = error.args[1]
        raise SceneError(f"coupling of {ring[0]!r} follows itself; leave one of the ring out") from None
    return [by_name[name] for name in order if name in by_name]


def joint_poses(
    bones: list[str], joints: list[Joint], couplings: list[Coupling], coordinates: dict[str, float]
) -> dict[str, np.ndarray]:
    """Return the (4, 4) pose of every bone, rest coordinates to world; a bone without a joint is fixed."""
    now = joint_values(joints, couplings, coordinates)
    rest = joint_values(joints, couplings, {})
    joint_of = {joint.child: joint for joint in joints}
    poses = {}
    for bone in bones:
        chain, name = [], bone
        while name in joint_of and name not in poses:
            chain.append(joint_of[name])
            name = chain[-1].parent
        pose = poses.setdefault(name, np.eye(4))
        for joint in reversed(chain):
            pose = pose @ joint.motion(now[joint.name], rest[joint.name])
            poses[joint.child] = pose
    return {bone: poses[bone] for bone in bones}


def bones_between(joints: list[Joint], bones: list[str]) -> set[str]:
    """Names of these bones and of those on the way between them, from joint to joint."""
    parents, chains = {joint.child: joint.parent for joint in joints}, []
    for bone in dict.fromkeys(bones):
        chain = [bone]
        while chain[-1] in parents and parents[chain[-1]] not in chain:
            chain.append(parents[chain[-1]])
        chains.append(chain)
    common = set(chains[0]).intersection(*chains)
    root = next((bone for bone in chains[0] if bone in common), None)
    return {bone for chain in chains for bone in chain if bone not in common} | {root or bones[0], *bones}


def joint_values(
    joints: list[Joint], couplings: list[Coupling], coordinates: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Return the values that `resolve` gives, by joint and bare name."""
    values = resolve(coordinates, all_coordinates(joints), couplings)
    return {
        joint.name: {name: values[f"{joint.name}.{name}"] for name in joint.coordinates} for joint in joints
    }
