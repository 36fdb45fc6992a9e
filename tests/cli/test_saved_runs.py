"""Commands that take a saved run: its page again, its verdict on a screen, its frames."""

import json
import shutil
import sys

import pytest
from command_line import call

from rbfmuscle.display.export import export_run
from rbfmuscle.recording import Run

SCREEN = 80, 24


@pytest.fixture
def folder(arm_run, tmp_path, monkeypatch):
    """A run named ``run`` in the present folder."""
    shutil.copytree(arm_run[1], tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "run"


def info(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def many(folder, names):
    """Let the folder be that of a run of as many muscles, all alike."""
    found = info(folder)
    (one,) = found["scene"]["muscles"]
    found["scene"]["muscles"] = [{**one, "name": name} for name in names]
    found["muscles"] = dict.fromkeys(names, found["muscles"]["biceps"])
    (folder / "run.json").write_text(json.dumps(found), encoding="utf-8")
    lines = (folder / "metrics.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    head, own = lines[0], [line for line in lines if ",biceps," in line]
    others = [line for line in lines[1:] if ",biceps," not in line]
    rows = [line.replace(",biceps,", f",{name},") for name in names for line in own]
    (folder / "metrics.csv").write_text("".join([head, *others, *rows]), encoding="utf-8")


class TestReport:
    def test_page_has_the_limits_that_are_asked_for_now(self, folder, capsys):
        code, out, err = call(capsys, "report", "run", "--fail-on", "length=0.001")
        assert code == 6 and "biceps: length" in err and "biceps, length" in out
        assert info(folder)["limits"]["length"] == 0.001 and info(folder)["beyond"]
        assert "0.001" in (folder / "report.html").read_text(encoding="utf-8")
        assert len(Run.load(folder)) == 7
        # Without limits those of the run hold.
        assert call(capsys, "report", "run", "--no-pictures")[0] == 6
        code, out, _ = call(capsys, "report", "run", "--no-pictures", "--fail-on", "components")
        assert code == 0 and "length" not in out and info(folder)["fail_on"] == {"components": None}

    def test_page_of_a_run_without_one_is_listed_and_no_other_is_replaced(self, folder, capsys):
        (folder / "report.html").write_bytes(b"mine")
        code, _, err = call(capsys, "report", "run", "--no-pictures")
        assert code == 2 and "report.html is in the way" in err
        assert (folder / "report.html").read_bytes() == b"mine"
        (folder / "report.html").unlink()
        assert call(capsys, "report", "run", "--no-pictures")[0] == 0
        listed = (folder / "files.txt").read_text(encoding="utf-8").splitlines()
        assert "report.html" in listed


def test_verdict_of_many_muscles_fits_one_screen(folder, capsys):
    names = [f"muscle_of_a_long_name_{k:02d}" for k in range(38)]
    many(folder, names)
    limits = (
        "length=0.001,solver_residual=0,flicker=0,bowing=0,rest_error_max=0,euler_characteristic=9"
    )
    _, out, _ = call(capsys, "report", "run", "--no-pictures", "--fail-on", limits)
    lines = out.splitlines()
    assert max(map(len, lines)) <= SCREEN[0] and len(lines) < SCREEN[1]
    assert lines[0].startswith("verdict: 0 of 38 muscles are within all limits; ")
    assert sum("(limit " in line for line in lines) == 3
    beyond = len(info(folder)["beyond"])
    assert beyond > 100 and f"  and {beyond - 3} more" in lines
    assert any(
        line.startswith("  look at that frame: rbfmuscle render run --frame ") for line in lines
    )
    assert lines[-1] == "open run/report.html"


def test_negative_frames_count_from_the_end(folder, capsys):
    for file, frame in (("last.png", -1), ("sixth.png", 6), ("fifth.png", -2)):
        words = ("-o", file, "--frame", frame, "--view", "front", "--quiet")
        code, out, err = call(capsys, "render", "run", *words)
        assert (code, out, err) == (0, f"{file}\n", "")
    last, sixth, fifth = (
        (folder.parent / name).read_bytes() for name in ("last.png", "sixth.png", "fifth.png")
    )
    assert last == sixth != fifth
    code, _, err = call(capsys, "render", "run", "-o", "a.png", "--frame", -8)
    assert code == 2 and "frame -8 was not written; the run has 0 to 6" in err


def test_format_without_its_package_stops_no_other(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    code, out, err = call(capsys, "export", "run", "--format", "usd,ply", "--json", "--quiet")
    found = json.loads(out)
    assert code == 7 == found["exit_code"] and "usd-core" in found["error"]
    assert err == f"rbfmuscle: {found['error']}\n"
    files = sorted(path.name for path in (folder / "export" / "ply").iterdir())
    assert len(files) == 15 == len(found["files"]) and not (folder / "export" / "usd").exists()


@pytest.mark.parametrize("name", ["obj", "stl"])
def test_fixed_bone_is_written_once(folder, name):
    names = sorted(path.name for path in export_run(folder, name, frames=slice(2, 5)))
    moved = [f"{part}_{frame:04d}.{name}" for part in ("biceps", "fore") for frame in (2, 3, 4)]
    assert names == [*moved, f"upper_0002.{name}"]
