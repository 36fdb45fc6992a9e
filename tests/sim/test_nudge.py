"""Moment arms of every coordinate at a frame's pose: against a fine ramp, and what is left as it was."""

import numpy as np
import pytest

from rbfmuscle.run import simulate
from rbfmuscle.sim.loop.nudge import moving_coordinates
from rbfmuscle.sim.scene.motion import Motion
from rbfmuscle.sim.scene.phantom import phantom_scene

NAMES = ("hip.flexion", "hip.adduction", "hip.internal_rotation")
POSE = np.radians([20.0, 6.0, 0.0])
QUIET = {"output.surfaces": False}


@pytest.fixture(scope="module")
def scene():
    made = phantom_scene()
    made.muscles = [muscle for muscle in made.muscles if muscle.name == "abductor"]
    return made


def at(pose):
    return dict(zip(NAMES, map(float, pose)))


def way(steps=6):
    return [at(POSE * k / steps) for k in range(steps + 1)]


def test_arms_are_those_of_a_fine_ramp(scene):
    scene = scene.copy()
    scene.motion = Motion(way())
    run = simulate(scene, frames="-1", settings={**QUIET, "output.moment_arms": True})
    arms = {row.coordinate: row.value for row in run.metrics if row.quantity == "moment_arm"}
    assert set(arms) == set(NAMES)
    for k in (0, 1):
        change = np.radians(np.arange(-2.0, 2.01, 0.2))
        ramp = [at(POSE + np.eye(3)[k] * value) for value in change]
        scene.motion = Motion(
            [*way(), *(at(POSE - np.eye(3)[k] * v) for v in np.radians([0.5, 1, 1.5])), *ramp]
        )
        length = simulate(scene, settings=QUIET).values("abductor", "length")[-len(ramp) :]
        # The ramp's own slope is known to 0.2 mm: its length ripples.
        assert arms[NAMES[k]] == pytest.approx(-np.polyfit(change, length, 2)[1], abs=0.5)


def test_asking_for_arms_changes_nothing_else(scene):
    scene = scene.copy()
    scene.motion = Motion(way(3))
    plain = simulate(scene, settings=QUIET)
    asked = simulate(scene, settings={**QUIET, "output.moment_arms": {"step": 0.5}})
    for one, two in zip(plain.frames, asked.frames):
        assert np.array_equal(one.carried["abductor"][0], two.carried["abductor"][0])
    assert not plain.frames[-1].nudged


def test_a_shift_has_an_arm_without_unit_and_what_follows_is_not_asked(scene):
    moved = scene.copy()
    moved.joints = []
    moved.add_joint("s", "pelvis", "femur", (0, 0, 0), type="slider", axes={"up": (0, 0, 1)})
    moved.output = moved.output.changed("moment_arms", True, place="")
    bones = [attachment.bone for attachment in moved.muscles[0].attachments]
    assert moving_coordinates(moved, bones, {"s.up": 2.0}) == {"s.up": (1.0, 3.0)}
    assert moving_coordinates(moved, bones[:1], {}) == {}
    moved.motion = Motion([{"s.up": 1.0}])
    rows = [r for r in simulate(moved, settings=QUIET).metrics if r.quantity == "moment_arm"]
    assert [(row.coordinate, row.unit) for row in rows] == [("s.up", "1")]
    assert 0.5 < abs(rows[0].value) <= 1.0
