"""How a command ends when it may not go on: signals at any moment, full and closed outputs, a
kill."""

import gc
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
from blend_model import arm_files, arm_scene, use_blend_model
from command_line import call
from tendon_scene import arm

from rbfmuscle.display.export import export_run
from rbfmuscle.recording import Run, stream_run
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.substeps import SubSteps
from rbfmuscle.validation import SceneError, UsageError

PROGRAM = [sys.executable, "-m", "rbfmuscle"]


def write_scene(folder, *, end):
    """A quick scene whose motion goes on for ``end`` degrees by one degree a frame."""
    return arm_files(folder, end=end, step=1, defaults='model = "pbd"\n')


def ends_clean(process, code=130):
    """The process's errors, once it has ended with the code and one line of its own."""
    _, err = process.communicate()
    assert process.returncode == code, err
    lines = [
        line for line in err.splitlines() if "Traceback" in line or "bug" in line or "Error" in line
    ]
    assert not lines, err
    return err


class TestInterrupts:
    @pytest.mark.parametrize(
        ("number", "moment", "due", "lost"),
        [
            ("SIGINT", "builtins.__import__", "given[0] == 'cyclopts'", ""),
            ("SIGTERM", "pbd_baseline.muscle.attachment_frames", "True", ""),
            ("SIGINT", "rbfmuscle.run.writer.write_vtp", "len(calls) == 8", ""),
            # As ctypes does in a callback.
            ("SIGINT", "rbfmuscle.run.writer.write_vtp", "len(calls) == 8", "KeyboardInterrupt"),
        ],
    )
    def test_signal_ends_with_130_wherever_it_comes(self, tmp_path, number, moment, due, lost):
        """The process signals itself at a known place, so that no machine is too slow or too
        quick."""
        scene, out = write_scene(tmp_path, end=60), tmp_path / "out"
        module, _, name = moment.rpartition(".")
        code = f"""
import contextlib, os, signal, sys
import rbfmuscle.cli as cli, {module} as module
inner, calls = module.{name}, []
def struck(*given, **named):
    calls.append(1)
    if {due}:
        module.{name} = inner
        with contextlib.suppress({lost}):
            os.kill(os.getpid(), signal.{number})
    return inner(*given, **named)
module.{name} = struck
sys.argv = ["rbfmuscle", "run", {str(scene)!r}, "-o", {str(out)!r}]
cli.main()
"""
        err = ends_clean(
            subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
        )
        assert "interrupted" in err and ("frames are kept in" in err) == (name == "write_vtp")
        if name == "write_vtp":
            kept = Run.load(out)
            assert kept.info.status == "interrupted" and 2 <= len(kept.frames) < 60
            assert {row.frame for row in kept.metrics} == set(kept.frame_numbers) and export_run(
                out, ["stl"]
            )


def test_an_error_that_holds_libigls_objects_ends_without_its_complaints():
    code = (
        "import sys, igl, rbfmuscle.cli as cli, rbfmuscle.cli.app as app\n"
        "def failing(arguments):\n"
        "    tree = igl.FastWindingNumberBVH()\n"
        "    try:\n        raise ValueError\n"
        "    except ValueError as error:\n        failed = error\n"  # a cycle with this frame
        "    return 6\n"
        "app.run_command = failing\n"
        "sys.argv = ['rbfmuscle', 'run']\ncli.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (6, "")


class TestCallersInPython:
    def test_handlers_of_the_caller_stay(self, tmp_path, capsys):
        def handlers():
            signals = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
            return [*signals, sys.excepthook, warnings.showwarning, logging.lastResort]

        before = handlers()
        code, _, err = call(capsys, "check", tmp_path / "none.toml")
        assert code == 3 and "no such scene file" in err
        assert handlers() == before

    def test_any_thread_may_call(self, tmp_path, capsys):
        ends = []
        worker = threading.Thread(
            target=lambda: ends.append(call(capsys, "check", tmp_path / "none.toml")[0])
        )
        worker.start()
        worker.join()
        assert ends == [3]

    def test_an_interrupt_is_an_exit_code_and_leaves_the_caller_alive(self, tmp_path):
        code = (
            "import os, signal, time, rbfmuscle.cli as cli\n"
            "import rbfmuscle.scene.file as m\n"
            "def struck(*given):\n"
            "    os.kill(os.getpid(), signal.SIGINT)\n"
            "    while True:\n        time.sleep(0.01)\n"
            "m.read_scene_file = struck\n"
            "try:\n    cli.main(['check', 'a.toml'])\n"
            "except SystemExit as end:\n    print('alive', end.code)\n"
            "try:\n    struck()\n"
            "except KeyboardInterrupt:\n    print('mine')\n"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, "alive 130\nmine\n"), done.stderr


class TestOutputs:
    @pytest.mark.skipif(
        not os.path.exists("/dev/full"), reason="needs /dev/full to play a full disk"
    )
    def test_full_standard_output_is_one_line(self, tmp_path):
        scene = str(write_scene(tmp_path, end=2))
        code = f"""
import sys
from rbfmuscle.cli.app import run_command
for words in ([], ["--json"]):
    sys.stdout = open("/dev/full", "w")
    print("code", run_command(["check", {scene!r}, *words]), file=sys.stderr)
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        # "usable" is the finding; lines that end in seconds tell what goes on, on a slow machine.
        busy = re.compile(r".* s\)|rbfmuscle: compiling loops .*|usable; .*")
        own = [line for line in done.stderr.splitlines() if not busy.fullmatch(line)]
        assert own[1::2] == 2 * ["code 2"]
        for line in own[::2]:
            assert "cannot read or write standard output" in line
            assert ": No space left on device; " in line

    def test_closed_standard_output_is_one_line(self, tmp_path):
        scene = write_scene(tmp_path, end=2)
        words = ["sh", "-c", '"$@" >&-', "sh", *PROGRAM, "check", str(scene)]
        done = subprocess.run(words, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 2
        assert (
            done.stderr
            == "rbfmuscle: standard output is closed; send it to a file, or to /dev/null\n"
        )

    def test_reader_that_goes_away_is_no_error(self, tmp_path):
        scene = write_scene(tmp_path, end=2)
        reader, writer = os.pipe()
        os.close(reader)
        words = [*PROGRAM, "check", str(scene), "--json"]
        done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, text=True)
        os.close(writer)
        assert (
            done.returncode == 0 and "Traceback" not in done.stderr and "Error" not in done.stderr
        )


class TestKilledRuns:
    @pytest.fixture
    def killed(self, tmp_path, monkeypatch):
        """The folder of a run as it lies there after its sixth of nine frames."""
        use_blend_model(monkeypatch)
        made = arm_scene(end=80, step=10)

        def copy(done, total):
            if done == 6:
                shutil.copytree(tmp_path / "whole", tmp_path / "killed")

        stream_run(made, tmp_path / "whole", progress=copy)
        return tmp_path / "killed"

    def test_its_frames_are_found_exported_and_rendered(self, killed, capsys):
        saved, whole = Run.load(killed), Run.load(killed.parent / "whole")
        assert saved.info.status == "running"
        assert saved.frame_numbers == [0, 1, 2, 3, 4, 5] and len(whole.frames) == 9
        for mine, complete in zip(saved.info.frames, whole.info.frames):
            assert mine.coordinates == pytest.approx(complete.coordinates)
        np.testing.assert_array_equal(saved.mesh("biceps", 5)[0], whole.mesh("biceps", 5)[0])
        code, _, err = call(capsys, "export", killed, "--format", "stl,pvd")
        assert code == 0, err
        assert len(list((killed / "export" / "stl").glob("biceps_*.stl"))) == 6
        code, _, err = call(capsys, "render", killed, "-o", killed / "last.png", "--view", "front")
        assert code == 0, err
        assert (killed / "last.png").read_bytes().startswith(b"\x89PNG")

    def test_what_was_cut_short_is_left_out_and_no_frame_at_all_is_said(self, killed):
        poses = (killed / "poses.csv").read_text(encoding="utf-8")
        (killed / "poses.csv").write_text(
            poses[: poses.rindex("\n", 0, -1) + 30]
        )  # within the last line
        assert Run.load(killed).frame_numbers == [0, 1, 2, 3, 4]
        (killed / "poses.csv").write_text(poses)
        (killed / "surfaces" / "biceps_0003.vtp").unlink()
        assert 3 not in Run.load(killed).frame_numbers
        (killed / "poses.csv").write_text(poses.splitlines()[0] + "\n")
        with pytest.raises(UsageError, match="no surfaces"):
            export_run(killed, ["stl"])


def jumping_arm(folder):
    """The scene file of an arm whose table takes the limb 3 m away at 10.5 degrees, as one does
    whose unit is wrong.
    """
    made = arm("pbd")
    angles = [*range(11), 11, 20]  # a spline through few points would swing before the jump
    spline = {"x": angles, "y": [3000.0 * (angle > 10) for angle in angles]}
    made.joints.clear()
    made.add_joint(
        "elbow",
        "trunk",
        "limb",
        type="custom",
        centre=[0, 0, 0],
        rotations=[{"axis": [-1, 0, 0], "coordinates": ["bend"], "linear": [1, 0]}],
        translations=[{"axis": [0, 0, -1], "coordinates": ["bend"], "spline": spline}],
    )
    made.set_motion(ramp={"elbow.bend": {"to": 16, "step": 4}})
    return made.save(folder / "arm.toml")


def test_a_process_ends_without_a_search_for_garbage_and_a_caller_goes_on_with_it(capsys):
    """All that is loaded is left out of the last search."""
    code = (
        "import atexit, gc; "
        "atexit.register(lambda: print(gc.get_freeze_count() > len(gc.get_objects()))); "
        "from rbfmuscle.cli import main; main()"
    )
    ran = subprocess.run([sys.executable, "-c", code, "--version"], capture_output=True, text=True)
    assert ran.returncode == 0
    assert ran.stdout.split()[1:] == ["True"]
    frozen = gc.get_freeze_count()
    assert call(capsys, "--version")[0] == 0
    assert gc.get_freeze_count() == frozen


def test_a_jump_of_the_bones_is_named_at_once_and_the_frames_before_it_are_kept(tmp_path, capsys):
    jumping_arm(tmp_path)
    scene, out = tmp_path / "arm.toml", tmp_path / "out"
    asked = []
    made = Scene.load(scene)

    def poses(coordinates):
        asked.append(coordinates)
        return bone_poses(made, dict(coordinates))

    with pytest.raises(SceneError, match=r"trunk moves by .* against limb"):
        cut = SubSteps(made, made.muscles[0], bones=["limb"], poses=poses)
        cut.split(*made.motion.frames[2:4])
    assert len(asked) < 200  # a fraction of a second
    code, printed, err = call(capsys, "run", scene, "-o", out)
    assert code == 5
    for words in ("'strap', frame 3 (elbow.bend = 12 deg)", "more than 2000 sub-steps", "limb"):
        assert words in err
    assert f"3 frames are kept in {out}" in err
    assert printed.startswith("verdict: the run stopped after 3 of 5 frames; in these")
    kept = Run.load(out)
    assert kept.info.status == "failed" and kept.frame_numbers == [0, 1, 2]
    said = printed.splitlines()[0]
    assert call(capsys, "report", out, "--no-pictures")[1].startswith(said)
    assert (out / "report.html").exists()
    code, printed, _ = call(capsys, "run", scene, "-o", tmp_path / "again", "--json")
    facts = json.loads(printed)
    assert code == facts["exit_code"] == 5 and "sub-steps" in facts["error"]
    assert len(facts["frames"]) == 3 and "the run stopped" in facts["verdict"]
