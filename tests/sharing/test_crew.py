"""Muscles dealt out to processes: what comes together is what one process finds, whatever ends the
run.
"""

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
from rbfmuscle.child import unexpected_end
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.run import simulate, stream_run
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.sharing import crew
from rbfmuscle.sharing.crew import WorkerPool, helpers_for
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
    """The phantom's four muscles through four frames; fields for the first so many, meshes for the
    others.
    """
    scene = phantom_scene(spacing=6.0)
    scene.motion = Motion([{"hip.flexion": np.radians(angle)} for angle in (0.0, 6.0, 12.0, 9.0)])
    for muscle in scene.muscles[mixed:]:
        muscle.model = "pbd"
    for muscle in scene.muscles[:mixed]:
        muscle.options.update(centres=80, samples=300, resolution=16)
    return scene.with_options({"output.report": False, **settings})


def ended(pool):
    return all(process.poll() is not None for process in pool._processes)


def test_folder_is_that_of_one_process_to_the_last_byte(tmp_path, two_helpers, crews, monkeypatch):
    scene = small_scene(1)
    stream_run(scene, tmp_path / "several", pictures=False)
    assert len(crews) == 1 and ended(crews[0])
    monkeypatch.setattr(recording, "helpers_for", lambda *given: 0)
    stream_run(scene, tmp_path / "one", pictures=False)
    assert len(crews) == 1
    assert files_in(tmp_path / "several") == files_in(tmp_path / "one")
    for name in files_in(tmp_path / "one"):
        assert timeless(tmp_path / "several" / name) == timeless(tmp_path / "one" / name), name
    assert SavedRun(tmp_path / "several").muscles == [muscle.name for muscle in scene.muscles]


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

    with pytest.raises(SolveError, match=r"helper process was ended by signal 9"):
        stream_run(small_scene(), tmp_path, pictures=False, progress=kill)
    saved = SavedRun(tmp_path)
    assert saved.info["status"] == "failed" and saved.frames and ended(crews[0])
    assert {row.muscle for row in saved.metrics if row.frame == 0} >= set(saved.muscles)


def test_helper_ends_with_the_process_that_started_it():
    scene, words = small_scene(), [sys.executable, "-m", "rbfmuscle.sharing.helper"]
    helper = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
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
        ("SolveError('frame 3')", SolveError("frame 3")),
        ("ZeroDivisionError('a bug')", RuntimeError("ZeroDivisionError: a bug")),
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
    words = [sys.executable, "-c", code]
    # Its standard input stays open: it has to end by itself.
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdin.write(pickle.dumps((None, [])))
        process.stdin.flush()
        kind, what = pickle.load(process.stdout)
    assert kind == "failed" and process.returncode == 0
    assert type(what) is type(expected) and str(expected) in str(what)


@pytest.mark.parametrize(
    ("muscles", "frames", "together", "cores", "wanted"),
    [
        (4, 1000, None, 4, 1),
        (38, 5, None, 4, 1),
        (38, 37, object(), 4, 1),
        (38, 37, None, 1, 1),
        (38, 37, None, 8, 4),
        (10, 40, None, 4, 2),
        (38, 37, None, 2, 2),
    ],
)
def test_helpers_are_as_many_as_bring_more_than_they_cost(muscles, frames, together, cores, wanted):
    motion = SimpleNamespace(frames=range(frames))
    for sliding, contraction in ((together, None), (None, together)):
        part = [SimpleNamespace(contraction=contraction)]
        scene = SimpleNamespace(muscles=muscles * part, motion=motion, sliding=sliding)
        assert max(helpers_for(scene, cores), 1) == wanted


def test_a_message_that_is_cut_is_the_last_one():
    said = """
from rbfmuscle.child import Outbox
box = Outbox()
print("heard", flush=True)
try:
    box.put(("done", ["first", lambda: 0]))
except Exception:
    pass
box.put(("failed", "next"))
"""
    done = subprocess.run([sys.executable, "-c", said], capture_output=True, check=False)
    assert done.returncode == 1 and b"pickle" in done.stderr and b"next" not in done.stdout
    assert b"heard" in done.stderr and b"heard" not in done.stdout
    assert "(exit code 0)" in str(unexpected_end(SimpleNamespace(wait=lambda: 0)))


@pytest.mark.parametrize(("threads", "share"), [(8, 4), (1, 1)])
def test_helpers_divide_the_threads(monkeypatch, threads, share):
    asked, child = [], SimpleNamespace(stdin=io.BytesIO())
    monkeypatch.setattr("numba.get_num_threads", lambda: threads)
    monkeypatch.setattr(crew, "start_child", lambda module, count: asked.append(count) or child)
    WorkerPool(small_scene(), 2)
    assert asked == [share, share]


def test_warnings_and_log_records_of_several_helpers_are_repeated_once(caplog):
    def helper(*messages):
        return SimpleNamespace(
            stdout=io.BytesIO(b"".join(pickle.dumps(message) for message in messages))
        )

    pool = WorkerPool.__new__(WorkerPool)
    pool.times, pool._repeated = {}, set()
    warning, line = (
        SceneWarning("bones meet"),
        ("rbfmuscle.bones", logging.WARNING, "bone: is open"),
    )
    one = helper(("warned", warning), ("logged", line), ("done", (1, {"simulate": 0.5})))
    other = helper(
        ("logged", line), ("warned", SceneWarning("bones meet")), ("done", (2, {"simulate": 0.25}))
    )
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        assert [pool._next(one), pool._next(other)] == [1, 2] and pool.times == {"simulate": 0.5}
    assert [str(w.message) for w in heard] == ["bones meet"]
    assert [record.getMessage() for record in caplog.records] == ["bone: is open"]
