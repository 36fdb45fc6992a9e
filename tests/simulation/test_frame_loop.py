"""The frame loop: sub-steps, reach, parallel muscles, interrupts, times, laziness."""

import sys
import threading
from itertools import pairwise

import numpy as np
import pytest
from toy_scene import ToyMuscle, attach, bone, box, ellipsoid, hinged_scene, joint, muscle, scene, sphere

from rbfmuscle import models
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.plan.contact_pairs import find_contact_pairs, sampled_poses
from rbfmuscle.simulation.substeps import SubSteps, turned_angle
from rbfmuscle.validation import SceneError, SolveError, UsageError


def _run(angles, **options):
    made, fields = hinged_scene(angles, **options)
    model = ToyMuscle(made.muscles[0], made)
    return list(simulate_frames(made, [model], fields=fields)), model


def test_frames_carry_what_they_promise():
    frames, model = _run([0, 10, 20], tunnelling=TunnellingOptions())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[2].coordinates == {"hinge.bend": np.radians(20)}
    last = frames[-1]
    assert np.array_equal(last.surfaces["strap"].vertices, model.x)
    assert np.array_equal(last.carried["strap"][0], model.x)
    assert np.allclose(last.poses["trunk"], np.eye(4))
    times = last.times["strap"]
    assert set(times) == {"time_predict", "time_solve", "time_tunnelling", "time_surface", "time_frame"}
    assert times["time_frame"] == pytest.approx(sum(v for k, v in times.items() if k != "time_frame"))
    assert times["time_frame"] > 0.0
    assert sum(f.wall for f in frames) >= sum(f.times["strap"].get("time_solve", 0.0) for f in frames)


def test_a_failing_frame_leaves_those_before():
    made, fields = hinged_scene([0, 10, 20, 30])
    model = ToyMuscle(made.muscles[0], made)
    predict = model.predict

    def fails_in_the_third(before, after):
        if min(np.trace(pose) for pose in after.values()) < 2 + 2 * np.cos(np.radians(15)):
            raise SolveError("planted")
        predict(before, after)

    model.predict = fails_in_the_third
    seen = []
    with pytest.raises(SolveError, match="planted"):
        for frame in simulate_frames(made, [model], fields=fields):
            seen.append((frame.index, sorted(frame.surfaces)))
    assert seen == [(0, ["strap"]), (1, ["strap"])]


def test_muscle_stays_out_of_the_bone_it_wraps():
    made, fields = hinged_scene([0, 40, 80])
    model = ToyMuscle(made.muscles[0], made)
    for frame in simulate_frames(made, [model], fields=fields):
        distance = fields["trunk"].distance(model.x[model.contact_bone < 0], frame.poses["trunk"])
        assert distance.min() > -0.05


def test_first_frame_is_reached_from_the_rest_pose():
    direct, _ = _run([60])
    stepped, _ = _run([0, 20, 40, 60])
    assert direct[0].index == 0
    # The toy's target does not depend on the path; only contact does.
    assert np.allclose(
        direct[-1].surfaces["strap"].vertices, stepped[-1].surfaces["strap"].vertices, atol=0.05
    )


def test_sub_steps_bound_turn_and_travel():
    made, _ = hinged_scene([0, 45])
    before, after = made.motion.frames
    stops = SubSteps(made).split(before, after)
    assert stops[-1] == after
    poses = [bone_poses(made, c)["arm"] for c in (before, *stops)]
    turns = [turned_angle(b[:3, :3] @ a[:3, :3].T) for a, b in pairwise(poses)]
    assert max(turns) <= np.radians(2.0) * (1 + 1e-9)
    diagonal = np.linalg.norm(np.ptp(made.muscles[0].mesh.bounds, axis=0))
    held = made.muscles[0].mesh.vertices[made.muscles[0].attachments[1].vertices]
    for a, b in pairwise(poses):
        moved = np.linalg.norm(held @ (b - a)[:3, :3].T + (b - a)[:3, 3], axis=1)
        assert moved.max() <= diagonal / 27 * (1 + 1e-9)
    assert SubSteps(made).split(after, after) == []


def test_sub_steps_end_at_the_same_angles_however_frames_are_spaced():
    made, _ = hinged_scene([0, 30])
    start, end = made.motion.frames

    def path(degrees):
        stops = [start, *({"hinge.bend": np.radians(d)} for d in degrees)]
        return [s["hinge.bend"] for a, b in pairwise(stops) for s in SubSteps(made).split(a, b)]

    whole = np.array(path([30]))
    np.testing.assert_array_equal(path([10, 20, 30]), whole)
    with_seven = np.array(path([7, 30]))
    np.testing.assert_allclose(
        np.setdiff1d(with_seven.round(9), np.radians([7]).round(9)), whole.round(9), rtol=0
    )
    back = np.array([s["hinge.bend"] for s in SubSteps(made).split(end, start)])
    np.testing.assert_allclose(back[-2::-1], whole[:-1], rtol=0, atol=1e-12)


def test_whole_turn_in_one_step_is_split():
    made, _ = hinged_scene([0, 360])
    assert len(SubSteps(made).split(*made.motion.frames)) >= 180


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, 3.1])
def test_turned_angle(angle):
    c, s = np.cos(angle), np.sin(angle)
    assert turned_angle(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])) == pytest.approx(angle, rel=1e-9)


def test_bones_out_of_reach_are_left_out():
    fields = {"near": sphere(5.0), "far": box((2, 2, 2), (500, 0, 0))}
    mesh = ellipsoid((10, 3, 3), (0, 0, 9))
    ends = [attach(mesh, "near", lambda v: v[:, 0] < -8)]
    made = scene([bone(n, f) for n, f in fields.items()], [], [muscle("m", mesh, ends)], [{}])
    assert set(find_contact_pairs(made)) == {("m", "near")}


def test_swept_region_follows_the_motion():
    made, fields = hinged_scene([0, 90])
    fields["post"] = box((2, 2, 2), (0, -30, 0))
    made.bones.append(bone("post", fields["post"]))
    assert ("strap", "post") in find_contact_pairs(made)
    assert len(sampled_poses(made)) > 9
    made.motion.frames[:] = [{}]
    assert ("strap", "post") not in find_contact_pairs(made)


class _Breaking(ToyMuscle):
    def solve(self, contacts):
        super().solve(contacts)
        if self.solves > 12:
            self.x = self.x * np.nan


class _Interrupting(ToyMuscle):
    def solve(self, contacts):
        super().solve(contacts)
        if self.solves > 12:
            raise KeyboardInterrupt


class _Singular(ToyMuscle):
    def solve(self, contacts):
        raise np.linalg.LinAlgError("singular matrix")


@pytest.mark.parametrize("count", [1, 3])
def test_failing_solve_names_muscle_frame_and_coordinate_and_keeps_the_frames(count):
    made, fields = hinged_scene([0, 10, 20, 30, 40])
    parts = [_Breaking(made.muscles[0], made) for _ in range(count)]
    frames = []
    with pytest.raises(SolveError, match=r"'strap', frame 3 \(hinge.bend = .*deg\).*not finite"):
        for frame in simulate_frames(made, parts, fields=fields):
            frames.append(frame)
    assert [frame.index for frame in frames] == [0, 1, 2]


def test_singular_system_becomes_a_solve_error():
    made, fields = hinged_scene([0, 10])
    with pytest.raises(SolveError, match=r"frame 1 .*singular matrix"):
        list(simulate_frames(made, [_Singular(made.muscles[0], made)], fields=fields))


def test_interrupt_keeps_the_frames_so_far():
    made, fields = hinged_scene([0, 10, 20, 30])
    frames = []
    with pytest.raises(KeyboardInterrupt):
        for frame in simulate_frames(made, [_Interrupting(made.muscles[0], made)], fields=fields):
            frames.append(frame)
    assert len(frames) == 3


def test_leaving_early_ends_the_workers():
    made, fields = hinged_scene([0, 10, 20])
    parts = [ToyMuscle(made.muscles[0], made) for _ in range(2)]
    before = set(threading.enumerate())
    course = simulate_frames(made, parts, fields=fields)
    next(course)
    course.close()
    assert parts[0].solves == 0  # the frames to come are not begun
    assert set(threading.enumerate()) == before


def _several(count):
    """Muscles of different girth side by side over the same two bones."""
    fields = {"trunk": sphere(8.0), "arm": box((15, 2, 2), (30, 0, 0))}
    muscles = []
    for k in range(count):
        mesh = ellipsoid((32, 3, 3), (0, 13.5, 8.0 * k - 8.0))
        ends = [attach(mesh, "trunk", lambda v: v[:, 0] < -24), attach(mesh, "arm", lambda v: v[:, 0] > 24)]
        muscles.append(muscle(f"m{k}", mesh, ends))
    joints = [joint("hinge", "trunk", "arm", (0, 0, 0), bend=(0, 0, -1))]
    frames = [{"hinge.bend": np.radians(a)} for a in (0, 30)]
    return scene([bone(n, f) for n, f in fields.items()], joints, muscles, frames), fields


def test_muscles_in_parallel_give_what_they_give_alone():
    made, fields = _several(3)
    together = list(simulate_frames(made, [ToyMuscle(m, made) for m in made.muscles], fields=fields))[-1]
    for one in made.muscles:
        alone = list(simulate_frames(made, [ToyMuscle(one, made)], fields=fields))[-1]
        assert np.array_equal(alone.surfaces[one.name].vertices, together.surfaces[one.name].vertices)


def test_models_may_come_as_a_dict_and_frames_be_chosen():
    made, fields = hinged_scene([0, 10, 20, 30])
    model = ToyMuscle(made.muscles[0], made)
    frames = list(simulate_frames(made, {"strap": model}, fields=fields, written={1, 3}))
    assert [frame.index for frame in frames] == [1, 3]


def test_without_surfaces_none_is_extracted():
    made, fields = hinged_scene([0, 10])
    model = ToyMuscle(made.muscles[0], made)
    model.drawing = None
    frames = list(simulate_frames(made, [model], fields=fields, surfaces=False))
    assert frames[-1].surfaces == {}
    assert "time_surface" not in frames[-1].times["strap"]


def test_without_tables_no_optional_module_is_loaded():
    for name in (
        "rbfmuscle.simulation.sliding",
        "rbfmuscle.simulation.neighbour_surface",
        "rbfmuscle.bones.sdf",
    ):
        sys.modules.pop(name, None)
    frames, _ = _run([0, 10])
    assert not {
        "rbfmuscle.simulation.sliding",
        "rbfmuscle.simulation.neighbour_surface",
        "rbfmuscle.bones.sdf",
    } & set(sys.modules)
    assert not {"time_sliding", "time_tunnelling"} & set(frames[-1].times["strap"])


def test_scene_without_bones_in_reach_builds_no_field():
    mesh = ellipsoid((10, 3, 3), (0, 0, 200.0))
    base = sphere(5.0)
    made = scene(
        [bone("base", base)], [], [muscle("m", mesh, [attach(mesh, "base", lambda v: v[:, 0] < -8)])], [{}]
    )
    sys.modules.pop("rbfmuscle.bones.sdf", None)
    (frame,) = simulate_frames(made, [ToyMuscle(made.muscles[0], made)])
    assert "rbfmuscle.bones.sdf" not in sys.modules
    # It stands apart from the bone and nothing moves, so it stays as it is.
    assert np.array_equal(frame.surfaces["m"].vertices, mesh.vertices)


def _crossing():
    """A muscle that is bent by 60 degrees, watched for tunnelling."""
    made, fields = hinged_scene([0, 10, 20, 30], tunnelling=TunnellingOptions())
    return made, fields, ToyMuscle(made.muscles[0], made)


def test_frames_that_are_skipped_leave_the_muscle_where_shown_ones_would():
    made, fields, shown = _crossing()
    with FrameLoop(made, [shown], fields=fields) as loop:
        frames = [loop.advance(coordinates) for coordinates in made.motion.frames]
    made, fields, skipping = _crossing()
    with FrameLoop(made, [skipping], fields=fields) as loop:
        for coordinates in made.motion.frames[:-1]:
            loop.skip(coordinates)
        last = loop.advance(made.motion.frames[-1])
    assert last.index == 3 and np.array_equal(last.surfaces["strap"].vertices, shown.x)
    assert skipping.solves == shown.solves
    # What happened on the way is told with the frame that is shown.
    assert last.events == [event for frame in frames for event in frame.events]
    assert last.times["strap"]["time_solve"] > 0.0


def test_a_loop_follows_a_path_that_is_not_known_beforehand():
    made, fields, model = _crossing()
    with FrameLoop(made, [model], fields=fields) as loop:
        there = [loop.advance({"hinge.bend": np.radians(a)}) for a in (0, 30)]
        back = loop.advance({"hinge.bend": 0.0})
    assert [frame.index for frame in (*there, back)] == [0, 1, 2]
    # The toy's target does not depend on the path; only contact does.
    assert np.allclose(back.surfaces["strap"].vertices, there[0].surfaces["strap"].vertices, atol=0.05)
    assert loop.here == {"hinge.bend": 0.0}


def test_a_loop_that_cannot_begin_ends_its_threads():
    made, fields = hinged_scene([0], initial="error")
    made.muscles[0].mesh.apply_translation([0, -4.0, 0])
    before = threading.active_count()
    with pytest.raises(SceneError, match="overlaps bone 'trunk' at rest"):
        FrameLoop(made, [ToyMuscle(made.muscles[0], made) for _ in range(3)], fields=fields)
    assert threading.active_count() == before


def test_unknown_model_names_the_nearest_right_one():
    made, _ = hinged_scene([0])
    with pytest.raises(UsageError, match="unknown model 'xpdb', did you mean 'xpbd'"):
        models.build_model(made.muscles[0], made, "xpdb")
    with pytest.raises(UsageError, match="known: rbf, pbd"):
        models.build_model(made.muscles[0], made, "finite")
