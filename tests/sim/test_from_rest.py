"""``contact.from_rest``: each frame is reached from rest, so that a shape is a function of the pose alone."""

import itertools

import numpy as np
import pytest

import rbfmuscle as rm
from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.simulate import FrameLoop, simulate_frames
from rbfmuscle.sim.loop.substeps import SubSteps

DEG = np.pi / 180.0
FLEXION, ADDUCTION = "hip.flexion", "hip.adduction"
POSE = {FLEXION: 24.0, ADDUCTION: -10.0}
WAYS = ([{}, POSE], [{}, {FLEXION: 24.0}, POSE], [{}, {ADDUCTION: -15.0}, {FLEXION: 30.0}, POSE])


def _scene(model, waypoints, *, muscles=("extensor",), step=6.0, **changes):
    scene = rm.phantom_scene(spacing=6.0)
    scene.muscles = [scene.muscle(name) for name in muscles]
    for muscle in scene.muscles:
        muscle.model = model
        muscle.options = {"centres": 80, "samples": 600} if model == "rbf" else {}
    scene = scene.with_options({"contact.from_rest": True, **changes})
    scene.set_motion(waypoints=waypoints, step=step)
    return scene


def _frames(scene, **options):
    return list(simulate_frames(scene, build_models(scene), surfaces=False, **options))


@pytest.mark.parametrize("model", ["rbf", "pbd"])
def test_shape_is_a_function_of_the_pose_alone(model):
    ends = [_frames(_scene(model, way))[-1].carried["extensor"][0] for way in WAYS]
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])


def test_shape_with_an_inside_is_a_function_of_the_pose_alone():
    inside = {"model.inside": 60}
    ends = [_frames(_scene("rbf", way, **inside))[-1].carried["extensor"][0] for way in WAYS[1:]]
    np.testing.assert_array_equal(*ends)


def test_muscles_that_slide_depend_on_the_pose_alone():
    pair, ends = ("adductor_anterior", "adductor_posterior"), []
    for way in (
        [{}, {FLEXION: 12.0, ADDUCTION: 6.0}],
        [{}, {FLEXION: 12.0}, {FLEXION: 12.0, ADDUCTION: 6.0}],
    ):
        scene = _scene("pbd", way, muscles=pair, **{"sliding.threshold": 3.0})
        ends.append(_frames(scene)[-1].carried)
    for name in pair:
        np.testing.assert_array_equal(ends[0][name][0], ends[1][name][0])


def test_ramp_takes_what_it_took():
    plain = _scene("pbd", [{}, {FLEXION: 20.0}], step=4.0, **{"contact.from_rest": False})
    rest = _scene("pbd", [{}, {FLEXION: 20.0}], step=4.0)
    for one, other in zip(_frames(plain), _frames(rest), strict=True):
        assert one.work["extensor"].substeps == other.work["extensor"].substeps
        # Stops are rounded to 1e-10 of a radian.
        np.testing.assert_allclose(one.carried["extensor"][0], other.carried["extensor"][0], atol=1e-6)


def test_way_back_is_taken_from_what_was_passed():
    scene = _scene("pbd", [{}, {FLEXION: 20.0}, {FLEXION: 8.0}], step=4.0)
    frames = _frames(scene)
    there, back = frames[2], frames[-1]
    assert there.coordinates[FLEXION] == pytest.approx(8.0 * DEG)
    np.testing.assert_array_equal(there.carried["extensor"][0], back.carried["extensor"][0])
    assert back.work["extensor"].state == "skipped"


def test_carried_muscle_comes_back_to_where_it_was():
    # The pelvis holds the abductor, too: at a pose that was passed before nothing is solved.
    scene = _scene("pbd", [{}, POSE])
    models = build_models(scene)
    with FrameLoop(scene, models, surfaces=False) as loop:
        radians = {key: value * DEG for key, value in POSE.items()}
        first = loop.advance(radians).carried["extensor"][0].copy()
        loop.advance({})
        # Back at rest, to the last digit.
        np.testing.assert_array_equal(
            loop.steppers[0].model.carried_mesh()[0], build_models(scene)[0].carried_mesh()[0]
        )
        np.testing.assert_array_equal(loop.advance(radians).carried["extensor"][0], first)


def test_sub_steps_from_rest_are_short_and_shared_in_one_direction():
    scene = _scene("pbd", [{}, POSE])
    cut = SubSteps(scene, scene.muscles[0])
    radians = {key: value * DEG for key, value in POSE.items()}
    stops = cut.from_rest({}, radians)
    half = cut.from_rest({}, {key: 0.5 * value for key, value in radians.items()})
    assert stops[-1] == pytest.approx(radians, abs=1e-10) and half[:-1] == stops[: len(half) - 1]
    for one, other in itertools.pairwise([{}, *stops]):
        assert max(abs(other[k] - one.get(k, 0.0)) for k in other) <= (2.0 + 1e-6) * DEG
    assert cut.from_rest({}, {}) == []
