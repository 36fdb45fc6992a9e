"""The command line as a user meets it: exit codes, one-line errors, clean JSON, nothing lost."""

import json
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from blend_model import arm_files
from command_line import call

import rbfmuscle as rm
from rbfmuscle.cli.app import GROUPS
from rbfmuscle.cli.check import _measure_time
from rbfmuscle.cli.options import Work
from rbfmuscle.geometry.threads import thread_count
from rbfmuscle.scene.check import check_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene file of one small, quick muscle."""
    made = tmp_path_factory.mktemp("arm")
    arm_files(made, end=8, step=2)
    return made


def one_line(err):
    # A slow machine tells what it is busy with: "hip: building (1 s)".
    busy = re.compile(r".*: ([a-z ]+ \(\d+ s\)|compiling loops .*)")
    lines = [line for line in err.strip().splitlines() if not busy.fullmatch(line)]
    assert len(lines) == 1 and lines[0].startswith("rbfmuscle: ") and "Traceback" not in err
    return lines[0]


class TestRun:
    def test_a_muscle_is_shown_as_scanned_spikes_and_all(self, folder, tmp_path, capsys):
        command = ("run", folder / "arm.toml", "-o", tmp_path / "out", "--frames", "0:1")
        code, out, err = call(capsys, *command)
        said = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["verdict"]
        assert code == 0 and "frame 1 of 1" in err and said.startswith("every muscle is within all")
        assert out.startswith("verdict: every muscle is within all limits in every frame\n")
        mesh = trimesh.load(folder / "biceps.ply", process=False)
        vertices = np.array(mesh.vertices)
        middle = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).argmin()
        vertices[middle] += 40.0 * mesh.vertex_normals[middle]
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(folder / "spike.ply")
        scene = (folder / "arm.toml").read_text(encoding="utf-8")
        (folder / "spike.toml").write_text(scene.replace("biceps.ply", "spike.ply"))
        code, _, _ = call(capsys, "run", folder / "spike.toml", *command[2:])
        run = rm.Run.load(tmp_path / "out")
        size = float(np.ptp(vertices, axis=0).max())
        assert code == 0 and run["biceps"].values("rest_error_max")[0] < 1e-3 * size
        tip = run["biceps"].surface(0).vertices
        assert np.linalg.norm(tip - vertices[middle], axis=1).min() < 1e-3 * size

    def test_limit_that_fails_ends_with_verdict_folder_and_the_whole_json(
        self, folder, tmp_path, capsys
    ):
        out, limits = tmp_path / "out", ("--fail-on", "length=3")
        words = ("run", folder / "arm.toml", "-o", out, "--frames", "0:1", "--model", "pbd")
        code, said, err = call(capsys, *words, *limits)
        written = json.loads((out / "run.json").read_text(encoding="utf-8"))
        assert code == 6 and said.startswith("verdict: biceps is not within")
        assert "1 frames in" in said and f"in {out}" in said and "biceps: length = " in err
        assert written["fail_on"] == {"length": 3.0} and written["limits"]["length"] == 3.0
        assert "length" in written["verdict"]
        code, said, _ = call(capsys, *words, *limits, "--json")
        found = json.loads(said)
        assert code == 6 == found["exit_code"] and "biceps: length = " in found["error"]
        assert set(written) - set(found) == set() and found["directory"] == str(out)

    def test_json_is_all_there_is_on_stdout(self, folder, tmp_path, capsys):
        code, out, _ = call(
            capsys,
            "run",
            folder / "arm.toml",
            "-o",
            tmp_path / "o",
            "--frames",
            "0:2",
            "--json",
            "--set",
            "model.centres=80",
            "--set",
            "model.kernel=wendland_c2",
            "--set",
            "contact.initial=keep",
        )
        info = json.loads(out)
        assert code == 0 and len(info["frames"]) == 2
        model = {"name": "rbf", "centres": 80, "kernel": "wendland_c2"}
        assert info["scene"]["muscles"][0]["model"] == model
        assert info["kernels"] == {"biceps": "wendland_c2"} and info["epsilons"]["biceps"] > 0.0
        assert info["scene"]["contact"]["initial"] == "keep"

    def test_one_muscle_alone(self, folder, tmp_path, capsys):
        command = ("run", "phantom", "-o", tmp_path / "o", "--model", "pbd", "--frames", "0:1")
        code, _, _ = call(capsys, *command, "--muscles", "extensor", "--set", "neighbours=false")
        info = json.loads((tmp_path / "o" / "run.json").read_text(encoding="utf-8"))
        assert code == 0 and list(info["muscles"]) == ["extensor"]
        assert info["kernels"] == info["epsilons"] == {}
        code, _, err = call(capsys, *command, "--muscles", "extensor,abducto")
        assert code == 2 and "did you mean 'abductor'?" in one_line(err)

    def test_export_of_a_run(self, folder, tmp_path, capsys):
        call(capsys, "run", folder / "arm.toml", "-o", tmp_path / "o", "--frames", "0:1")
        code, out, _ = call(capsys, "export", tmp_path / "o", "--format", "stl,obj", "--units", "m")
        folders = [tmp_path / "o" / "export" / name for name in ("obj", "stl")]
        written = [path for folder in folders for path in folder.iterdir()]
        assert code == 0 and out == f"{len(written)} files in {folders[0]}, {folders[1]}\n"
        assert folders[1] / "biceps_0000.stl" in written
        both = call(capsys, "export", tmp_path / "o", "--format", "glb,animated-glb")[1]
        assert (
            both.startswith("2 files in ")
            and call(capsys, "export", tmp_path / "o", "--format", "step")[0] == 2
        )

    @pytest.mark.parametrize(
        ("words", "work"),
        [
            (("run",), "rbfmuscle.recording.Recording"),
            (("compare",), "rbfmuscle.studies.compare._measure"),
            (("kernels", "--centres", "8"), "rbfmuscle.studies.kernels.study_kernels"),
            (("kernels", "--error", "1"), "rbfmuscle.studies.kernels.reach_error"),
            (("paths", "--samples", "10"), "rbfmuscle.studies.paths.sample_muscles"),
        ],
    )
    def test_unwritable_output_is_told_before_any_work(
        self, tmp_path, capsys, monkeypatch, words, work
    ):
        monkeypatch.setattr(work, lambda *given, **named: pytest.fail("work was begun"))
        (tmp_path / "file").write_text("in the way")
        code, _, err = call(
            capsys, words[0], "phantom", *words[1:], "-o", tmp_path / "file" / "out"
        )
        assert code == 2 and "cannot write to" in one_line(err)


def variants(folder):
    """Scene files with a mistake each; a ball lies within the upper arm."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0).apply_translation([-20, 0, 0])
    ball.export(folder / "ball.ply")
    scene = (folder / "arm.toml").read_text(encoding="utf-8")
    for name, old, new in (
        ("mesh", "fore.ply", "for.ply"),
        ("metres", 'units = "mm"', 'units = "m"'),
        ("inside", "biceps.ply", "ball.ply"),
    ):
        (folder / f"{name}.toml").write_text(scene.replace(old, new))


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            ("rum", 2, "run"),
            ("plan arm.toml", 2, "there is no command 'plan'; use 'rbfmuscle check SCENE --time'"),
            ("run arm.toml -o o --muscle biceps", 2, "Did you mean --muscles?"),
            ("run arm.toml -o o --muscles ,", 2, "--muscles names no muscle"),
            ("run arm.toml -o o --jobs 0", 2, "jobs must be 1 or more"),
            ("check arm.toml --jobs 0", 2, "jobs must be 1 or more"),
            ("export a --format stl obj", 2, "unexpected 'obj'; lists are written with commas"),
            ("kernels biceps.ply -o o --muscles a", 2, "biceps.ply is a mesh"),
            ("new meshes -o o/scene.toml", 2, "give a folder"),
            ("kernels arm.toml -o o --units mm", 2, "units names the unit of a mesh"),
            ("kernels biceps.ply -o o --error 1 --centres 9", 2, "--error does not take --centres"),
            ("kernels a.ply -o o --error 1 --resolution 64", 2, "does not take --resolution"),
            ("sweep arm.toml phantom -o o --quantity error_max", 2, "without --grid does not take"),
            ("sweep phantom arm.toml -o o --reference a=1", 2, "does not take --reference"),
            (
                "sweep arm.toml -o o --grid model.centres=60,70 --cluster tcp://a:1 --jobs 2",
                2,
                "--cluster does not take --jobs",
            ),
            ("view arm.toml --screenshot a.png --colour stretch", 2, "does not take --colour"),
            ("view arm.toml --screenshot a.png --port 8080", 2, "does not take --port"),
            ("view . --model pbd", 2, "the folder of a run, does not take --model"),
            ("report nowhere", 2, "holds no run"),
            ("run arm.toml", 2, "--output"),
            ("run none.toml -o o", 3, "none.toml: no such scene file"),
            ("check mesh.toml", 4, "for.ply: no such mesh file, did you mean 'fore.ply'"),
            ("check arm.toml --bad", 2, "--bad"),
            ("paths phantom -o o --samples 9", 2, "--samples 9 is too few"),
            (
                "check metres.toml",
                4,
                "cannot be right; correct the scene's units, or set its scale (0.01",
            ),
            ("sweep arm.toml -o o --grid model.centers=60,70", 2, "did you mean 'centres'"),
            ("run arm.toml -o o --frames 90:99", 2, "none of the 5 frames"),
            ("run arm.toml -o o --fail-on volum_error", 2, "did you mean 'volume_error'"),
            ("run inside.toml -o o", 3, "start inside bone 'upper'"),
            ("compare arm.toml -o o --set model=xpdb", 2, "did you mean 'xpbd'"),
            (
                "compare arm.toml -o o --models rbf,pbd --set pbd:model.sweeps=3",
                2,
                "unknown key 'sweeps'",
            ),
            (
                "kernels phantom -o o --centres 100,7",
                2,
                "--centres must be whole numbers of 8 and more",
            ),
            ("export nowhere --format stl", 2, "holds no run"),
            ("new nowhere --units mm", 2, "is no folder"),
        ],
    )
    def test_code_and_one_line(self, folder, capsys, monkeypatch, arguments, code, words):
        monkeypatch.chdir(folder)
        variants(folder)
        given, out, err = call(capsys, *arguments.split())
        assert given == code
        assert words in one_line(err)
        assert out == "" and not (folder / "o").exists()

    def test_bug_is_one_line(self):
        code = (
            "import rbfmuscle.scene.scene as s, sys\n"
            "def load(path, **options): raise ZeroDivisionError('planted')\n"
            "s.Scene.load = load\n"
            "sys.argv = ['rbfmuscle', 'check', 'x.toml']\n"
            "from rbfmuscle.cli import main\nmain()"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 1
        assert "a bug: ZeroDivisionError: planted" in one_line(done.stderr)


class TestOtherCommands:
    def test_check_tells_what_is_there(self, folder, capsys):
        code, out, err = call(capsys, "check", folder / "arm.toml")
        volume = rm.Scene.load(folder / "arm.toml").muscle("biceps").mesh.volume / 1e3
        assert code == 0 and "muscle biceps: model rbf" in out and f"{volume:.4g} cm3" in out
        assert "superior is (0, 0, 1), anterior (0, -1, 0)" in out and "field of" not in out
        assert not (folder / "arm.png").exists()
        text = (folder / "arm.toml").read_text(encoding="utf-8")
        (folder / "bones.toml").write_text(text[: text.index("[[muscle]]")])
        code, said, _ = call(capsys, "check", folder / "bones.toml")  # before there are muscles
        assert code == 3 and "joint elbow" in said and "add a [[muscle]]" in said
        assert err.splitlines()[-1].startswith("usable; next: rbfmuscle run ")
        found = json.loads(call(capsys, "check", folder / "arm.toml", "--json")[1])
        assert found["scene"]["units"] == "mm" and found["neighbours"] == []
        code, said, _ = call(capsys, "check", "phantom")
        lines = [line.strip() for line in said.splitlines() if "can touch" in line]
        assert code == 0 and any(re.search(r"can touch .*\babductor\b", line) for line in lines)
        muscle = rm.Scene.load(folder / "arm.toml").muscle("biceps")
        held = found["attachments"]
        assert [row["bone"] for row in held] == [a.bone for a in muscle.attachments]
        assert {row["end"] for row in held} == {"origin", "insertion"}
        faces = np.asarray(muscle.mesh.faces)
        for row, attachment in zip(held, muscle.attachments, strict=True):
            # A third of the triangles around each vertex is its own.
            corners = np.isin(faces, attachment.vertices).sum(axis=1)
            area = float((muscle.mesh.area_faces * corners).sum()) / 3.0
            assert row["area"] == pytest.approx(area / 100.0, rel=1e-9)
            assert row["share"] == pytest.approx(area / muscle.mesh.area, rel=1e-9)
            line = (
                f"{row['end']}: {row['vertices']} vertices on {row['bone']}, {row['area']:.3g} cm2"
            )
            assert line in out
        code, out, err = call(capsys, "check", folder / "none.toml", "--json")
        assert json.loads(out) == {
            "error": one_line(err).removeprefix("rbfmuscle: "),
            "exit_code": code,
        }

    def test_expected_time_goes_on_from_two_frames_after_the_first(self, monkeypatch, clock):
        frames = [SimpleNamespace(wall=wall) for wall in (9.0, 0.002, 0.006)]
        for count, frame in ((3, 0.004), (1, 1 / 64 / 11)):
            run, compiled = SimpleNamespace(frames=frames[:count]), []

            def solve(*_, run=run, compiled=compiled, **__):
                if not compiled:
                    compiled.append(time.perf_counter())  # takes a 64th of a second
                return run

            monkeypatch.setattr("rbfmuscle.recording.simulate", solve)
            build = 1 / 64 - frame * (count - 1)
            found = _measure_time(SimpleNamespace(motion=range(11), muscles=[]))
            times = {key: found[key] for key in ("build", "frame", "total")}
            assert times == pytest.approx(
                {"build": build, "frame": frame, "total": build + 10 * frame}
            )

    def test_check_lists_what_it_solved_to_tell_the_time(self, folder, capsys):
        code, out, _ = call(capsys, "check", folder / "arm.toml", "--time")
        assert code == 0 and "joint elbow" in out and "expected time: " in out
        assert re.search(r"muscle biceps: \d+ .* 3 frames take 2 sub-steps, within reach of ", out)
        time = json.loads(call(capsys, "check", folder / "arm.toml", "--time", "--json")[1])["time"]
        (muscle,) = time["muscles"]
        assert muscle["name"] == "biceps" and muscle["substeps"] == 2 and muscle["bones"]
        assert 0.0 < time["frame"] < time["total"]

    def test_comparison_fails_on_the_limits_of_its_models(self, folder, tmp_path, capsys):
        words = ("compare", folder / "arm.toml", "-o", tmp_path / "c", "--models", "pbd,xpbd")
        limits = ("--frames", "0:2", "--no-pictures", "--fail-on", "length=3")
        code, out, err = call(capsys, *words, *limits, "--json", "--quiet")
        found = json.loads(out)
        assert code == 6 == found["exit_code"] and found["models"] == ["pbd", "xpbd"]
        assert "pbd: biceps: length" in found["error"] and "xpbd: biceps: length" in one_line(err)
        (tmp_path / "c" / "report.html").unlink()
        assert call(capsys, "report", tmp_path / "c", "--no-pictures")[0] == 0
        assert (tmp_path / "c" / "report.html").exists()

    def test_jobs_are_threads(self):
        with Work(jobs=1).threads():
            assert thread_count() == 1

    def test_help_lists_the_commands_in_four_groups(self, capsys):
        assert call(capsys)[0] == 2
        code, out, _ = call(capsys, "--help")
        assert code == 0
        for title, commands in GROUPS.items():
            part = out[out.index(f"─ {title} ─") :]
            for command in commands:
                name = command.__name__.rstrip("_")
                assert f" {name} " in part[: part.index("╰")]
                assert "Usage" in call(capsys, name, "--help")[1]


@pytest.mark.parametrize(("factor", "remedy"), [(1e-3, 1000.0), (100.0, 0.01), (1e3, 0.001)])
def test_remedy_of_a_wrong_unit_makes_the_size_it_says(factor, remedy):
    rod = trimesh.creation.box((300.0, 1.0, 1.0)).apply_scale(factor)
    scene = rm.Scene(units="mm").add_bone("rod", rod)
    (text,) = [found.message for found in check_scene(scene) if found.level == "error"]
    size = factor * np.linalg.norm([300.0, 1.0, 1.0])
    assert f"is {size:.4g} mm across" in text
    assert f"({remedy:g} times the present one would make it {size * remedy:.4g} mm)" in text
