"""The report: whole, self-contained, honest about limits, and written even where nothing can be drawn."""

import base64
import io
import re
from html.parser import HTMLParser
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, use_blend_model
from PIL import Image

import rbfmuscle.report.render as render
from rbfmuscle.metrics.summary import within
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report import labels
from rbfmuscle.report.appearance import fitted_size, neighbour_colours
from rbfmuscle.report.page import folded_events
from rbfmuscle.report.plots import motion_axis, plot_panels
from rbfmuscle.report.report import write_report
from rbfmuscle.run import simulate, stream_run
from rbfmuscle.validation import MissingPartError, UsageError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a saved run without a report."""
    place = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        simulate(arm_scene(end=60)).save(place)
    return place


class Balance(HTMLParser):
    """Checks that every element is closed and notes what is loaded."""

    def __init__(self):
        super().__init__()
        self.open, self.sources = [], []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    return text, parser.sources


def colours_of(image):
    return np.asarray(image.convert("RGB"), dtype=int).reshape(-1, 3)


def test_report_without_pictures_has_plots_and_says_so(folder):
    (folder / "preview.webp").unlink(missing_ok=True)  # of a test before this one
    assert write_report(folder, preview=False, pictures=False) is None
    text, sources = read(folder)
    assert "There are no pictures" in text
    assert all(source.startswith("data:image/svg+xml") for source in sources)
    assert len(sources) == len(plot_panels(SavedRun(folder))) >= 6
    assert "http" not in re.sub(r"base64,[^\"]+", "", text)


def test_red_cells_are_those_beyond_their_limits(folder):
    write_report(folder, preview=False, pictures=False)
    text, _ = read(folder)
    info = SavedRun(folder).info
    beyond = [
        name
        for name, limit in info["limits"].items()
        if name in info["muscles"]["biceps"]
        and not within(name, info["muscles"]["biceps"][name]["worst"], limit)
    ]
    assert beyond
    assert text.count('<td class="bad">') == len(beyond)
    for name in beyond:
        assert f"biceps: {name}" in text


def test_pictures_show_bone_and_muscle(folder, graphics):
    assert write_report(folder) is None
    _, sources = read(folder)
    pictures = [s for s in sources if s.startswith("data:image/png")]
    assert len(pictures) == 3
    image = Image.open(io.BytesIO(base64.b64decode(pictures[1].split(",")[1])))
    pixels = colours_of(image.crop((0, 30, image.width, image.height - 40)))
    red = (pixels[:, 0] > pixels[:, 1] + 60).mean()
    ivory = ((pixels.min(axis=1) > 90) & (pixels[:, 0] - pixels[:, 2] > 15) & (pixels[:, 0] < 254)).mean()
    assert red > 0.02
    assert ivory > 0.02
    with Image.open(folder / "preview.webp") as preview:
        assert preview.n_frames == 7
        first = colours_of(preview.crop((0, 30, preview.width, preview.height - 40)))
        preview.seek(6)
        last = colours_of(preview.crop((0, 30, preview.width, preview.height - 40)))
    assert (np.abs(first - last).max(axis=1) > 60).mean() > 0.03  # the forearm has risen by 60 degrees


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.webp"])
def test_render_writes_what_the_suffix_says(folder, tmp_path, graphics, name):
    render.render_run(folder, tmp_path / name, views=["side"], size=(160, 200))
    with Image.open(tmp_path / name) as image:
        assert image.size[0] == 160
        assert getattr(image, "n_frames", 1) == (1 if name == "a.png" else 7)


def test_render_refuses_wrong_words(folder, tmp_path):
    for wrong in (
        {"output": "a.bmp"},
        {"output": "a.png", "views": ["top"]},
        {"output": "a.png", "frame": 99},
    ):
        words = dict(wrong)
        with pytest.raises(UsageError):
            render.render_run(folder, tmp_path / words.pop("output"), **words)


def test_missing_graphics_leave_the_report_and_say_why(folder, tmp_path, monkeypatch):
    dead = SimpleNamespace(returncode=-6, stderr="noise\nbad X server connection\n", stdout="")
    monkeypatch.setattr(render.subprocess, "run", lambda *args, **kwargs: dead)
    missing = write_report(folder)
    assert isinstance(missing, MissingPartError)
    assert missing.exit_code == 7
    text, _ = read(folder)
    assert "bad X server connection" in text
    use_blend_model(monkeypatch)
    with pytest.raises(MissingPartError, match="OpenGL"):
        stream_run(arm_scene(report=True, preview=True), tmp_path)
    assert SavedRun(tmp_path).info["status"] == "complete"
    assert (tmp_path / "report.html").is_file()


def test_child_says_what_is_wrong_in_one_line(tmp_path):
    with pytest.raises(MissingPartError, match="holds no run"):
        render.draw(tmp_path, [])


def test_axis_is_the_angle_where_one_coordinate_goes_one_way(folder):
    places, label = motion_axis(SavedRun(folder))
    assert label == "elbow.flexion [degree]"
    assert places[6] == pytest.approx(60)


def test_axis_is_the_frame_on_the_way_there_and_back():
    rows = [{"frame": k, "coordinates": {"a.b": v}} for k, v in enumerate([0, 10, 0])]
    places, label = motion_axis(SimpleNamespace(info={"frames": rows}, frames=[0, 1, 2]))
    assert label == "frame"
    assert places == {0: 0, 1: 1, 2: 2}


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """Folder of a saved run of twelve muscles, one of which goes beyond a limit."""
    place = tmp_path_factory.mktemp("crowd")
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        scene = arm_scene(end=20)
        one = scene.muscles[0]
        for k in range(1, 12):
            mesh = one.mesh.copy()
            mesh.apply_translation([0.0, 11.0 * k, 0.0])
            # The last lies partly in a bone of its own.
            attach = [{"bone": a.bone, "vertices": np.asarray(a.vertices).tolist()} for a in one.attachments]
            scene.add_muscle(f"muscle_{k:02d}", mesh, attach=attach)
        # It runs through the seventh.
        nail = trimesh.creation.box((4, 4, 40))
        nail.apply_translation([0.0, 11.0 * 7, 9.5])
        scene.add_bone("nail", nail)
        simulate(scene).save(place)
    return place


def test_dozens_of_muscles_have_a_row_each_the_worst_first(crowd):
    write_report(crowd, preview=False, pictures=False)
    text, _ = read(crowd)
    table = text[text.index("<h2>Summary") : text.index("<h2>Events")]
    names = re.findall(r"<tr><th>([a-z_0-9]+)</th>", table[table.index("</thead>") :])
    assert len(names) == 12 and names[0] == "muscle_07"
    assert 'class="find"' in table and 'class="sortable"' in table
    red = [row.count('class="bad"') for row in table[table.index("</thead>") :].split("<tr>")[1:]]
    assert red == sorted(red, reverse=True) and red[0] > red[1]


def test_events_are_folded_by_kind():
    events = [(k, "one", "bone", 1, "halved") for k in range(70)] + [(3, "", "bone", 1, "bones_overlap")]
    text = folded_events(events, 60)
    assert text.count("<details>") == 2 and "and 10 more" in text
    assert text.index("halved") < text.index("bones_overlap") and "one 70" in text
    assert text.count("<td>") == (60 + 1) * 4 and text.count("<th>") == 2 * 4, "a cell for each heading"
    assert "<td>59</td><td>one</td><td>bone</td><td>1</td></tr>" in text


def test_neighbours_of_many_have_different_colours(crowd):
    colours = neighbour_colours(SavedRun(crowd))
    names = sorted(name for name in colours if name.startswith("muscle"))
    # They lie 11 mm apart and are 10 mm wide: each touches the next, none the one after.
    assert all(colours[one] != colours[two] for one, two in pairwise(names))
    assert len(set(colours.values())) > 4


@pytest.mark.parametrize(("spans", "taller"), [((10, 10, 100), True), ((100, 10, 20), False)])
def test_panels_have_the_proportions_of_what_they_show(spans, taller):
    bounds = np.array([[0.0, 0.0, 0.0], spans])
    width, height = fitted_size(bounds, ["front", "side"], (330, 400))
    assert (height > 2 * width) == taller and (height > width) == taller
    assert width * height == pytest.approx(330 * 400, rel=0.02)
    assert width % 2 == height % 2 == 0


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_frames_of_different_heights_make_one_animation(tmp_path, suffix):
    path = str(tmp_path / f"moving{suffix}")
    images = [Image.new("RGB", (80, height), "#aa3333") for height in (60, 75, 60)]
    render.save_images(images, path, 1.0)
    with Image.open(path) as made:
        assert (made.size, made.n_frames) == ((80, 75), 3)


def test_long_captions_take_more_lines():
    picture = np.full((50, 300, 3), 255, dtype=np.uint8)
    text = "frame 12, " + ", ".join(f"joint_{k}.coordinate {k}°" for k in range(4))
    sheet = labels.labelled(picture, text, ["front"], {"muscle": "#aa0000"})
    short = labels.labelled(picture, "frame 12", ["front"], {"muscle": "#aa0000"})
    assert sheet.size[0] == 300 and sheet.size[1] > short.size[1]
    # Nothing of the caption is cut off by the right edge.
    assert (np.asarray(sheet)[50:, -4:] == 255).all()
