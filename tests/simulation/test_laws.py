"""Laws of small parts: wherever things lie, however they turn, whatever they are called."""

import math
import re
import threading
import time
from contextlib import nullcontext

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.motion import turned_angle
from rbfmuscle.scene.muscles import (
    FAR_AWAY,
    FARTHEST_CENTRE,
    LARGEST_MM,
    SMALLEST_MM,
    check_centre,
    check_place,
    check_size,
)
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError, SolveError

UNITS = {"mm": 1.0, "cm": 0.1, "m": 1e-3}
SIDES = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]


class TestPlaces:
    """However far, on whichever side: a message names the distance from the box of all bones."""

    @pytest.mark.parametrize(("axis", "sign"), SIDES)
    @pytest.mark.parametrize("share", [0.98, 1.02])
    @pytest.mark.parametrize("what", ["muscle 'it'", "joint 'it'"])
    def test_what_lies_too_far_from_the_bones_is_refused(self, what, axis, sign, share):
        scene = Scene("cubes", units="mm")
        for name, x in (("a", 110.0), ("b", 170.0)):
            scene.add_bone(
                name, trimesh.creation.box((20.0, 20.0, 20.0)).apply_translation([x, -40.0, 30.0])
            )
        low, high = np.array([100.0, -50.0, 20.0]), np.array([180.0, -30.0, 40.0])
        muscle = "muscle" in what
        away = share * (FAR_AWAY if muscle else FARTHEST_CENTRE) * np.linalg.norm(high - low)
        place = 0.5 * (low + high)
        place[axis] = high[axis] + away + muscle if sign > 0 else low[axis] - away - muscle
        ball = trimesh.creation.box((2.0, 2.0, 2.0)).apply_translation(place)

        words = rf"{what}.*lies {re.escape(f'{away:.4g}')} mm away"
        beyond = pytest.raises((MeshError, SceneError), match=words)
        with nullcontext() if share < 1.0 else beyond:
            if muscle:
                check_place("it", Bone("it", ball), scene.bones, scene.units)
            else:
                check_centre("it", place, scene.bones, scene.units)

    @pytest.mark.parametrize("units", UNITS)
    def test_size_is_judged_in_millimetres_whatever_the_unit(self, units):
        for share, fine in ((1.02, True), (0.98, False)):
            for millimetres in (share * SMALLEST_MM, LARGEST_MM / share):
                side = millimetres * UNITS[units] / math.sqrt(3.0)
                box = trimesh.creation.box((side, side, side))
                refused = pytest.raises(MeshError, match=rf"bone 'b' .* {units} across")
                with nullcontext() if fine else refused:
                    check_size("bone", "b", Bone("b", box), units)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.floats(1e-9, math.pi - 1e-6),
)
def test_angle_of_a_turn_is_its_angle_about_any_axis_and_way_round(axis, angle):
    axis = np.array(axis) / np.linalg.norm(axis)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    assert turned_angle(turn) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert turned_angle(turn.T) == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_an_error_in_parallel_is_raised_once_nothing_goes_on_any_more(monkeypatch):
    monkeypatch.setattr("rbfmuscle.geometry.threads.thread_count", lambda: 2)
    ended = threading.Event()

    def act(value):
        if value:
            raise SolveError("no equilibrium")
        time.sleep(0.2)
        ended.set()

    with pytest.raises(SolveError):
        each(act, [0, 1])
    assert ended.is_set()
