"""What a run of a scene would build and solve, without building it."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.scene.motion import completed, rest_coordinates
from rbfmuscle.simulation.plan.contact_pairs import find_contact_pairs, union_of
from rbfmuscle.simulation.rigid_transport import CARRIED, SKIPPED, SOLVED, STILL, OwnBones, why_never
from rbfmuscle.simulation.substeps import PoseCache, SubSteps

if TYPE_CHECKING:
    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene


def plan_scene(scene: Scene) -> dict[str, Any]:
    """Return what a run of the scene would build.

    Returns
    -------
    dict
        ``frames`` of the motion; ``substeps`` of the muscle that takes most; ``fields``: of each bone that a muscle can
        reach the triangles and the share of its box; ``muscles``: name, model, vertices, ``bones`` within reach, frames
        in which it is ``solved``, ``carried`` and ``skipped``, its ``substeps``, and ``reason`` for most of them.

    Notes
    -----
    A listed bone need not be touched. A bone that comes near a muscle is not foreseen: the muscle may then
    be solved in more frames.
    """
    regions, poses = find_contact_pairs(scene), PoseCache(scene)
    muscles = []
    for muscle in scene.muscles:
        bones = [bone for name, bone in regions if name == muscle.name]
        facts = {"name": muscle.name, "model": muscle.model, "vertices": len(muscle.mesh.vertices)}
        muscles.append({**facts, "bones": bones, **_work(muscle, scene, bones, poses)})
    return {
        "frames": len(scene.motion),
        "substeps": max((muscle["substeps"] for muscle in muscles), default=0),
        "muscles": muscles,
        "fields": _fields(scene, regions),
    }


def _work(muscle: Muscle, scene: Scene, bones: Sequence[str], poses: PoseCache) -> dict[str, Any]:
    """Frames in which the motion requires a muscle to be solved, moved rigidly or skipped."""
    never = why_never(muscle, scene)
    cut = SubSteps(scene, poses=poses) if never else SubSteps(scene, muscle, bones=bones, poses=poses)
    own, states, reasons = OwnBones(muscle, scene), Counter(), Counter()
    here: dict[str, float] = rest_coordinates(scene)
    solved, substeps = poses(here), 0
    for frame in scene.motion.frames:
        there = completed(scene, frame)
        steps, moved = 0, False
        for before, after in itertools.pairwise([here, *cut.split(here, there)]):
            angle, bone = own.apart(solved, poses(after))
            if never or angle > STILL:
                steps, solved = steps + 1, poses(after)
                reasons[never or f"{bone} against {own.names[0]}"] += 1
            else:
                change = own.carriage(poses(before), poses(after)) - np.eye(4)
                moved = moved or abs(change).max() > STILL
        substeps += steps
        states[SOLVED if steps else CARRIED if moved else SKIPPED] += 1
        here = there
    if not reasons:
        reasons[f"{', '.join(own.names)} as one" if states[CARRIED] else "its bones rest"] += 1
    counts = {state: states[state] for state in (SOLVED, CARRIED, SKIPPED)}
    return {**counts, "substeps": substeps, "reason": reasons.most_common(1)[0][0]}


def _fields(scene, regions):
    fields = []
    for bone in scene.bones:
        boxes = [box for (_, name), box in regions.items() if name == bone.name]
        if boxes:
            own = np.asarray(bone.mesh.bounds, dtype=float)
            reached = np.clip(union_of(boxes), own[0], own[1])
            share = float(np.prod(reached[1] - reached[0]) / np.prod(own[1] - own[0]))
            fields.append({"bone": bone.name, "triangles": len(bone.mesh.faces), "share": share})
    return fields
