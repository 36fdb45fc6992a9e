"""Files of the user beside, below and in place of what commands write: none is touched."""

import os
import shutil

import pytest
from blend_model import arm_files, use_blend_model
from command_line import call
from conftest import ROOT

from rbfmuscle.folders import LIST, OutputFolder, read_list
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.validation import UsageError

MINE = b"not written by any command"
COMMANDS = {
    "run": "run arm.toml -o OUT",
    "compare": "compare arm.toml -o OUT --models pbd,xpbd",
    "kernels": "kernels biceps.ply -o OUT --kernels cubic --centres 20 --resolution 16",
    "wanted": "kernels biceps.ply -o OUT --kernels cubic --error 2",
    "sweep": "sweep arm.toml -o OUT --jobs 1 --grid contact.substep_angle=1,2",
    "paths": "paths arm.toml -o OUT --samples 10 --range elbow.flexion=0:8",
    "export": "export a_run -o OUT --format pvd,obj,animated-glb",
    "import": "import small.osim -o OUT",
    "import again": "import small.osim -o OUT --force",
    "new": "new meshes -o OUT",
    "new again": "new meshes -o OUT --force",
    "render": "render a_run -o OUT/picture.png --view front",
    "animation": "render a_run -o OUT/moving.gif --view front",
    "screenshot": "view a_run --screenshot OUT/shot.png",
    "check": "check OUT/arm.toml --picture",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with what the commands take, in which they run."""
    folder = tmp_path_factory.mktemp("work") / "with a space and é"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        use_blend_model(patch)
        text = arm_files(folder).read_text(encoding="utf-8")
        (folder / "arm.toml").write_text(text.replace("report = false", ""))
        for name in ("small.osim", "wedge.obj"):
            shutil.copy(ROOT / "tests" / "data" / name, folder)
        (folder / "meshes").mkdir()
        scene = phantom_scene(spacing=6.0)
        for item in scene.bones + scene.muscles[:2]:
            item.mesh.export(folder / "meshes" / f"{item.name}.ply")
        yield folder


def contents(folder):
    """Content of each file below a folder, and where each link leads."""
    paths = [path for path in folder.rglob("*") if path.is_symlink() or path.is_file()]
    return {p: os.readlink(p) if p.is_symlink() else p.read_bytes() for p in paths}


def go(capsys, name, out):
    out.mkdir(exist_ok=True)
    if name == "check":
        for file in out.parent.glob("*.*"):
            if file.suffix in (".toml", ".ply", ".txt") and not (out / file.name).exists():
                shutil.copy(file, out)
    if not (out.parent / "a_run").exists():
        assert call(capsys, "run", "arm.toml", "-o", "a_run")[0] == 0
    words = [word.replace("OUT", out.name) for word in COMMANDS[name].split()]
    return call(capsys, *words)


@pytest.fixture(params=COMMANDS)
def done(place, capsys, request):
    """A command that has been run, and the folder that it wrote to."""
    out = place / f"out_{request.param.replace(' ', '_')}"
    first = request.param.removesuffix(" again")
    if not out.exists():
        code, _, err = go(capsys, first, out)
        assert code == 0, err
    return request.param, out


def test_files_beside_and_below_what_a_command_wrote_stay(done, capsys):
    name, out = done
    folders = [out, *(path for path in out.rglob("*") if path.is_dir())]
    mine = [folder / file for folder in folders for file in ("femur_2023_0001.vtp", "notes.txt")]
    for file in mine:
        file.write_bytes(MINE)
    before = contents(out)
    code, _, err = go(capsys, name, out)
    after = contents(out)
    assert all(after.get(file) == MINE for file in mine), err
    assert code == 0 or (code == 2 and before == after and err.count("\n") <= 2), err
    for file in mine:
        file.unlink()


def test_a_file_in_the_place_of_one_that_a_command_writes_stays(done, capsys):
    name, out = done
    for file in [path.relative_to(out) for path in contents(out) if path.name != LIST]:
        user = out.parent / "user"
        (user / file).parent.mkdir(parents=True)
        (user / file).write_bytes(MINE)
        if name == "check" and file.suffix != ".png":
            shutil.rmtree(user)
            continue
        before = contents(user)
        code, _, err = go(capsys, name, user)
        after = contents(user)
        if name == "new again" and file.name == "scene.toml":  # what --force is for
            assert code == 0
        else:
            assert after.get(user / file) == MINE, (file, err)
            assert code == 2, (file, code, err)
            assert name == "check" or after == before, (file, err)
        shutil.rmtree(user)


class TestOutputFolder:
    def test_second_result_leaves_nothing_of_the_first_and_all_else(self, tmp_path):
        folder = OutputFolder(tmp_path / "out", "run", ["a", "deep"])
        folder.clear()
        folder.add("a", "deep/b")
        for name in ("a", "deep/b", "c"):
            (tmp_path / "out" / name).write_bytes(MINE)
        again = OutputFolder(tmp_path / "out", "run", ["a", "deep"])
        again.clear()
        assert {path.name for path in contents(tmp_path)} == {"c", LIST}
        with pytest.raises(UsageError, match="c is in the way"):
            again.add("c")

    @pytest.mark.parametrize(
        "line", ["../victim", "deep/../../victim", "/etc/victim", "link/victim", "C:victim", "a\\b"]
    )
    def test_a_list_leads_nowhere_else(self, tmp_path, line):
        out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
        OutputFolder(out, "run").clear()
        elsewhere.mkdir()
        (tmp_path / "victim").write_bytes(MINE)
        (elsewhere / "victim").write_bytes(MINE)
        (out / "link").symlink_to(elsewhere)
        with (out / LIST).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
        before = contents(tmp_path)
        OutputFolder(out, "run").clear()
        assert read_list(out, "run") == []
        assert {p: v for p, v in contents(tmp_path).items() if p.name != LIST} == {
            p: v for p, v in before.items() if p.name != LIST
        }

    def test_another_command_and_another_folder_are_refused(self, tmp_path):
        OutputFolder(tmp_path / "a", "run").clear()
        with pytest.raises(UsageError, match="no earlier result of 'rbfmuscle sweep'"):
            OutputFolder(tmp_path / "a", "sweep")
        (tmp_path / "b").mkdir()
        (tmp_path / "b" / ".DS_Store").write_bytes(MINE)
        OutputFolder(tmp_path / "b", "run").clear()
        assert (tmp_path / "b" / ".DS_Store").read_bytes() == MINE

    def test_an_error_leaves_the_earlier_result_whole(self, tmp_path):
        for content in ("first", "second", "third"):
            folder = OutputFolder(tmp_path / "out", "paths", ["a"])
            before = contents(tmp_path)
            try:
                with folder.staged() as stage:
                    (stage / "a").write_text(content)
                    if content == "second":
                        raise KeyError
            except KeyError:
                assert contents(tmp_path) == before
        assert (tmp_path / "out" / "a").read_text() == "third"
        with pytest.raises(KeyError), OutputFolder(tmp_path / "new", "paths").staged():
            raise KeyError
        assert not (tmp_path / "new").exists()


def test_failure_of_new_with_force_keeps_the_scene_that_was_there(place, tmp_path, capsys):
    folder = tmp_path / "meshes"
    shutil.copytree(place / "meshes", folder)
    assert call(capsys, "new", folder)[0] == 0
    for path in folder.glob("*.ply"):
        if path.stem in ("extensor", "abductor"):
            path.unlink()
    before = contents(folder)
    code, _, err = call(capsys, "new", folder, "--force")
    assert code == 2 and "holds no muscle" in err
    assert contents(folder) == before
