"""Tendons that meshes of bellies lack: an end far from its bone slides along the tendon's line.

An end that a distant bone held rigidly would swing with it through other bones. It is held by a stub instead, a small
bone put aside, on a slider that follows the joint between by the change of the tendon's length: straight from the end
to its bone.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.importers.guess.attachments import FAR

# Angles [degree] at which the tendon's length is taken.
ANGLES = tuple(range(-150, 151, 10))
# The stub's radius, and how far beyond everything it lies, where nothing meets it [mm].
RADIUS, ASIDE = 3.0, 60.0


@dataclass
class TendonGuess:
    """What carries an end that stops short of its bone.

    Attributes
    ----------
    name : str
        Of the stub.
    guide : Part
        The bone that the end slides against.
    joint : JointGuess
        The hinge, or the path of the patella, whose angle drives it.
    direction : (3,) ndarray
        Unit, from the end to the bone.
    place : (3,) ndarray
        Of the stub [scene unit].
    slides : (n,) ndarray
        At `ANGLES`, zero at rest [scene unit].
    """

    name: str
    guide: Any
    joint: Any
    direction: np.ndarray
    place: np.ndarray
    slides: np.ndarray


def guess_tendons(guess: Any, millimetre: float) -> None:
    """Give a tendon to each hold far from its bone that one hinge moves against the muscle's belly.

    Others are held by the bone as they are, and their muscle says so.

    Parameters
    ----------
    guess : SceneGuess
        With its muscles.
    millimetre : float
        Length of a millimetre in scene units.
    """
    every = np.vstack([part.points for part in [*guess.bones, *(m.muscle for m in guess.muscles)]])
    corner, number = every.max(axis=0) + ASIDE * millimetre, 0
    for muscle in guess.muscles:
        for hold in muscle.holds:
            if hold.gap <= FAR or muscle.wrong or len(muscle.holds) < 2:
                continue
            hold.tendon = _tendon(guess, muscle, hold)
            if hold.tendon is None:
                muscle.reasons.append(
                    f"no single hinge lies before the {hold.bone.name}: held by it as by a rigid rod"
                )
                continue
            hold.tendon.place = corner - [0.0, 0.0, 4.0 * RADIUS * millimetre * number]
            number += 1


def _tendon(guess, muscle, hold):
    """The tendon of a hold, None where not exactly one hinge lies between its bone and the bone beside the end."""
    others = [other.bone for other in muscle.holds if other is not hold]
    path = _path(guess.joints, hold.bone, others[0])
    if path is None or len(path) < 2:
        return None
    end = muscle.muscle.points[hold.vertices].mean(axis=0)
    # The bone beside the end: the nearest of those on the way that the joints before its own bone move.
    movable = [k for k in range(1, len(path)) if _between(guess.joints, path[k - 1], path[k]).kind != "fixed"]
    if not movable:
        return None
    beside = range(movable[0], len(path))
    k = min(beside, key=lambda k: float(((path[k].points - end) ** 2).sum(axis=1).min()))
    crossed = [_between(guess.joints, a, b) for a, b in itertools.pairwise(path[: k + 1])]
    moving = [joint for joint in crossed if joint.kind != "fixed"]
    if len(moving) != 1 or moving[0].kind not in ("hinge", "custom"):
        return None
    target = hold.bone.points[np.argmin(((hold.bone.points - end) ** 2).sum(axis=1))]
    way = target - end
    length = float(np.linalg.norm(way))
    joint, guide = moving[0], path[k]
    outward = any(bone is joint.child for bone in _way_up(guess.joints, hold.bone))
    slides = [_excursion(end, target, joint, angle if outward else -angle) - length for angle in ANGLES]
    name = f"{muscle.muscle.name}_{hold.bone.name}_tendon"
    return TendonGuess(name, guide, joint, way / length, end, np.array(slides))


def _excursion(end, target, joint, angle):
    """Length from the end to where its bone takes the tendon at an angle [degree] from rest of the hinge."""
    pose = joint.pose(angle)
    return float(np.linalg.norm(pose[:3, :3] @ target + pose[:3, 3] - end))


def _between(joints, one, other):
    """The joint of two neighbours in the tree."""
    for joint in joints:
        if {id(joint.parent), id(joint.child)} == {id(one), id(other)}:
            return joint
    raise ValueError(f"{one.name} and {other.name} are no neighbours")


def _path(joints, start, end):
    """Bones from one to another through the tree, None where there is no way."""
    first, second = _way_up(joints, start), _way_up(joints, end)
    known = {id(bone): k for k, bone in enumerate(second)}
    for k, bone in enumerate(first):
        if id(bone) in known:
            return first[: k + 1] + second[: known[id(bone)]][::-1]
    return None


def _way_up(joints, bone):
    """A bone, the one that it hangs on, and so on to the root."""
    parents, found = {id(joint.child): joint.parent for joint in joints}, [bone]
    while id(found[-1]) in parents:
        found.append(parents[id(found[-1])])
    return found


def tendons_of(guess: Any) -> list[TendonGuess]:
    """The tendons of the muscles that run."""
    return [
        hold.tendon
        for muscle in guess.muscles
        if not muscle.wrong
        for hold in muscle.holds
        if hold.tendon is not None
    ]


def write_stubs(guess: Any, folder: Path, millimetre: float) -> None:
    """Write the stubs' meshes to ``tendons/`` in the scene's folder."""
    import trimesh

    for tendon in tendons_of(guess):
        (folder / "tendons").mkdir(exist_ok=True)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS * millimetre)
        ball.apply_translation(tendon.place)
        ball.export(folder / stub_file(tendon))


def stub_file(tendon: TendonGuess) -> str:
    """A stub's mesh, relative to the scene's folder."""
    return f"tendons/{tendon.name}.ply"
