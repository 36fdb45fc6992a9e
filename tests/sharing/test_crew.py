"""Muscles dealt out to processes: what comes together is what one process finds, whatever ends the run."""

import io
import logging
import os
import pickle
import signal
import subprocess
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from blend_model import files_in
from run_folders import timeless

from rbfmuscle import recording
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.run import simulate, stream_run
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.sharing.crew import WorkerPool, helpers_for
from rbfmuscle.sharing.share import MuscleGroup
from rbfmuscle.validation import MeshError, SceneWarning, SolveError


@pytest.fixture
def two_helpers(monkeypatch):
    monkeypatch.setattr(recording, "helpers_for", lambda *given: 2)


@pytest.fixture
def crews(monkeypatch):
    """The crews that a test starts."""
    made = []

    class Watched(WorkerPool):
        def __init__(self, *given, **options):
            super().__init__(*given, **options)
            made.append(self)

    monkeypatch.setattr(recording, "WorkerPool", Watched)
    return made


def small_scene(mixed=0, **settings):
    """The phantom's four muscles through four frames; fields for the first so many, meshes for the others."""
    scene = phantom_scene(spacing=6.0)
    scene.motion = Motion([{"hip.flexion": np.radians(angle)} for angle in (0.0, 6.0, 12.0, 9.0)])
    for muscle in scene.muscles[mixed:]:
        muscle.model = "pbd"
    for muscle in scene.muscles[:mixed]:
        muscle.options.update(centres=80, samples=300, resolution=16)
    return scene.with_options({"output.report": False, **settings})


def assert_same_folders(one, other):
    assert files_in(one) == files_in(other)
    for name in files_in(one):
        assert timeless(one / name) == timeless(other / name), name


def ended(crew):
    return all(process.poll() is not None for process in crew._processes)


def test_folder_is_that_of_one_process_to_the_last_byte(tmp_path, two_helpers, crews, monkeypatch):
    scene = small_scene(1)
    stream_run(scene, tmp_path / "several", pictures=False)
    assert len(crews) == 1 and ended(crews[0])
    monkeypatch.setattr(recording, "helpers_for", lambda *given: 0)
    stream_run(scene, tmp_path / "one", pictures=False)
    assert len(crews) == 1
    assert_same_folders(tmp_path / "several", tmp_path / "one")
    assert SavedRun(tmp_path / "several").muscles == [muscle.name for muscle in scene.muscles]


def test_frames_in_memory_have_all_muscles_in_the_scenes_order(two_helpers, crews):
    scene = small_scene()
    run = simulate(scene)
    names = [muscle.name for muscle in scene.muscles]
    assert len(crews) == 1 and len(run.frames) == 4
    for frame in run.frames:
        for found in (frame.surfaces, frame.carried, frame.times, frame.work):
            assert list(found) == names
    assert [r.muscle for r in run.metrics if r.frame == 1 and r.quantity == "length"] == names
    alone = MuscleGroup(scene, names[1:2])
    for frame, solved in zip(run.frames, alone.frames()):
        surface = solved.frame.surfaces[names[1]]
        np.testing.assert_array_equal(surface.vertices, frame.surfaces[names[1]].vertices)


def test_a_muscle_that_cannot_be_built_raises_the_error_of_one_process(two_helpers, crews):
    scene = small_scene()
    muscle = scene.muscles[0]
    muscle.mesh = trimesh.Trimesh(muscle.mesh.vertices, muscle.mesh.faces[1:], process=False)
    with pytest.raises(MeshError, match="not a closed"):
        simulate(scene)
    assert ended(crews[0])


def test_helper_that_is_killed_ends_the_run_with_the_frames_so_far(tmp_path, two_helpers, crews):
    def kill(done, total):
        if done == 1:
            os.kill(crews[0]._processes[1].pid, signal.SIGKILL)
            crews[0]._processes[1].wait()

    with pytest.raises(
        SolveError, match=r"helper process was ended by signal 9; memory.*NUMBA_NUM_THREADS=1"
    ):
        stream_run(small_scene(), tmp_path, pictures=False, progress=kill)
    saved = SavedRun(tmp_path)
    assert saved.info["status"] == "failed" and saved.frames and ended(crews[0])
    assert {row.muscle for row in saved.metrics if row.frame == 0} >= set(saved.muscles)


def test_helper_ends_with_the_process_that_started_it():
    """It waits for the word to begin, and nobody is left to say it: its standard input is closed."""
    scene = small_scene()
    helper = subprocess.Popen(
        [sys.executable, "-m", "rbfmuscle.sharing.helper"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    pickle.dump((scene, [scene.muscles[0].name]), helper.stdin)
    helper.stdin.close()
    try:
        assert helper.wait(timeout=120) == 0
    finally:
        helper.kill()
        helper.stdout.close()


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        ("MemoryError('asked for 7 GB')", MemoryError("asked for 7 GB")),
        ("OSError(28, 'No space left', 'cache')", OSError(28, "No space left", "cache")),
        ("SolveError('frame 3')", SolveError("frame 3")),
        ("ZeroDivisionError('a bug')", RuntimeError),
    ],
)
def test_errors_of_a_helper_are_reported_as_they_are(raised, expected):
    code = (
        "from rbfmuscle.sharing import helper\n"
        "from rbfmuscle.validation import SolveError\n"
        f"def share(*given, **options): raise {raised}\n"
        "helper.MuscleGroup = share\n"
        "helper.main()"
    )
    job = pickle.dumps((None, []))
    # Its standard input stays open: it has to end by itself.
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        process.stdin.write(job)
        process.stdin.flush()
        kind, what = pickle.load(process.stdout)
    assert kind == "failed"
    if isinstance(expected, Exception):
        assert type(what) is type(expected) and what.args == expected.args and str(what) == str(expected)
    else:
        assert type(what) is expected and "ZeroDivisionError: a bug" in str(what)


class TestHelpersFor:
    def scene(self, muscles, frames, sliding=None):
        return SimpleNamespace(
            muscles=range(muscles), motion=SimpleNamespace(frames=range(frames)), sliding=sliding
        )

    def test_one_process_where_another_costs_more_than_it_brings(self):
        assert helpers_for(self.scene(4, 1000), 4) < 2
        assert helpers_for(self.scene(38, 5), 4) < 2
        assert helpers_for(phantom_scene(), 4) < 2

    def test_no_more_than_cores_or_muscles_feed(self):
        assert helpers_for(self.scene(38, 37), 4) == 4
        assert helpers_for(self.scene(12, 100), 4) == 2
        assert helpers_for(self.scene(38, 37), 2) == 2
        assert helpers_for(self.scene(38, 37), 1) < 2

    def test_muscles_that_slide_stay_together(self):
        assert helpers_for(self.scene(38, 37, sliding=object()), 4) < 2


def test_a_message_that_is_cut_is_the_last_one():
    """What follows it would be read as its rest: the process ends, and its end tells."""
    said = """
from rbfmuscle.child import Outbox
box = Outbox()
try:
    box.put(("done", ["first", lambda: 0]))
except Exception:
    pass
box.put(("failed", "next"))
"""
    done = subprocess.run([sys.executable, "-c", said], capture_output=True, check=False)
    assert done.returncode == 1 and b"pickle" in done.stderr and b"next" not in done.stdout


def test_warnings_and_log_records_of_several_helpers_are_repeated_once(caplog):
    def helper(*messages):
        return SimpleNamespace(stdout=io.BytesIO(b"".join(pickle.dumps(message) for message in messages)))

    crew = WorkerPool.__new__(WorkerPool)
    crew.times, crew._repeated = {}, set()
    warning, line = SceneWarning("bones meet"), ("rbfmuscle.bones", logging.WARNING, "bone: is open")
    one = helper(("warned", warning), ("logged", line), ("done", (1, {"simulate": 2.0})))
    other = helper(("logged", line), ("warned", SceneWarning("bones meet")), ("done", (2, {"simulate": 1.0})))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        assert [crew._next(one), crew._next(other)] == [1, 2] and crew.times == {"simulate": 2.0}
    assert [str(w.message) for w in heard] == ["bones meet"]
    assert [record.getMessage() for record in caplog.records] == ["bone: is open"]
