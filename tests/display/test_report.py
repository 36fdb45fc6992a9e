"""The report: answer, moving scene and rows with limits first, whole, self-contained, honest about
limits.
"""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from rbfmuscle.display import pictures as render
from rbfmuscle.display.page import Cell, ReportPage, Section, Table, limit_state
from rbfmuscle.display.report import write_report
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.run.appearance import muscle_groups
from rbfmuscle.run.info import JointInfo
from rbfmuscle.validation import UsageError


@pytest.fixture(scope="module")
def folder(arm_run, tmp_path_factory):
    """Folder of a saved run without a report."""
    return shutil.copytree(arm_run[1], tmp_path_factory.mktemp("report") / "run")


def colours_of(image):
    return np.asarray(image.convert("RGB"), dtype=int).reshape(-1, 3)


def test_preview_shows_bone_and_muscle_move(folder):
    write_report(folder)
    with Image.open(folder / "preview.webp") as preview:
        first = colours_of(preview)
        assert (preview.n_frames, preview.info["duration"]) == (
            7,
            4000 // 7,
        )  # milliseconds of each
        preview.seek(6)
        last = colours_of(preview)
    for pixels in (first, last):
        rose = pixels[:, 0] > pixels[:, 1] + 50
        ivory = (pixels.min(axis=1) > 90) & (pixels[:, 0] - pixels[:, 2] > 12) & ~rose
        assert rose.mean() > 0.02 and ivory.mean() > 0.02
    assert (
        np.abs(first - last).max(axis=1) > 60
    ).mean() > 0.03  # the forearm has risen by 60 degrees


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.webp"])
def test_render_writes_what_the_suffix_says(folder, tmp_path, name):
    render.render_run(folder, tmp_path / name, views=["right"], area=40_000)
    with Image.open(tmp_path / name) as image:
        assert getattr(image, "n_frames", 1) == (1 if name == "a.png" else 7)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": ["side"]},
        {"frame": 99},
        {"output": "a.bmp"},
        {"output": "a.gif", "frame": 1},
        {"seconds": 2.0},
    ],
)
def test_render_refuses_wrong_words(folder, tmp_path, wrong):
    with pytest.raises(UsageError):
        render.render_run(folder, tmp_path / wrong.pop("output", "a.png"), **wrong)


def test_muscles_are_grouped_by_the_joints_that_they_cross():
    chain = {
        "hip": "pelvis femur",
        "knee": "femur tibia",
        "ankle": "tibia foot",
        "cap": "femur patella",
    }
    joints = [
        JointInfo(name=name, parent=bones.split()[0], child=bones.split()[1])
        for name, bones in chain.items()
    ]
    groups = {
        "pelvis femur": "across hip",
        "pelvis tibia": "across hip, knee",
        "femur patella": "along femur",
        "femur foot": "across knee",
    }
    for bones, group in groups.items():
        assert muscle_groups(joints, {"one": bones.split()}) == {"one": group}


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0234, "s", "23.4 ms"),
        (2.34, "s", "2.34 s"),
        (0.003, "mm", "< 0.01 mm"),
        (0.0, "mm", "0 mm"),
        (1.234, "mm", "1.23 mm"),
        (-41.27, "mm", "-41.3 mm"),
        (-7.1e-15, "1", "< 1e-12"),
        (3.0, "1", "3"),
        (None, "mm", "–"),
        (12345.6, "", "12346"),
        (float("nan"), "1", "–"),
    ],
)
def test_numbers_have_the_digits_that_say_something(value, unit, text):
    assert shown_number(value, unit) == text


def test_lights_are_green_amber_from_four_fifths_and_red_beyond():
    states = [limit_state("flicker", v, 0.5) for v in (0.1, -0.4, 0.45, 0.5, -0.51, np.nan)]
    assert states == ["good", "good", "near", "near", "bad", "bad"]
    assert [limit_state("components", v, 1.0) for v in (1.0, 2.0)] == ["good", "bad"]
    assert [limit_state("euler_characteristic", v, 2.0) for v in (2.0, 0.0)] == ["good", "bad"]
    assert limit_state("flicker", 5.0, None) == limit_state("flicker", None, 1.0) == "plain"


@pytest.mark.parametrize(
    ("facts", "states"),
    [({}, []), ({"first": 0.2}, ["good"]), ({"first": 3.0}, ["near"])],
)
def test_what_moves_beside_an_overlap_at_rest_is_a_row_of_its_own(folder, tmp_path, facts, states):
    run = shutil.copytree(folder, tmp_path / "run")
    info = json.loads((run / "run.json").read_text())
    info["muscles"]["biceps"]["rest_error_at_overlap"] = {"unit": "mm", **facts}
    (run / "run.json").write_text(json.dumps(info))
    write_report(run, pictures=False)
    page = (run / "report.html").read_text()
    assert re.findall(r'\(rest_error_at_overlap\): biceps.*?<td class="(\w+)"', page) == states


def test_names_stay_text(tmp_path):
    table = Table(["<b>"], [[Cell("<b>one")]])
    sections = [Section("<b>", table=table), Section("empty")]
    ReportPage("<b>", ["<b>"], "<b>", sections=sections).write(tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<b>" not in text and "&lt;b&gt;one" in text and "empty" not in text
