"""A muscle whose bones move as one is carried, not solved; what is solved comes out as it ever did."""

import numpy as np
import pytest
import trimesh

import rbfmuscle as rm
from rbfmuscle.models import build_model
from rbfmuscle.scene.objects import Motion
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.plan.plan import plan_scene
from rbfmuscle.simulation.substeps import SubSteps

MODELS = ("rbf", "pbd", "arap-volume")
DEG = np.pi / 180.0


def _box(low, high):
    low, high = np.array(low, float), np.array(high, float)
    mesh = trimesh.creation.box(extents=high - low).subdivide().subdivide()
    mesh.apply_translation(0.5 * (low + high))
    return mesh


def _strap(start, end, radius=5.0, up=9.5):
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = ball.vertices * [0.5 * (end - start), radius, radius] + [0.5 * (start + end), 0.0, up]
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def _arm(angles, muscles=("brachialis",)):
    """A trunk, an upper arm and a forearm in a row; a shoulder and an elbow that bend about y."""
    scene = rm.Scene("arm", units="mm")
    scene.add_bone("trunk", _box([-40, -3, -3], [-1, 3, 3]))
    scene.add_bone("upper", _box([1, -3, -3], [49, 3, 3])).add_bone("fore", _box([51, -3, -3], [100, 3, 3]))
    scene.add_joint("shoulder", "trunk", "upper", (0, 0, 0), {"flexion": (0, -1, 0)})
    scene.add_joint("elbow", "upper", "fore", (50, 0, 0), {"flexion": (0, -1, 0)})
    spans = {"brachialis": (20, 75, "upper", "fore"), "deltoid": (-30, 25, "trunk", "upper")}
    for name in muscles:
        start, end, one, other = spans[name]
        mesh = _strap(start, end)
        x = mesh.vertices[:, 0]
        attach = [
            {"bone": one, "vertices": np.flatnonzero(x < start + 8).tolist()},
            {"bone": other, "vertices": np.flatnonzero(x > end - 8).tolist()},
        ]
        scene.add_muscle(name, mesh, attach=attach)
    scene.motion = Motion([{"shoulder.flexion": a * DEG, "elbow.flexion": b * DEG} for a, b in angles])
    return scene


def _run(scene, name, **options):
    return list(simulate_frames(scene, [build_model(m, scene, name) for m in scene.muscles], **options))


def _in_frame(frame, name, bone):
    """Vertices of a surface as seen from a bone."""
    back = np.linalg.inv(frame.poses[bone])
    return frame.surfaces[name].vertices @ back[:3, :3].T + back[:3, 3]


@pytest.mark.parametrize("name", MODELS)
def test_muscle_of_bones_that_move_as_one_is_carried_rigidly(name):
    scene = _arm([(0, 0), (15, 0), (30, 0)])
    frames = _run(scene, name)
    assert [frame.work["brachialis"].state for frame in frames] == ["skipped", "carried", "carried"]
    still = _in_frame(frames[0], "brachialis", "upper")
    for frame in frames[1:]:
        np.testing.assert_allclose(_in_frame(frame, "brachialis", "upper"), still, atol=1e-9)
        assert frame.times["brachialis"].get("time_solve", 0.0) == 0.0
        np.testing.assert_array_equal(
            frame.surfaces["brachialis"].faces, frames[0].surfaces["brachialis"].faces
        )


@pytest.mark.parametrize("name", MODELS)
def test_muscle_goes_on_after_it_was_carried_as_if_the_world_had_turned(name):
    """Solved states are those of a motion in which the shoulder never moved.

    The elbow extends: bent, the muscle would buckle, and rounding errors would grow.
    """
    turned = _run(_arm([(0, 0), (0, -10), (25, -10), (50, -10), (50, -20)]), name)
    alone = _run(_arm([(0, 0), (0, -10), (0, -20)]), name)
    states = [frame.work["brachialis"].state for frame in turned]
    assert states == ["skipped", "solved", "carried", "carried", "solved"]
    for one, other in ((1, 1), (2, 1), (3, 1), (4, 2)):
        np.testing.assert_allclose(
            _in_frame(turned[one], "brachialis", "upper"),
            _in_frame(alone[other], "brachialis", "upper"),
            atol=1e-5,
        )


def test_frames_that_are_not_written_change_nothing():
    path = [(0, 0), (5, 4), (10, 4), (20, 4), (20, 6)]
    scene = _arm(path, muscles=("brachialis", "deltoid"))
    every = _run(scene, "rbf")
    some = _run(scene, "rbf", written={0, 3, 4})
    assert [frame.index for frame in some] == [0, 3, 4]
    for frame in some:
        for muscle in ("brachialis", "deltoid"):
            # mm: where the search for the level began shows by a millionth of the muscle's length.
            np.testing.assert_allclose(
                frame.surfaces[muscle].vertices, every[frame.index].surfaces[muscle].vertices, atol=1e-4
            )
    # Solved in between, so what was left out counts.
    assert some[1].work["brachialis"].state == "solved" and every[3].work["brachialis"].state == "carried"


def test_bone_that_comes_near_makes_a_muscle_solved():
    scene = _arm([(0, 0), (4, 0), (8, 0)])
    # A bar of the trunk over the upper arm, which the rising arm drives into the belly of the muscle.
    bar = _box([44, -10, 18], [52, 10, 22])
    scene.bones[0].mesh = trimesh.util.concatenate([scene.bones[0].mesh, bar])
    frames = _run(scene, "rbf")
    last = frames[-1].work["brachialis"]
    assert last.state == "solved" and last.reason == "trunk comes near"
    # Carried along it would lie 2.6 mm deep in the bar.
    field = rm.BoneSDF.from_mesh(bar)
    assert field.distance(frames[-1].surfaces["brachialis"].vertices).min() > -0.05


def test_sub_steps_are_those_of_a_muscles_own_bones():
    scene = _arm([(0, 0), (40, 3)], muscles=("brachialis", "deltoid"))
    before, after = scene.motion.frames
    cuts = {m.name: len(SubSteps(scene, m).split(before, after)) for m in scene.muscles}
    # The elbow's three degrees are two steps at 2 and 3; the shoulder's forty are twenty or more.
    assert cuts["brachialis"] <= 3 and cuts["deltoid"] >= 20
    assert SubSteps(scene, scene.muscles[0]).split({}, {"shoulder.flexion": 0.7}) == [
        {"shoulder.flexion": 0.7}
    ]


@pytest.mark.parametrize("name", ["rbf", "pbd"])
def test_order_of_muscles_changes_nothing(name):
    path = [(0, 0), (10, 0), (10, 10), (20, 12)]
    one = _run(_arm(path, muscles=("brachialis", "deltoid")), name)[-1]
    other = _run(_arm(path, muscles=("deltoid", "brachialis")), name)[-1]
    for muscle in ("brachialis", "deltoid"):
        np.testing.assert_array_equal(one.surfaces[muscle].vertices, other.surfaces[muscle].vertices)
        assert one.work[muscle] == other.work[muscle]


def test_going_nowhere_is_skipped_and_shows_the_same_surface():
    scene = _arm([(0, 0)])
    with FrameLoop(scene, [build_model(m, scene, "rbf") for m in scene.muscles]) as loop:
        first = loop.advance({"elbow.flexion": 4 * DEG})
        again = loop.advance({"elbow.flexion": 4 * DEG})
    assert (first.work["brachialis"].state, again.work["brachialis"].state) == ("solved", "skipped")
    np.testing.assert_array_equal(
        first.surfaces["brachialis"].vertices, again.surfaces["brachialis"].vertices
    )


def test_plan_counts_what_a_run_then_does():
    path = [(0, 0), (5, 4), (10, 4), (20, 4), (20, 6), (20, 6)]
    scene = _arm(path, muscles=("brachialis", "deltoid"))
    planned = {muscle["name"]: muscle for muscle in plan_scene(scene)["muscles"]}
    frames = _run(scene, "pbd")
    for muscle, work in planned.items():
        done = [frame.work[muscle] for frame in frames]
        for state in ("solved", "carried", "skipped"):
            assert work[state] == sum(one.state == state for one in done)
        assert work["substeps"] == sum(one.substeps for one in done)
    assert (planned["brachialis"]["carried"], planned["deltoid"]["carried"]) == (2, 0)
    assert planned["deltoid"]["reason"] == "upper against trunk"


def test_whole_leg_moved_at_the_hip_is_solved_where_muscles_cross_the_hip(leg_data):
    scene = rm.Scene.load(leg_data / "leg.toml")
    work = {muscle["name"]: muscle for muscle in plan_scene(scene)["muscles"]}
    solved = sorted(name for name, done in work.items() if done["solved"])
    assert len(work) == 38 and len(solved) == 22
    assert all(work[name]["carried"] == 10 for name in work if name not in solved)
    assert "soleus" not in solved and "rectus_femoris" in solved
