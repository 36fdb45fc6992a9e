"""One pose by several ways: where they lead, and how far apart shapes are."""

import json

import numpy as np
import pytest

import rbfmuscle as rm
from rbfmuscle.app import run_command
from rbfmuscle.commands.poses.ways import compare_ways
from rbfmuscle.study.experiment.ways import spread, ways_to
from rbfmuscle.validation import UsageError

POSE = {"hip.flexion": 12.0, "hip.adduction": -6.0}


def test_all_ways_end_in_the_pose():
    scene = rm.phantom_scene()
    found = ways_to(POSE, {"hip.internal_rotation": 9.0})
    assert set(found) == {"all at once", "hip.flexion first", "hip.adduction first", "random walk", "detour"}
    middles = []
    for waypoints in found.values():
        scene.set_motion(waypoints=waypoints, step=2.0)
        first, last = (scene.motion.frames[k] for k in (0, -1))
        assert not any(first.values())
        assert {k: np.degrees(v) for k, v in last.items() if v} == pytest.approx(POSE)
        middles.append(tuple(scene.motion.frames[len(scene.motion.frames) // 2].values()))
    assert len(set(middles)) == len(found)
    with pytest.raises(UsageError, match="not at 0"):
        ways_to({"hip.flexion": 0.0})


def test_spread_is_that_of_the_farthest_two():
    still = np.zeros((5, 3))
    far = still + [0.0, 3.0, 4.0]
    far[0] = [13.0, 0.0, 0.0]
    found = spread({"a": still, "b": still + [1.0, 0.0, 0.0], "c": far})
    assert found["between"] == ["a", "c"]
    assert found["rms"] == pytest.approx(np.sqrt((13**2 + 4 * 25) / 5))
    assert found["greatest"] == 13.0


def test_a_muscle_that_settles_is_where_it_was_by_another_way():
    scene = rm.phantom_scene(spacing=5.0)
    scene.muscles = [scene.muscle("abductor")]
    scene = scene.with_options({"model.centres": 100, "model.samples": 400})
    ways = {name: way for name, way in ways_to(POSE).items() if name != "random walk"}
    found = compare_ways(scene, ways, step=3.0)["abductor"]
    # Nothing is in its way here; an iteration ends at 1e-4 of the muscle's size.
    assert 0.0 < found["rms"] < 0.3
    assert found["rms"] <= found["greatest"] < 1.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pose", "hip.flexion"], "COORDINATE=VALUE"),
        (["--pose", "hip.flexon=3"], "did you mean 'hip.flexion'"),
        (["--pose", "hip.flexion=3", "--through", "knee=x"], "--through takes"),
    ],
)
def test_wrong_words_are_wrong_usage(words, said, capfd):
    assert run_command(["ways", "phantom", *words]) == 2
    assert said in capfd.readouterr().err


def test_json_is_all_that_is_printed(capfd):
    words = ["ways", "phantom", "--model", "pbd", "--pose", "hip.flexion=2", "--json"]
    assert run_command(words) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["units"] == "mm"
    assert set(found["muscles"]) == {m.name for m in rm.phantom_scene().muscles}
