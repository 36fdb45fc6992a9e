"""The frame loop: sub-steps, reach, parallel muscles, interrupts, times, laziness."""

from itertools import pairwise

import numpy as np
import pytest
from blend_model import arm_scene
from tendon_scene import END, arm
from toy_scene import ToyMuscle, bone, box, hinged_scene

from rbfmuscle.scene.motion import bone_poses, turned_angle
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs, sampled_poses
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.substeps import FINER, SubSteps
from rbfmuscle.validation import SceneError, SolveError


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
    others = np.setdiff1d(np.round(path([7, 30]), 9), np.radians([7]).round(9))
    np.testing.assert_allclose(others, whole.round(9), rtol=0)
    back = np.array([s["hinge.bend"] for s in SubSteps(made).split(end, start)])
    np.testing.assert_allclose(back[-2::-1], whole[:-1], rtol=0, atol=1e-12)


def test_a_tendons_end_that_jumps_takes_no_more_sub_steps_than_the_bones_allow():
    made = arm()
    before, after = ({"elbow.bend": np.radians(angle), "elbow.turn": 0.0} for angle in (0, 2))

    def jumping(coordinates):
        poses = bone_poses(made, dict(coordinates))
        end = np.array(poses[END])
        end[0, 3] += 500.0 * (coordinates["elbow.bend"] > np.radians(1.0))
        poses[END] = end
        return poses

    count = len(
        SubSteps(made, made.muscles[0], bones=["trunk"], poses=jumping).split(before, after)
    )
    assert 1 < count <= 2 * FINER


def test_bones_out_of_reach_of_the_motion_are_left_out():
    made, _ = hinged_scene([0, 90])
    made.bones += [
        bone("post", box((2, 2, 2), (0, -30, 0))),
        bone("far", box((2, 2, 2), (500, 0, 0))),
    ]
    assert ("strap", "post") in find_contact_pairs(made)
    assert ("strap", "far") not in find_contact_pairs(made)
    assert len(sampled_poses(made)) > 9
    made.motion.frames[:] = [{}]
    assert ("strap", "post") not in find_contact_pairs(made)


class _Breaking(ToyMuscle):
    """Gives infinite vertices, or raises what it is given, in frame 3."""

    breaks = None

    def take(self, moving):
        if self.solves > 12:
            self.x = self.x * np.nan
            if self.breaks is not None:
                raise self.breaks


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    ("breaks", "error", "message"),
    [
        (None, SolveError, r"'strap', frame 3 \(hinge.bend = .*deg\).*not finite.*remesh it"),
        (np.linalg.LinAlgError("singular matrix"), SolveError, r"frame 3 .*singular matrix"),
        (KeyboardInterrupt(), KeyboardInterrupt, None),
    ],
)
def test_failing_solve_keeps_the_frames(monkeypatch, count, breaks, error, message):
    monkeypatch.setattr(_Breaking, "breaks", breaks)
    made, fields = hinged_scene([0, 10, 20, 30, 40])
    parts = [_Breaking(made.muscles[0], made) for _ in range(count)]
    frames = []
    with pytest.raises(error, match=message):
        for frame in simulate_frames(made, parts, bone_sdfs=fields):
            frames.append(frame)
    assert [frame.index for frame in frames] == [0, 1, 2]


def test_leaving_early_begins_no_frame_and_an_overlap_is_refused():
    made, fields = hinged_scene([0, 10, 20], initial="error")
    parts = [ToyMuscle(made.muscles[0], made) for _ in range(2)]
    course = simulate_frames(made, parts, bone_sdfs=fields)
    next(course)
    course.close()
    assert parts[0].solves == 0
    made.muscles[0].mesh.apply_translation([0, -4.0, 0])
    with pytest.raises(SceneError, match="overlaps bone 'trunk' at rest"):
        FrameLoop(made, [ToyMuscle(made.muscles[0], made) for _ in range(3)], bone_sdfs=fields)


def test_frames_that_are_skipped_leave_the_muscle_where_shown_ones_would():
    made, fields = hinged_scene([0, 10, 20, 30], tunnelling=TunnellingOptions())
    shown, skipping = (ToyMuscle(made.muscles[0], made) for _ in range(2))
    loop = FrameLoop(made, [shown], bone_sdfs=fields)
    frames = [loop.advance(coordinates) for coordinates in made.motion.frames]
    loop = FrameLoop(made, [skipping], bone_sdfs=fields)
    for coordinates in made.motion.frames[:-1]:
        loop.skip(coordinates)
    last = loop.advance(made.motion.frames[-1])
    assert last.index == 3 and np.array_equal(last.surfaces["strap"].vertices, shown.x)
    assert skipping.solves == shown.solves
    # What happened on the way comes with the frame that is shown.
    assert last.events == [event for frame in frames for event in frame.events]
    assert last.times["strap"]["time_solve"] > 0.0
    back = loop.advance({"hinge.bend": 0.0})
    # The toy's target does not depend on the path; only contact does.
    assert np.allclose(
        back.surfaces["strap"].vertices, frames[0].surfaces["strap"].vertices, atol=0.05
    )
    assert loop.here == {"hinge.bend": 0.0}


def test_a_note_about_a_bone_names_it(caplog):
    scene = arm_scene()
    mesh = scene.bone("fore").mesh
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    build_fields(scene, find_contact_pairs(scene))
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["fore"]
