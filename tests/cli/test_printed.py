"""What commands print at their end: the figures of what they left, once each."""

import json
import re

import pytest
from blend_model import arm_files, use_blend_model
from command_line import call

from rbfmuscle.cli.run import SHOWN
from rbfmuscle.metrics.summary import shown_number

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
    rows = {(cells := re.split(r"\s{2,}", line))[0]: cells[1:] for line in printed[2:-2]}
    assert list(rows) == [name for name, _ in TWO]
    for name, cells in rows.items():
        facts = info["muscles"][name]
        for key, cell in zip(SHOWN, cells, strict=True):
            worst = facts.get(key, {}).get("worst")
            assert cell == ("nan" if worst is None else shown_number(abs(worst)))
    assert re.match(r"verdict: (every muscle is|\d of 2 muscles are) within all limits", printed[-2])
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
