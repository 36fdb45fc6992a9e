"""A run on its way to a sink: what it is told and when, its clock over a break, and how it ends."""

import copy
import warnings
from types import SimpleNamespace

import pytest
from blend_model import arm_scene, use_blend_model

from rbfmuscle import recording
from rbfmuscle.recording import Recording
from rbfmuscle.run import simulate, stream_run
from rbfmuscle.validation import SceneWarning, SolveError


class Kept:
    """A sink that keeps everything in memory."""

    def __init__(self):
        self.told, self.frames, self.rows, self.states, self.closed = [], [], [], [], None

    def write_info(self, info):
        self.told.append((info["status"], info["message"], len(info["frames"])))

    def write(self, frame, rows):
        self.frames.append(frame)
        self.rows += rows

    def keep(self, state):
        self.states.append(copy.deepcopy(state))  # as a file holds it: the run goes on with its own

    def close(self, rows):
        self.closed = rows


@pytest.fixture(autouse=True)
def blend(monkeypatch):
    use_blend_model(monkeypatch)


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when they are told to."""
    now = SimpleNamespace(value=100.0)
    monkeypatch.setattr(recording.time, "perf_counter", lambda: now.value)
    return now


def test_sink_hears_of_the_start_every_frame_and_the_end():
    scene, sink, seen = arm_scene(end=20), Kept(), []
    run = Recording(scene, resumable=True)
    run.feed(
        sink,
        progress=lambda done, total: seen.append((done, total)),
        watch=lambda models, frame: seen.append(frame),
    )
    count = len(scene.motion)
    assert sink.told == [("running", "interrupted", 0), ("complete", "", count)]
    assert (
        [frame.index for frame in sink.frames]
        == list(range(count))
        == [s["written"][-1]["frame"] for s in sink.states]
    )
    assert seen[0] is None and seen[1::2] == sink.frames
    assert seen[2::2] == [(k + 1, count) for k in range(count)]
    assert sink.closed is not None


def test_states_are_given_only_where_they_are_asked_for():
    sink = Kept()
    Recording(arm_scene(end=10)).feed(sink)
    assert sink.states == [] and len(sink.frames) >= 2


def test_a_failure_closes_the_sink_and_is_told_with_the_frames_so_far(monkeypatch):
    use_blend_model(monkeypatch, fail_at=2)
    sink = Kept()
    with pytest.raises(SolveError, match="planted failure"):
        Recording(arm_scene(end=40)).feed(sink)
    (_, _, none), (status, message, count) = sink.told
    assert (none, status) == (0, "failed") and "planted failure" in message
    assert count == len(sink.frames) >= 1 and sink.closed is not None


@pytest.mark.parametrize("at", ["write", "keep", "close"])
def test_a_disk_that_refuses_ends_the_run_as_failed_unless_all_was_written(at):
    class Full(Kept):
        def fail(self, *given):
            raise SolveError("disk full")

    setattr(Full, at, Full.fail)
    sink = Full()
    with pytest.raises(SolveError, match="disk full"):
        Recording(arm_scene(end=10), resumable=True).feed(sink)
    assert at == "close" or sink.told[-1][0] == "failed"


def test_clock_of_a_run_that_goes_on_counts_both_parts(clock):
    first = Recording(arm_scene(end=20), resumable=True)
    clock.value += 5.0
    with first.timed("build"):
        clock.value += 2.0
    sink = Kept()
    first.feed(sink)
    state = sink.states[0]
    assert state["times"]["wall"] == pytest.approx(7.0) and state["times"]["build"] == pytest.approx(2.0)
    assert first.info()["times"]["wall"] == pytest.approx(7.0)
    clock.value += 1000.0
    second = Recording(arm_scene(end=20), resumable=True)
    clock.value += 3.0
    second.go_on(state, [])
    with second.timed("build"):
        clock.value += 0.5
    times = second.info()["times"]
    assert times["wall"] == pytest.approx(10.5) and times["build"] == pytest.approx(2.5)


def test_run_that_goes_on_writes_the_frames_that_were_left():
    whole, rest = Kept(), Kept()
    Recording(arm_scene(end=20), resumable=True).feed(whole)
    run = Recording(arm_scene(end=20), resumable=True)
    run.go_on(whole.states[1], [])
    run.feed(rest)
    assert [frame.index for frame in rest.frames] == [frame.index for frame in whole.frames[2:]]
    assert rest.told[-1] == whole.told[-1]
    for one, other in zip(rest.frames, whole.frames[2:]):
        for name, surface in one.surfaces.items():
            assert (surface.vertices == other.surfaces[name].vertices).all()


def test_notes_of_the_motion_are_warned_of():
    scene = arm_scene(end=10)
    scene.motion.notes = ["elbow.flexion is cut to its range", "times are not even"]
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        Recording(scene)
    told = [str(w.message) for w in heard if issubclass(w.category, SceneWarning)]
    assert [f"motion: {note}" for note in scene.motion.notes] == [
        line for line in told if line.startswith("motion: ")
    ]


@pytest.mark.parametrize("way", [simulate, lambda scene, folder: stream_run(scene, folder, pictures=False)])
def test_what_is_noted_of_the_motion_points_at_who_asked_for_the_run(way, tmp_path):
    scene = arm_scene(end=5)
    scene.motion.notes.append("it leaves its range")
    with pytest.warns(SceneWarning, match="motion: it leaves its range") as told:
        way(scene, tmp_path) if way is not simulate else simulate(scene)
    assert [each.filename for each in told if "leaves" in str(each.message)] == [__file__]
