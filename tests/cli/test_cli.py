"""The command line as a user meets it: exit codes, one-line errors, clean JSON, nothing lost."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from command_line import call

from rbfmuscle.cli.app import GROUPS
from rbfmuscle.scene.phantom import phantom_scene


@pytest.fixture(scope="module")
def phantom_folder(tmp_path_factory):
    """The phantom as files and a scene file with one small, quick muscle."""
    folder = tmp_path_factory.mktemp("phantom")
    scene = phantom_scene()
    for item in [*scene.bones, *scene.muscles]:
        item.mesh.export(folder / f"{item.name}.ply")
    muscle = scene.muscle("adductor_posterior")
    for attachment in muscle.attachments:
        np.savetxt(folder / f"{attachment.bone}.txt", attachment.vertices, fmt="%d")
    (folder / "hip.toml").write_text(SCENE)
    return folder


SCENE = """[scene]
format = 1
units = "mm"
[[bone]]
name = "pelvis"
mesh = "pelvis.ply"
[[bone]]
name = "femur"
mesh = "femur.ply"
[[joint]]
name = "hip"
parent = "pelvis"
child = "femur"
centre = [0, 0, 0]
axes = { flexion = [-1, 0, 0] }
[motion]
ramp = { "hip.flexion" = { from = 0, to = 8, step = 2 } }
[[muscle]]
name = "adductor"
mesh = "adductor_posterior.ply"
attach = [{ bone = "pelvis", vertices = "pelvis.txt" }, { bone = "femur", vertices = "femur.txt" }]
[output]
report = false
"""


def one_line(err):
    # A slow machine tells what it is busy with: "hip: building (1 s)".
    busy = re.compile(r".*: ([a-z ]+ \(\d+ s\)|compiling loops .*)")
    lines = [line for line in err.strip().splitlines() if not busy.fullmatch(line)]
    assert len(lines) == 1 and lines[0].startswith("rbfmuscle: ") and "Traceback" not in err
    return lines[0]


class TestRun:
    def test_run_leaves_what_is_promised(self, phantom_folder, tmp_path, capsys):
        code, out, err = call(capsys, "run", phantom_folder / "hip.toml", "-o", tmp_path / "out")
        assert code == 0 and "frame 5 of 5" in err
        names = {path.name for path in (tmp_path / "out").iterdir()}
        assert {"run.json", "metrics.csv", "events.csv", "poses.csv", "surfaces.pvd", "bones.pvd"} <= names
        assert len(list((tmp_path / "out" / "surfaces").iterdir())) == 5
        verdict, end = out.splitlines()
        said = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["verdict"]
        assert verdict == f"verdict: {said}" and re.match(r"5 frames in [\d.]+ s, in ", end)

    def test_spike_in_a_mesh_is_in_the_verdict(self, phantom_folder, tmp_path, capsys):
        """A vertex 60 mm off the muscle, which no field follows; without it all is well."""
        command = ("run", phantom_folder / "hip.toml", "-o", tmp_path / "out", "--frames", "0:1")
        assert "verdict: every muscle is within all limits in every frame" in call(capsys, *command)[1]
        mesh = trimesh.load(phantom_folder / "adductor_posterior.ply", process=False)
        vertices = np.array(mesh.vertices)
        middle = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).argmin()
        vertices[middle] += 60.0 * mesh.vertex_normals[middle]
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(phantom_folder / "spike.ply")
        (phantom_folder / "spike.toml").write_text(SCENE.replace("adductor_posterior.ply", "spike.ply"))
        code, out, _ = call(capsys, "run", phantom_folder / "spike.toml", *command[2:])
        assert code == 0 and re.search(r"verdict: adductor is not within all limits. Worst: adductor, ", out)

    def test_json_is_all_there_is_on_stdout(self, phantom_folder, tmp_path, capsys):
        code, out, _ = call(
            capsys, "run", phantom_folder / "hip.toml", "-o", tmp_path / "o", "--frames", "0:2", "--json",
            "--set", "model.centres=80", "--set", "contact.initial=keep",
        )  # fmt: skip
        info = json.loads(out)
        assert code == 0 and len(info["frames"]) == 2
        assert info["scene"]["muscles"][0]["model"] == {"name": "rbf", "centres": 80}
        assert info["scene"]["contact"]["initial"] == "keep"

    def test_limit_exceeded(self, phantom_folder, tmp_path, capsys):
        arguments = ("run", phantom_folder / "hip.toml", "-o", tmp_path / "o", "--frames", "0:1", "--fail-on")
        code, _, err = call(capsys, *arguments, "rest_error_rms=1e-9")
        assert code == 6 and "rest_error_rms" in err
        assert (tmp_path / "o" / "run.json").exists()
        assert call(capsys, *arguments, "volume_error")[0] == 0

    def test_export_of_a_run(self, phantom_folder, tmp_path, capsys):
        call(capsys, "run", phantom_folder / "hip.toml", "-o", tmp_path / "o", "--frames", "0:1")
        code, out, _ = call(capsys, "export", tmp_path / "o", "--format", "stl", "obj", "--units", "m")
        folders = [tmp_path / "o" / "export" / name for name in ("obj", "stl")]
        written = [path for folder in folders for path in folder.iterdir()]
        assert code == 0 and out == f"{len(written)} files in {folders[0]}, {folders[1]}\n"
        assert folders[1] / "adductor_0000.stl" in written
        assert call(capsys, "export", tmp_path / "o", "--format", "step")[0] == 2

    @pytest.mark.parametrize(
        ("words", "work"),
        [
            (("run",), "rbfmuscle.run.Recording"),
            (("compare",), "rbfmuscle.compare._measure"),
            (("kernels",), "rbfmuscle.experiments.kernel_study.study_kernels"),
            (("kernels", "--error", "1"), "rbfmuscle.experiments.wanted_error.reach_error"),
            (("paths",), "rbfmuscle.paths.sample_muscles"),
        ],
    )
    def test_output_that_cannot_be_written_is_told_before_any_work(
        self, tmp_path, capsys, monkeypatch, words, work
    ):
        monkeypatch.setattr(work, lambda *given, **named: pytest.fail("work was begun"))
        (tmp_path / "file").write_text("in the way")
        code, _, err = call(capsys, *words, "phantom", "-o", tmp_path / "file" / "out")
        assert code == 2 and "cannot write to" in one_line(err)


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("rum",), 2, "run"),
            (("run", "hip.toml"), 2, "--output"),
            (("run", "none.toml", "-o", "o"), 3, "none.toml: no such scene file"),
            (("check", "typo.toml"), 3, "did you mean 'centre'"),
            (("check", "mesh.toml"), 4, "femr.ply: no such mesh file, did you mean 'femur.ply'"),
            (("check", "hip.toml", "--bad"), 2, "--bad"),
            (("check", "model.toml"), 3, "model.toml: muscle 'adductor': unknown model 'rbff', did you mean 'rbf'"),
            (("run", "model.toml", "-o", "o"), 3, "unknown model 'rbff', did you mean 'rbf'"),
            (("check", "setting.toml"), 3, "model: unknown key 'centers', did you mean 'centres'"),
            (("check", "number.toml"), 3, "centres: input should be greater than or equal to 0, got -5"),
            (("check", "kernel.toml"), 3, "unknown kernel 'cubik', did you mean 'cubic'"),
            (("check", "mesh_model.toml"), 3, "unknown key 'iteration', did you mean 'iterations'"),
            (
                ("sweep", "hip.toml", "-o", "o", "--grid", "model.centers=60,70"),
                2,
                "rbfmuscle: muscle 'adductor': model: unknown key 'centers', did you mean 'centres'",
            ),
            (("run", "hip.toml", "-o", "o", "--model", "rbff"), 2, "did you mean 'rbf'"),
            (("run", "hip.toml", "-o", "o", "--frames", "a:b"), 2, "A:B:S"),
            (
                ("run", "hip.toml", "-o", "o", "--set", "contact.initail=keep"),
                2,
                "contact.initail: unknown key 'initail', did you mean 'initial'",
            ),
            (("run", "hip.toml", "-o", "o", "--set", "model=xpdb"), 2, "did you mean 'xpbd'"),
            (
                ("run", "hip.toml", "-o", "o", "--set", "model.centres=150.5"),
                2,
                "model: centres: input should be a valid integer, got 150.5",
            ),
            (("run", "hip.toml", "-o", "o", "--frames", "90:99"), 2, "none of the 5 frames"),
            (("compare", "hip.toml", "-o", "o", "--set", "model=xpdb"), 2, "did you mean 'xpbd'"),
            (
                ("compare", "hip.toml", "-o", "o", "--models", "rbf,pbd", "--set", "pbd:model.sweeps=3"),
                2,
                "unknown key 'sweeps'",
            ),
            (
                ("kernels", "phantom", "-o", "o", "--centres", "100,many"),
                2,
                "--centres must be whole numbers of 8 and more",
            ),
            (("check", "metres.toml"), 4, "cannot be right; correct the scene's units, or set its scale (0.001"),
            (("check", "bare.toml"), 3, "not valid TOML: Invalid value (at line 3, column 9); text stands in quotes"),
            (("run", "hip.toml", "-o", "o", "--set", "x"), 2, "KEY=VALUE"),
            (("run", "hip.toml", "-o", "o", "--fail-on", "volum_error"), 2, "did you mean 'volume_error'"),
            (("run", "inside.toml", "-o", "o"), 3, "start inside bone 'pelvis'"),
            (("export", "nowhere", "--format", "stl"), 2, "holds no run"),
            (("render", "nowhere", "-o", "a.png"), 2, "holds no run"),
            (("new", "nowhere", "--units", "mm"), 2, "is no folder"),
        ],
    )  # fmt: skip
    def test_code_and_one_line(self, phantom_folder, capsys, monkeypatch, arguments, code, words):
        monkeypatch.chdir(phantom_folder)
        self.write_variants(phantom_folder)
        given, out, err = call(capsys, *arguments)
        assert given == code
        assert words in one_line(err)
        assert out == "" and not (phantom_folder / "o").exists()

    @staticmethod
    def write_variants(folder):
        (folder / "typo.toml").write_text(SCENE.replace("centre", "center"))
        (folder / "mesh.toml").write_text(SCENE.replace("femur.ply", "femr.ply"))
        (folder / "metres.toml").write_text(SCENE.replace('units = "mm"', 'units = "m"'))
        (folder / "bare.toml").write_text(SCENE.replace('units = "mm"', "units = mm"))
        (folder / "model.toml").write_text(SCENE.replace("attach", 'model = "rbff"\nattach'))
        for name, model in (
            ("setting", '{ name = "rbf", centers = 80 }'),
            ("number", '{ name = "rbf", centres = -5 }'),
            ("kernel", '{ name = "rbf", kernel = "cubik" }'),
            ("mesh_model", '{ name = "pbd", iteration = 3 }'),
        ):
            (folder / f"{name}.toml").write_text(SCENE.replace("attach", f"model = {model}\nattach"))
        inside = SCENE.replace("adductor_posterior.ply", "small.ply").replace(
            "[output]", "[contact]\n[output]"
        )
        (folder / "inside.toml").write_text(
            inside.replace('"pelvis.txt"', "[0]").replace('"femur.txt"', "[1]")
        )
        import trimesh

        trimesh.creation.icosphere(subdivisions=2, radius=5).apply_translation([14, 12, 40]).export(
            folder / "small.ply"
        )

    def test_error_as_json(self, capsys, tmp_path):
        code, out, err = call(capsys, "check", tmp_path / "none.toml", "--json")
        assert code == 3
        assert json.loads(out) == {"error": one_line(err).removeprefix("rbfmuscle: "), "exit_code": 3}

    def test_no_command_shows_help_and_is_wrong_usage(self, capsys):
        code, out, _ = call(capsys)
        assert code == 2 and "check" in out

    def test_bug_is_one_line(self, phantom_folder):
        code = (
            "import rbfmuscle.scene.scene as s, sys\n"
            "def load(path, **options): raise ZeroDivisionError('planted')\n"
            "s.Scene.load = load\n"
            "from rbfmuscle.cli import main\nmain(['check', 'x.toml'])"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 1
        assert "a bug: ZeroDivisionError: planted" in one_line(done.stderr)


class TestOtherCommands:
    def test_check_tells_what_is_there(self, phantom_folder, capsys):
        code, out, err = call(capsys, "check", phantom_folder / "hip.toml")
        assert code == 0 and "muscle adductor: model rbf" in out
        assert err.splitlines()[-1] == "usable"  # a slow machine says before what it is at
        code, out, _ = call(capsys, "check", phantom_folder / "hip.toml", "--json")
        assert code == 0 and json.loads(out)["scene"]["units"] == "mm"

    def test_new_writes_a_scene_that_checks_out(self, tmp_path, capsys):
        for mesh in phantom_scene().bones + phantom_scene().muscles:
            mesh.mesh.export(tmp_path / f"{mesh.name}.stl")
        target = tmp_path / "guess.toml"
        code, out, _ = call(capsys, "new", tmp_path, "--units", "mm", "-o", target)
        assert code == 0 and str(target) in out
        text = target.read_text(encoding="utf-8")
        assert 'name = "hip"' in text and "GUESS" in text
        bones = [line.split('"')[1] for line in text.splitlines() if line.startswith("  { bone")]
        assert bones == ["pelvis", "femur"] * 4  # the origin, on the bone that stands still, comes first
        code, _, err = call(capsys, "new", tmp_path, "--units", "mm", "-o", target)
        assert code == 2 and "--force" in one_line(err)
        assert call(capsys, "check", target)[0] == 0

    def test_help_lists_the_commands_in_four_groups(self, capsys):
        code, out, _ = call(capsys, "--help")
        assert code == 0
        for title, commands in GROUPS.items():
            part = out[out.index(f"─ {title} ─") :]
            for command in commands:
                name = command.__name__.rstrip("_")
                assert f" {name} " in part[: part.index("╰")]
                assert "Usage" in call(capsys, name, "--help")[1]
