"""A muscle whose bones move as one is carried, not solved; what is solved comes out as it
ever did."""

import numpy as np
import pytest
import trimesh
from toy_scene import box_mesh, ellipsoid, held

import rbfmuscle as rm
from rbfmuscle.models import build_model, build_models
from rbfmuscle.scene.objects import Motion
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.substeps import SubSteps

MODELS = ("rbf", "pbd", "arap-volume")
DEG = np.pi / 180.0


def _arm(angles, muscles=("brachialis",)):
    """A trunk, an upper arm and a forearm in a row; a shoulder and an elbow that bend about y."""
    scene = rm.Scene("arm", units="mm", neighbours=None)
    scene.add_bone("trunk", box_mesh([-40, -3, -3], [-1, 3, 3]))
    scene.add_bone("upper", box_mesh([1, -3, -3], [49, 3, 3]))
    scene.add_bone("fore", box_mesh([51, -3, -3], [100, 3, 3]))
    scene.add_joint(
        "shoulder", "trunk", "upper", (0, 0, 0), {"flexion": (0, -1, 0), "twist": (1, 0, 0)}
    )
    scene.add_joint("elbow", "upper", "fore", (50, 0, 0), {"flexion": (0, -1, 0)})
    spans = {"brachialis": (20, 75, "upper", "fore"), "deltoid": (-30, 25, "trunk", "upper")}
    for name in muscles:
        start, end, one, other = spans[name]
        mesh = ellipsoid(
            (0.5 * (end - start), 5.0, 5.0), (0.5 * (start + end), 0.0, 9.5), subdivisions=3
        )
        x = mesh.vertices[:, 0]
        scene.add_muscle(name, mesh, attach=held(**{one: x < start + 8, other: x > end - 8}))
    scene.motion = Motion(
        [{"shoulder.flexion": a * DEG, "elbow.flexion": b * DEG} for a, b in angles]
    )
    return scene


def _run(scene, name, **options):
    return list(
        simulate_frames(scene, [build_model(m, scene, name) for m in scene.muscles], **options)
    )


def _in_frame(frame, name, bone):
    """Vertices of a surface as seen from a bone."""
    back = np.linalg.inv(frame.poses[bone])
    return frame.surfaces[name].vertices @ back[:3, :3].T + back[:3, 3]


@pytest.mark.parametrize("name", MODELS)
def test_muscle_of_bones_that_move_as_one_is_carried_rigidly(name):
    scene = _arm([(0, 0), (15, 0), (30, 0)])
    scene.motion.frames[2]["shoulder.twist"] = 0.5
    frames = _run(scene, name)
    assert [frame.work["brachialis"].state for frame in frames] == ["skipped", "carried", "carried"]
    still = _in_frame(frames[0], "brachialis", "upper")
    for frame in frames[1:]:
        np.testing.assert_allclose(_in_frame(frame, "brachialis", "upper"), still, atol=1e-9)
        assert frame.times["brachialis"].get("time_solve", 0.0) == 0.0


@pytest.mark.parametrize("name", MODELS)
def test_muscle_goes_on_after_it_was_carried_as_if_the_world_had_turned(name):
    # The elbow extends: bent, the muscle would buckle, and rounding errors would grow.
    turned = _run(_arm([(0, 0), (0, -10), (25, -10), (50, -10), (50, -20)]), name)
    alone = _run(_arm([(0, 0), (0, -10), (0, -20)]), name)
    states = [frame.work["brachialis"].state for frame in turned]
    assert states == ["skipped", "solved", "carried", "carried", "solved"]
    for one, other in ((1, 1), (2, 1), (3, 1), (4, 2)):
        found, wanted = (_in_frame(f, "brachialis", "upper") for f in (turned[one], alone[other]))
        np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_bone_that_comes_near_makes_a_muscle_solved():
    scene = _arm([(0, 0), (4, 0), (8, 0)])
    # A bar of the trunk over the upper arm, which the rising arm drives into the belly of the
    # muscle.
    bar = box_mesh([44, -10, 18], [52, 10, 22])
    scene.bones[0].mesh = trimesh.util.concatenate([scene.bones[0].mesh, bar])
    frames = _run(scene, "rbf")
    assert frames[-1].work["brachialis"].state == "solved"
    # Carried along it would lie 2.6 mm deep in the bar.
    field = rm.BoneSDF.from_mesh(bar)
    assert field.distance(frames[-1].surfaces["brachialis"].vertices).min() > -0.05


def test_sub_steps_are_those_of_a_muscles_own_bones():
    scene = _arm([(0, 0), (40, 3)], muscles=("brachialis", "deltoid"))
    before, after = scene.motion.frames
    cuts = {m.name: len(SubSteps(scene, m).split(before, after)) for m in scene.muscles}
    # The elbow's three degrees are two steps at 2 and 3; the shoulder's forty are twenty or more.
    assert cuts["brachialis"] <= 3 and cuts["deltoid"] >= 20
    end = {"shoulder.flexion": 0.7}
    assert SubSteps(scene, scene.muscles[0]).split({}, end) == [end]


def test_muscles_side_by_side_in_any_order_are_what_they_are_alone():
    path, muscles = [(0, 0), (10, 0), (10, 10), (20, 12)], ("brachialis", "deltoid")
    alone = {name: _run(_arm(path, muscles=(name,)), "rbf")[-1] for name in muscles}
    for order in (muscles, muscles[::-1]):
        together = _run(_arm(path, muscles=order), "rbf")[-1]
        for name, one in alone.items():
            # To rounding: the bones' arrays lie elsewhere, and sums of products may be grouped
            # otherwise.
            np.testing.assert_allclose(
                one.surfaces[name].vertices, together.surfaces[name].vertices, rtol=0.0, atol=1e-9
            )
            assert one.work[name] == together.work[name]


def test_a_muscle_is_solved_in_the_frames_that_move_its_own_joint():
    path = [(0, 0), (5, 4), (10, 4), (20, 4), (20, 6), (20, 6)]
    frames = _run(_arm(path, muscles=("brachialis", "deltoid")), "pbd")
    solved = {"brachialis": [0, 1, 0, 0, 1, 0], "deltoid": [0, 1, 1, 1, 0, 0]}
    for muscle, wanted in solved.items():
        done = [frame.work[muscle] for frame in frames]
        assert [one.substeps > 0 for one in done] == wanted
        # The last frame goes nowhere and shows the same surface.
        assert done[-1].state == "skipped"
        np.testing.assert_array_equal(*(frame.surfaces[muscle].vertices for frame in frames[-2:]))


POSE = {"hip.flexion": np.radians(24.0), "hip.adduction": np.radians(-10.0)}
OTHER = {"hip.flexion": np.radians(30.0)}


def solve_pose(scene, models, coordinates):
    """The frame of one pose, solved straight from rest, to which the models return."""
    rest = [model.snapshot() for model in models]
    frame = FrameLoop(scene, models).advance(coordinates)
    for model, state in zip(models, rest):
        model.restore(state)
    return frame


@pytest.mark.parametrize(
    "model", ["pbd", {"name": "rbf", "centres": 80, "samples": 300, "resolution": 16}]
)
def test_a_pose_is_the_same_whatever_was_solved_before(model):
    scene = rm.phantom_scene(model=model, spacing=6.0)
    scene.muscles = [scene.muscle("extensor")]
    scene.motion = Motion([POSE, OTHER])
    models = build_models(scene)
    first = solve_pose(scene, models, POSE)
    solve_pose(scene, models, OTHER)
    again = solve_pose(scene, models, POSE)
    (alone, _) = simulate_frames(scene, build_models(scene))
    for frame in (again, alone):
        np.testing.assert_array_equal(
            frame.material_meshes["extensor"][0], first.material_meshes["extensor"][0]
        )
