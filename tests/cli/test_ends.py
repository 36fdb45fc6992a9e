"""How a command ends when it may not go on: signals at any moment, full and closed outputs, a kill."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from blend_model import arm_files, arm_scene, use_blend_model
from command_line import call

from rbfmuscle.output.export import export_run
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.run import stream_run
from rbfmuscle.validation import UsageError

PROGRAM = [sys.executable, "-m", "rbfmuscle"]


def write_scene(folder, *, end):
    """A quick scene whose motion goes on for ``end`` degrees by one degree a frame."""
    return arm_files(folder, end=end, step=1, defaults='model = "pbd"\n')


def ends_clean(process, code=130):
    """The process's errors, once it has ended with the code and one line of its own."""
    _, err = process.communicate()
    assert process.returncode == code, err
    lines = [line for line in err.splitlines() if "Traceback" in line or "bug" in line or "Error" in line]
    assert not lines, err
    return err


class TestInterrupts:
    @pytest.mark.parametrize("moment", ["import", "load", "build", "run"])
    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_signal_ends_with_130_wherever_it_comes(self, tmp_path, moment, number):
        """The process signals itself at a known place, so that no machine is too slow or too quick."""
        scene = write_scene(tmp_path, end=60)
        place = {
            "import": "import cyclopts",
            "load": "from rbfmuscle.scene.meshes import repair as m; name = 'repair'",
            "build": "import pbd_baseline.muscle as m; name = '_bone_numbers'",
            "run": "import rbfmuscle.output.writer as m; name = 'write_vtp'",
        }[moment]
        code = (
            "import os, sys, builtins\n"
            f"def strike(): os.kill(os.getpid(), {int(number)})\n"
            "import rbfmuscle.cli as cli, rbfmuscle.interruption as interruption\n"
        )
        if moment == "import":
            code += (
                "real = builtins.__import__\n"
                "def load(name, *rest):\n"
                "    if name == 'cyclopts': builtins.__import__ = real; strike()\n"
                "    return real(name, *rest)\n"
                "builtins.__import__ = load\n"
            )
        else:
            code += (
                f"{place}\ninner, count = getattr(m, name), [0]\n"
                "def struck(*a, **k):\n"
                "    count[0] += 1\n"
                f"    if count[0] == {8 if moment == 'run' else 1}: strike()\n"
                "    return inner(*a, **k)\n"
                "setattr(m, name, struck)\n"
            )
        out = tmp_path / "out"
        code += f"sys.argv = ['rbfmuscle', 'run', {str(scene)!r}, '-o', {str(out)!r}]\ncli.main()\n"
        process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
        err = ends_clean(process)
        assert "interrupted" in err
        if moment == "run":
            assert "frames are kept in" in err
            kept = SavedRun(out)
            assert kept.info["status"] == "interrupted" and 2 <= len(kept.frames) < 60
            assert export_run(out, ["stl"])

    def test_interrupt_that_is_lost_in_a_callback_is_heeded_at_the_next_frame(self, tmp_path):
        scene = write_scene(tmp_path, end=60)
        code = (
            "import os, signal, sys\nimport rbfmuscle.cli as cli, rbfmuscle.output.writer as m\n"
            "inner, count = m.write_vtp, [0]\n"
            "def struck(*a, **k):\n"
            "    count[0] += 1\n"
            "    if count[0] == 8:\n"
            "        try: os.kill(os.getpid(), signal.SIGINT)\n"
            "        except KeyboardInterrupt: pass  # as ctypes does in a callback\n"
            "    return inner(*a, **k)\n"
            "m.write_vtp = struck\n"
            f"sys.argv = ['rbfmuscle', 'run', {str(scene)!r}, '-o', {str(tmp_path / 'out')!r}]\ncli.main()\n"
        )
        process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
        assert "frames are kept" in ends_clean(process)
        assert len(SavedRun(tmp_path / "out").frames) < 60

    def test_json_is_told_of_an_interrupt(self, tmp_path):
        code = (
            "import os, signal, sys, rbfmuscle.cli as cli\n"
            "import rbfmuscle.scene.file as m\n"
            "m.read_scene_file = lambda path: os.kill(os.getpid(), signal.SIGINT)\n"
            "sys.argv = ['rbfmuscle', 'check', 'a.toml', '--json']\ncli.main()\n"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 130 and done.stderr == "rbfmuscle: interrupted\n"
        assert json.loads(done.stdout) == {"error": "interrupted", "exit_code": 130}


class TestOutputs:
    @pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full to play a full disk")
    @pytest.mark.parametrize("words", [["check"], ["plan"], ["check", "--json"]], ids=" ".join)
    def test_full_standard_output_is_one_line(self, tmp_path, words):
        scene = write_scene(tmp_path, end=2)
        with open("/dev/full", "w") as full:
            done = subprocess.run(
                [*PROGRAM, words[0], str(scene), *words[1:]], stdout=full, stderr=subprocess.PIPE, text=True
            )
        # "usable" is the finding; lines that end in seconds tell what goes on, on a slow machine.
        busy = re.compile(r".* s\)|rbfmuscle: compiling loops .*")
        own = [line for line in done.stderr.splitlines() if line != "usable" and not busy.fullmatch(line)]
        assert done.returncode == 2 and len(own) == 1
        assert "standard output" in own[0] and "No space left" in own[0]

    def test_closed_standard_output_is_one_line(self, tmp_path):
        scene = write_scene(tmp_path, end=2)
        done = subprocess.run(
            ["sh", "-c", '"$@" >&-', "sh", *PROGRAM, "check", str(scene)], stderr=subprocess.PIPE, text=True
        )
        assert done.returncode == 2
        assert done.stderr == "rbfmuscle: standard output is closed; send it to a file, or to /dev/null\n"

    def test_reader_that_goes_away_is_no_error(self, tmp_path):
        scene = write_scene(tmp_path, end=2)
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(
            [*PROGRAM, "check", str(scene), "--json"], stdout=writer, stderr=subprocess.PIPE, text=True
        )
        os.close(writer)
        assert done.returncode == 0 and "Traceback" not in done.stderr and "Error" not in done.stderr


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

    def test_its_frames_are_found_with_their_coordinates(self, killed):
        saved, whole = SavedRun(killed), SavedRun(killed.parent / "whole")
        assert saved.info["status"] == "running"
        assert saved.frames == [0, 1, 2, 3, 4, 5] and len(whole.frames) == 9
        for mine, complete in zip(saved.info["frames"], whole.info["frames"]):
            assert mine["coordinates"] == pytest.approx(complete["coordinates"])
        np.testing.assert_array_equal(saved.surface("biceps", 5)[0], whole.surface("biceps", 5)[0])

    def test_it_is_exported_and_rendered(self, killed, capsys):
        code, _, err = call(capsys, "export", killed, "--format", "stl", "pvd")
        assert code == 0, err
        assert len(list((killed / "export" / "stl").glob("biceps_*.stl"))) == 6
        code, _, err = call(capsys, "render", killed, "-o", killed / "last.png", "--view", "front")
        assert code == 0, err
        assert (killed / "last.png").read_bytes().startswith(b"\x89PNG")

    def test_it_is_scrubbed_in_the_viewer(self, killed):
        from rbfmuscle.viewer.sources import SavedFigure

        figure = SavedFigure(SavedRun(killed))
        figure.set("frame", 5)
        assert figure.advance().text.startswith("frame 5")

    def test_what_was_cut_short_is_left_out(self, killed):
        poses = (killed / "poses.csv").read_text(encoding="utf-8")
        (killed / "poses.csv").write_text(poses[: poses.rindex("\n", 0, -1) + 30])  # within the last line
        assert SavedRun(killed).frames == [0, 1, 2, 3, 4]
        (killed / "poses.csv").write_text(poses)
        (killed / "surfaces" / "biceps_0003.vtp").unlink()
        assert 3 not in SavedRun(killed).frames

    def test_one_without_a_frame_says_so(self, killed):
        (killed / "poses.csv").write_text(
            (killed / "poses.csv").read_text(encoding="utf-8").splitlines()[0] + "\n"
        )
        with pytest.raises(UsageError, match="no surfaces"):
            export_run(killed, ["stl"])
