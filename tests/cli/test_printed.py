"""What commands print at their end: the figures of what they left, once each."""

import json
import re

import pytest
from blend_model import arm_files, use_blend_model
from command_line import call

from rbfmuscle.commands import cohort as cohort_command
from rbfmuscle.commands.run import SHOWN
from rbfmuscle.validation import SolveError

TWO = (("biceps", 0.0), ("long_head", 60.0))


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A run of two muscles and what it printed."""
    place = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        yield arm_files(place, muscles=TWO), place / "out"


@pytest.fixture(scope="module")
def printed(ran):
    import contextlib
    import io

    from rbfmuscle.cli import main

    path, out = ran
    told = io.StringIO()
    words = [
        "run",
        str(path),
        "-o",
        str(out),
        "--set",
        "output.report=false",
        "--set",
        "output.preview=false",
    ]
    with contextlib.redirect_stdout(told), pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 0
    return told.getvalue().splitlines()


def test_run_prints_the_worst_of_every_muscle(ran, printed):
    info = json.loads((ran[1] / "run.json").read_text())
    assert printed[0] == "worst over the frames; lengths in mm"
    assert printed[1].split() == list(SHOWN)
    rows = {line.split()[0]: line.split()[1:] for line in printed[2:-1]}
    assert list(rows) == [name for name, _ in TWO]
    for name, cells in rows.items():
        facts = info["muscles"][name]
        for key, cell in zip(SHOWN, cells, strict=True):
            worst = facts.get(key, {}).get("worst")
            assert cell == ("nan" if worst is None else f"{abs(worst):.3g}")
    assert re.match(rf"{len(info['frames'])} frames in [\d.]+ s, in ", printed[-1])


def test_export_counts_files_and_names_folders_once(ran, printed, tmp_path, capsys):
    code, out, _ = call(capsys, "export", ran[1], "--format", "ply", "--format", "stl", "-o", tmp_path)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    folders = sorted({str(path.parent) for path in written})
    assert code == 0 and out == f"{len(written)} files in {', '.join(folders)}\n"
    one = tmp_path / "one" / "animated-glb"
    code, out, _ = call(capsys, "export", ran[1], "--format", "animated-glb", "-o", one.parent)
    assert code == 0 and out == f"1 file in {one}\n"
    assert len(list(one.iterdir())) == 1


def test_cache_lists_names_and_sizes_the_latest_first_and_clears(capsys, tmp_path, monkeypatch):
    import os

    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    for k, (name, size) in enumerate((("old", 3_000_000), ("new", 1_250_000))):
        (tmp_path / f"{name}.sdf.npz").write_bytes(b"x" * size)
        os.utime(tmp_path / f"{name}.sdf.npz", (1e9 + k, 1e9 + k))
    (tmp_path / "other.txt").write_text("stays")
    assert call(capsys, "cache", "list") == (0, "new  1.2 MB\nold  3.0 MB\n", "")
    (tmp_path / "half.sdf.npz.part").write_bytes(b"x" * 50_000)
    assert call(capsys, "cache", "clear") == (0, "3 entries removed, 4.3 MB\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["other.txt"]
    assert call(capsys, "cache", "list") == (0, "", "")


def test_compiled_loops_are_cleared_apart(capsys, tmp_path, monkeypatch):
    from rbfmuscle.compiled import store

    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    (tmp_path / "field.sdf.npz").write_bytes(b"x")
    (tmp_path / "loops").mkdir()
    (tmp_path / "loops" / "a.loop").write_bytes(b"x" * 2_500_000)
    monkeypatch.setattr(store, "folders", lambda: (tmp_path / "loops",))
    assert call(capsys, "cache", "clear", "--loops") == (0, "1 loops removed, 2.5 MB\n", "")
    assert (tmp_path / "field.sdf.npz").exists() and not list((tmp_path / "loops").iterdir())


def table(statuses):
    jobs = [
        {"subject": f"s{k}", "trial": "walk", "status": s, "error": f"why {k}" if s == "failed" else ""}
        for k, s in enumerate(statuses)
    ]
    return {
        "jobs": jobs,
        "done": statuses.count("done"),
        "failed": statuses.count("failed"),
        "outliers": [],
        "values": [1],
    }


def test_cohort_that_is_whole_ends_well(capsys, tmp_path):
    cohort_command._tell(table(["done", "done"]), tmp_path, False)
    out, err = capsys.readouterr()
    assert out.startswith("2 jobs done, 0 failed, 0 values apart") and err == ""
    cohort_command._tell(table(["done"]), tmp_path, True)
    facts = json.loads(capsys.readouterr().out)
    assert facts["directory"] == str(tmp_path) and facts["done"] == 1 and "values" not in facts


def test_cohort_names_jobs_that_failed_or_were_not_run(capsys, tmp_path):
    with pytest.raises(SolveError, match="2 of 3 jobs failed"):
        cohort_command._tell(table(["done", "failed", "missing"]), tmp_path, False)
    out, err = capsys.readouterr()
    assert "1 jobs done, 1 failed" in out
    assert [line.rsplit(": ", 1)[1] for line in err.splitlines()] == ["why 1", "missing"]
