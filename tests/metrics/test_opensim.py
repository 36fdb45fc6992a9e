"""Motions from OpenSim; moment arms of the real hip."""

import numpy as np

from rbfmuscle.run import simulate


def test_moment_arms_of_the_real_hip_have_the_right_signs_and_sum(hip_scene):
    """Gluteus maximus and medius extend, the iliacus flexes; the adductor brevis flexes first, then extends."""
    wanted = {
        "gluteus_maximus": (-1, -1),
        "gluteus_medius": (-1, -1),
        "iliacus": (1, 1),
        "adductor_brevis": (1, -1),
    }
    made = simulate(hip_scene, settings={"output.surfaces": False}, frames="0:46:3")
    angle = np.array([frame.coordinates["hip.flexion"] for frame in made.frames])
    for muscle, signs in wanted.items():
        length, arm = made.values(muscle, "length"), made.values(muscle, "moment_arm")
        assert tuple(np.sign([arm[0], arm[-1]])) == signs
        change = -np.cumsum(0.5 * (arm[1:] + arm[:-1]) * np.diff(angle))
        # 6 degrees a frame: the one-sided arms at both ends err by half a step's change.
        assert np.abs(length[1:] - length[0] - change).max() <= 0.01 * length[0]
