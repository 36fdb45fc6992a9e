"""How a muscle answers when one coordinate is changed a little at its pose: what moment arms are made of."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbfmuscle.sim.joints.skeleton import all_coordinates
from rbfmuscle.sim.loop.stepper import MuscleStepper
from rbfmuscle.sim.scene.motion import bone_poses
from rbfmuscle.sim.scene.options import ArmOptions
from rbfmuscle.sim.scene.scene import Scene

# A run settles a muscle on its way; one that is nudged has to settle in place: after 25 solves moment arms of the
# phantom err by 1.4 mm, after 50 by 0.3 and after 200 by 0.4. It has settled where no point moves by more than this
# share of the muscle's size in a solve.
MOST_SOLVES = 60
SETTLED = 3e-7
# A coordinate moves a muscle where its bones change their places against each other by more than this.
LEAST_CHANGE = 1e-9


class Nudged(NamedTuple):
    """A muscle with one coordinate a little lower, and a little higher.

    Attributes
    ----------
    span : float
        How far both are apart [radian, or scene unit for a shift].
    below, above : tuple of (vertices, poses)
        Of the carried mesh, and of the bones.
    """

    span: float
    below: tuple[np.ndarray, dict]
    above: tuple[np.ndarray, dict]


def moving_coordinates(scene: Scene, bones: list[str], coordinates: Mapping[str, float]) -> dict[str, tuple]:
    """Return the coordinates that move some bones against each other, each with what a step down and up makes of it.

    Locked ones and those that follow others are left out, as is what a clamp holds on both sides.

    Parameters
    ----------
    scene : Scene
    bones : list of str
        Those that hold a muscle.
    coordinates : mapping of str to float

    Returns
    -------
    dict of str to (float, float)
        Values below and above, one step of the scene's ``output.moment_arms`` away [radian or scene unit].
    """
    facts = all_coordinates(scene.joints)
    followers = {coupling.coordinate for coupling in scene.couplings}
    found = {}
    for name, fact in facts.items():
        if name in followers or fact.locked:
            continue
        size = step_size(scene, fact.motion)
        here = fact.honoured(coordinates.get(name, fact.rest))
        ends = tuple(fact.honoured(here + side * size) for side in (-1.0, 1.0))
        if ends[0] == ends[1]:
            continue
        places = [_relative(scene, bones, {**coordinates, name: value}) for value in ends]
        if max(np.abs(a - b).max() for a, b in zip(*places)) > LEAST_CHANGE * scene.length(1000.0):
            found[name] = ends
    return found


def step_size(scene: Scene, motion: str) -> float:
    """Return how far a coordinate is nudged to either side: degrees for turns, millimetres for shifts."""
    arms = scene.output.moment_arms
    step = arms.step if arms else ArmOptions().step
    return scene.length(step) if motion == "translation" else math.radians(step)


def nudge(stepper: MuscleStepper, coordinates: Mapping[str, float]) -> dict[str, Nudged]:
    """Change one coordinate after the other, let the muscle settle, and put all back.

    Parameters
    ----------
    stepper : MuscleStepper
    coordinates : mapping of str to float
        Where the muscle is.

    Returns
    -------
    dict of str to Nudged
        By the coordinates that move the muscle.
    """
    scene, model = stepper.scene, stepper.model
    bones = sorted({attachment.bone for attachment in scene.muscle(stepper.name).attachments})
    ends = moving_coordinates(scene, bones, coordinates)
    state, here, found = model.snapshot(), bone_poses(scene, dict(coordinates)), {}
    with stepper.timed("nudge"):
        for name, values in ends.items():
            sides = []
            for value in values:
                there = {**coordinates, name: value}
                poses = bone_poses(scene, there)
                vertices = model.respond(stepper.contacts, here, poses)
                if vertices is None:
                    model.restore(state)
                    stepper.contacts.move(poses)
                    model.predict(here, poses)
                    settle(stepper, there)
                    vertices = np.array(model.carried_mesh()[0])
                sides.append((vertices, poses))
            found[name] = Nudged(values[1] - values[0], *sides)
        model.restore(state)
        stepper.contacts.move(here)
    return found


def settle(stepper: MuscleStepper, coordinates: Mapping[str, float]) -> None:
    """Solve a muscle where it is until it has come to rest there, or has had `MOST_SOLVES`."""
    points = stepper.model.contact_points().copy()
    small = SETTLED * float(np.linalg.norm(np.ptp(points, axis=0)))
    for _ in range(MOST_SOLVES):
        stepper.solve(dict(coordinates))
        before, points = points, stepper.model.contact_points().copy()
        if np.abs(points - before).max() <= small:
            return


def _relative(scene, bones, coordinates):
    poses = bone_poses(scene, coordinates)
    back = np.linalg.inv(poses[bones[0]])
    return [back @ poses[bone] for bone in bones[1:]] or [np.eye(4)]
