"""In how many frames of a motion each muscle will have to be solved, and in how many it is carried as it is."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.sim.loop.carrying import CARRIED, SKIPPED, SOLVED, STILL, OwnBones, why_never
from rbfmuscle.sim.loop.substeps import PoseMemo, SubSteps
from rbfmuscle.sim.scene.motion import completed, rest_coordinates

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.objects import Muscle
    from rbfmuscle.sim.scene.scene import Scene

_IDENTITY = np.eye(4)


def plan_work(scene: Scene, met: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
    """Count what a motion asks of each muscle.

    Parameters
    ----------
    scene : Scene
    met : mapping of str to sequence of str
        Bones that each muscle can meet.

    Returns
    -------
    dict
        Muscle -> ``solved``, ``carried``, ``skipped`` (frames), ``substeps``, and ``reason`` for the most of them. A
        bone that comes near a muscle is not foreseen: it may be solved in more frames than this.
    """
    poses = PoseMemo(scene)
    shared = SubSteps(scene, poses=poses)
    found = {}
    for muscle in scene.muscles:
        never = why_never(muscle, scene)
        cut = shared if never else SubSteps(scene, muscle, bones=met.get(muscle.name, ()), poses=poses)
        found[muscle.name] = _count(muscle, scene, cut, poses, never)
    return found


def _count(muscle: Muscle, scene: Scene, cut: SubSteps, poses: PoseMemo, never: str) -> dict[str, Any]:
    own, states, reasons = OwnBones(muscle, scene), Counter(), Counter()
    here: dict[str, float] = rest_coordinates(scene)
    solved, substeps = poses(here), 0
    for frame in scene.motion.frames:
        there = completed(scene, frame)
        steps, moved = 0, False
        for before, after in itertools.pairwise([here, *cut.split(here, there)]):
            angle, bone = own.apart(solved, poses(after))
            if never or angle > max(own.still, STILL):
                steps, solved = steps + 1, poses(after)
                reasons[never or f"{bone} against {own.names[0]}"] += 1
            else:
                change = own.carriage(poses(before), poses(after)) - _IDENTITY
                moved = moved or abs(change).max() > STILL
        substeps += steps
        states[SOLVED if steps else CARRIED if moved else SKIPPED] += 1
        here = there
    if not reasons:
        reasons[f"{', '.join(own.names)} as one" if states[CARRIED] else "its bones rest"] += 1
    return {
        **{state: states[state] for state in (SOLVED, CARRIED, SKIPPED)},
        "substeps": substeps,
        "reason": reasons.most_common(1)[0][0],
    }
