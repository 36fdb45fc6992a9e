"""A run on its way to a sink: what it gets and when, and how it ends."""

import warnings

import pytest
from blend_model import arm_scene, use_blend_model

from rbfmuscle.recording import Recording
from rbfmuscle.validation import SceneWarning, SolveError


class Kept:
    """A sink that keeps everything in memory."""

    def __init__(self):
        self.said, self.frames, self.rows, self.closed = [], [], [], None

    def write_info(self, info):
        self.said.append((info["status"], info["message"], len(info["frames"])))

    def write(self, frame, rows):
        self.frames.append(frame)
        self.rows += rows

    def close(self, rows):
        self.closed = rows


@pytest.fixture(autouse=True)
def blend(monkeypatch):
    use_blend_model(monkeypatch)


def test_sink_hears_of_the_start_every_frame_and_the_end():
    scene, sink, seen = arm_scene(end=20), Kept(), []
    run = Recording(scene)
    run.feed(
        sink,
        progress=lambda done, total: seen.append((done, total)),
        watch=lambda models, frame: seen.append(frame),
    )
    count = len(scene.motion)
    assert sink.said == [("running", "interrupted", 0), ("complete", "", count)]
    assert [frame.index for frame in sink.frames] == list(range(count))
    assert seen[0] is None and seen[1::2] == sink.frames
    assert seen[2::2] == [(k + 1, count) for k in range(count)]
    assert sink.closed is not None


def test_a_failure_closes_the_sink_and_is_said_with_the_frames_so_far(monkeypatch):
    use_blend_model(monkeypatch, fail_at=2)
    sink = Kept()
    with pytest.raises(SolveError, match="planted failure"):
        Recording(arm_scene(end=40)).feed(sink)
    (_, _, none), (status, message, count) = sink.said
    assert (none, status) == (0, "failed") and "planted failure" in message
    assert count == len(sink.frames) >= 1 and sink.closed is not None


@pytest.mark.parametrize("at", ["write", "close"])
def test_a_disk_that_refuses_ends_the_run_as_failed_unless_all_was_written(at):
    class Full(Kept):
        def fail(self, *given):
            raise SolveError("disk full")

    setattr(Full, at, Full.fail)
    sink = Full()
    with pytest.raises(SolveError, match="disk full"):
        Recording(arm_scene(end=10)).feed(sink)
    assert at == "close" or sink.said[-1][0] == "failed"


def test_notes_of_the_motion_are_warned_of():
    scene = arm_scene(end=10)
    scene.motion.notes = ["elbow.flexion is cut to its range", "times are not even"]
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        Recording(scene)
    said = [str(w.message) for w in heard if issubclass(w.category, SceneWarning)]
    assert [f"motion: {note}" for note in scene.motion.notes] == [
        line for line in said if line.startswith("motion: ")
    ]
