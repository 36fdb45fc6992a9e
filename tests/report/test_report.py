"""The report: answer, moving scene and rows with limits first, whole, self-contained, honest about limits."""

import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from rbfmuscle.metrics.summary import describe_verdict, shown_number, within
from rbfmuscle.output.appearance import muscle_groups
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report import render
from rbfmuscle.report.page import Cell, Page, Section, Table, limit_state
from rbfmuscle.report.report import _events, write_report
from rbfmuscle.validation import UsageError


@pytest.fixture(scope="module")
def folder(arm_run, tmp_path_factory):
    """Folder of a saved run without a report."""
    return shutil.copytree(arm_run[1], tmp_path_factory.mktemp("report") / "run")


class Outline(HTMLParser):
    """Checks that every element is closed, and notes what is loaded, and the cells of the rows with lights."""

    def __init__(self):
        super().__init__()
        self.open, self.sources, self.lights = [], [], {}

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br", "input"):
            self.open.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, text):
        inside = any(attrs.get("class") == "lights" for tag, attrs in self.open if tag == "table")
        if inside and self.open[-1][0] == "th":
            self.title = text
        elif inside and self.open[-1][0] == "td" and self.open[-1][1].get("class"):
            self.lights[self.title] = self.open[-1][1]["class"], text


def read(folder, name="report.html"):
    text = (folder / name).read_text(encoding="utf-8")
    outline = Outline()
    outline.feed(text)
    assert outline.open == []
    return text, outline


def test_answer_picture_and_rows_come_before_what_is_folded(folder):
    write_report(folder)
    text, outline = read(folder)
    verdict = describe_verdict(SavedRun(folder).info["muscles"], SavedRun(folder).info["limits"])
    order = [verdict.partition(". ")[0][1:], 'data-scene="scene"', "Keeps its volume", "<details>"]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert len(outline.lights) == 5 and "http" not in text
    assert all(source.startswith("data:") for source in outline.sources)
    assert len(text) < 6_000_000


def test_lights_and_red_cells_are_those_beyond_their_limits(folder):
    write_report(folder, pictures=False)
    text, outline = read(folder)
    info = SavedRun(folder).info
    found, limits = info["muscles"]["biceps"], info["limits"]
    beyond = [n for n, limit in limits.items() if n in found and not within(n, found[n]["worst"], limit)]
    assert beyond and "No pictures: they were switched off." in text
    cells = re.findall(r"<td[^>]*>", text[text.index("Every quantity") :])
    assert sum("bad" in cell for cell in cells) == len(beyond)
    depth = max(abs(found[name]["worst"]) for name in ("penetration_max", "bone_penetration_max"))
    kept_out = all(n not in beyond for n in ("penetration_max", "bone_penetration_max", "initial_overlap"))
    assert (outline.lights["Stays out of bones"][0] == "bad") == (not kept_out)
    assert kept_out or outline.lights["Stays out of bones"][1] == shown_number(depth, "mm")


def test_scene_holds_every_frame_and_colour_of_the_plots(folder):
    write_report(folder)
    text, _ = read(folder)
    facts = json.loads(re.search(r'<script id="scene"[^>]*>(.*?)</script>', text, re.S)[1])
    assert len(facts["captions"]) == 7 and facts["captions"][6] == "frame 6, elbow.flexion 60°"
    colours = {part["name"]: part["colour"] for part in facts["parts"]}
    assert re.search(
        rf'data-muscle="biceps"><title>biceps</title>\s*<path[^>]*stroke: {colours["biceps"]}', text
    )
    np.testing.assert_allclose(np.abs(facts["direction"]), [0, 1, 0], atol=1e-9)  # the elbow's axis


def colours_of(image):
    return np.asarray(image.convert("RGB"), dtype=int).reshape(-1, 3)


def test_preview_shows_bone_and_muscle_move(folder):
    write_report(folder)
    with Image.open(folder / "preview.webp") as preview:
        assert preview.n_frames == 7
        first = colours_of(preview)
        preview.seek(6)
        last = colours_of(preview)
    for pixels in (first, last):
        rose = pixels[:, 0] > pixels[:, 1] + 50
        ivory = (pixels.min(axis=1) > 90) & (pixels[:, 0] - pixels[:, 2] > 12) & ~rose
        assert rose.mean() > 0.02 and ivory.mean() > 0.02
    assert (np.abs(first - last).max(axis=1) > 60).mean() > 0.03  # the forearm has risen by 60 degrees


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.webp"])
def test_render_writes_what_the_suffix_says(folder, tmp_path, name):
    render.render_run(folder, tmp_path / name, views=["right"], area=40_000)
    with Image.open(tmp_path / name) as image:
        assert getattr(image, "n_frames", 1) == (1 if name == "a.png" else 7)


@pytest.mark.parametrize("wrong", [{"views": ["side"]}, {"frame": 99}, {"output": "a.bmp"}])
def test_render_refuses_wrong_words(folder, tmp_path, wrong):
    words = {"output": "a.png", **wrong}
    with pytest.raises(UsageError):
        render.render_run(folder, tmp_path / words.pop("output"), **words)


def test_muscles_are_grouped_by_the_joints_that_they_cross():
    chain = {"hip": "pelvis femur", "knee": "femur tibia", "ankle": "tibia foot", "cap": "femur patella"}
    joints = [{"name": n, **dict(zip(("parent", "child"), b.split()))} for n, b in chain.items()]
    for bones, group in (
        (("pelvis", "femur"), "across hip"),
        (("pelvis", "tibia"), "across hip, knee"),
        (("femur", "patella"), "along femur"),
        (("femur", "foot"), "across knee"),
    ):
        muscle = {"name": "one", "attach": [{"bone": bone} for bone in bones]}
        assert muscle_groups({"scene": {"joints": joints, "muscles": [muscle]}}) == {"one": group}


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.0234, "s", "23.4 ms"), (2.34, "s", "2.34 s"), (0.003, "mm", "< 0.01 mm"), (0.0, "mm", "0 mm"),
     (1.234, "mm", "1.23 mm"), (-41.27, "mm", "-41.3 mm"), (-7.1e-15, "1", "< 1e-12"), (3.0, "1", "3"),
     (None, "mm", "–"), (12345.6, "", "12346"), (float("nan"), "1", "–")],
)  # fmt: skip
def test_numbers_have_the_digits_that_say_something(value, unit, text):
    assert shown_number(value, unit) == text


def test_lights_are_green_amber_from_four_fifths_and_red_beyond():
    states = [limit_state("flicker", v, 0.5) for v in (0.1, -0.4, 0.45, 0.5, -0.51, np.nan)]
    assert states == ["good", "good", "near", "near", "bad", "bad"]
    assert [limit_state("components", v, 1.0) for v in (1.0, 2.0)] == ["good", "bad"]
    assert [limit_state("euler", v, 2.0) for v in (2.0, 0.0)] == ["good", "bad"]
    assert limit_state("flicker", 5.0, None) == limit_state("flicker", None, 1.0) == "plain"


def test_events_are_counted_by_kind():
    events = [(k, "one", "bone", 1, "halved") for k in range(70)] + [(3, "", "bone", 1, "bones_overlap")]
    assert _events(events) == "halved: 70 (one 70). bones_overlap: 1 (bone 1)."


def test_names_stay_text(tmp_path):
    table = Table(["<b>"], [[Cell("<b>one")]])
    Page("<b>", ["<b>"], "<b>", sections=[Section("<b>", table=table), Section("empty")]).write(
        tmp_path / "a.html"
    )
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<b>" not in text and "&lt;b&gt;one" in text and "empty" not in text
