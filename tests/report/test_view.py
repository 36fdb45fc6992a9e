"""The viewer's state without a window, and the window under a virtual display."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import toy_scene

from rbfmuscle.cli.view import _begin_at
from rbfmuscle.report.viewer.live import LiveViewer
from rbfmuscle.report.viewer.saved import SavedViewer
from rbfmuscle.simulation.live import LiveSession, coordinate_limits
from rbfmuscle.validation import UsageError

HERE = Path(__file__).resolve().parent


@pytest.fixture
def viewer():
    scene, fields = toy_scene.hinged_scene([0, 20, 40])
    session = LiveSession(scene, fields=fields)
    made = LiveViewer(
        session, lambda model, quality: [toy_scene.ToyMuscle(m, scene) for m in scene.muscles],
        ["toy", "other"], ["as given"],
    )  # fmt: skip
    yield made
    made.close()


def go(viewer):
    count, view = 0, None
    while viewer.pending:
        view, count = viewer.advance(), count + 1
    return view, count


def test_view_begins_where_it_is_told_live_or_saved():
    class Told:
        """Takes down what it is told."""

        coordinates = ("hip.flexion", "knee.flexion")

        def __init__(self, live):
            self.live, self.at = live, []

        def set(self, name, value):
            self.at.append((name, value))

        def place_of(self, value):
            return 0.1 * value

        def scrub(self, place):
            self.at.append(place)

    live, saved = Told(True), Told(False)
    _begin_at(live, [("knee.flexion", 20.0), ("hip.flexion", 5.0)])
    _begin_at(saved, [("frame", 3.0)])
    assert live.at == [("knee.flexion", 20.0), ("hip.flexion", 5.0)] and saved.at == [pytest.approx(0.3)]
    with pytest.raises(UsageError, match="unknown coordinate 'frame'"):
        _begin_at(live, [("frame", 3.0)])
    with pytest.raises(UsageError, match=r"unknown coordinate 'knee\.flexion'"):
        _begin_at(saved, [("knee.flexion", 3.0)])


def test_limits_hold_the_motion_and_30_degrees():
    scene, _ = toy_scene.hinged_scene([0, 20, 70])
    low, high = np.degrees(coordinate_limits(scene)["hinge.bend"])
    assert (low, high) == pytest.approx((-30, 70))


def test_slider_moves_the_muscle_by_small_pictures(viewer):
    start, _ = go(viewer)
    viewer.set("hinge.bend", 21.0)
    assert viewer.pending
    view, count = go(viewer)
    assert count == 11  # two degrees a picture
    assert not np.allclose(view.surfaces["strap"][0], start.surfaces["strap"][0])
    assert np.degrees(viewer.session.here["hinge.bend"]) == pytest.approx(21.0)


def test_live_equals_a_run(viewer):
    from rbfmuscle.simulation.frame_loop import simulate_frames

    scene, fields = toy_scene.hinged_scene([0, 2, 4, 6])
    models = [toy_scene.ToyMuscle(m, scene) for m in scene.muscles]
    run = list(simulate_frames(scene, models, fields=fields))
    go(viewer)
    viewer.set("hinge.bend", 6.0)
    view, _ = go(viewer)
    assert np.allclose(view.surfaces["strap"][0], run[-1].surfaces["strap"].vertices, atol=1e-9)


def test_target_stays_within_limits(viewer):
    viewer.set("hinge.bend", 500.0)
    assert viewer.coordinates["hinge.bend"][2] == pytest.approx(40.0)


def test_rest_and_switch_lead_back_to_the_same_shapes(viewer):
    viewer.set("hinge.bend", 10.0)
    first, _ = go(viewer)
    viewer.switch(model="other")
    second, _ = go(viewer)
    viewer.switch(model="toy")
    third, _ = go(viewer)
    for other in (second, third):
        assert np.array_equal(first.surfaces["strap"][0], other.surfaces["strap"][0])


def test_solve_error_leads_back_to_rest_with_a_message(viewer):
    go(viewer)
    model = viewer.session.models[0]
    healthy = model.solve

    def broken(contacts):
        raise np.linalg.LinAlgError("planted")

    viewer.set("hinge.bend", 10.0)
    model.solve = broken
    view = viewer.advance()
    assert "back to rest" in view.lines[-1]
    assert "planted" in view.lines[-1]
    assert viewer.session.here["hinge.bend"] == 0.0
    model.solve = healthy
    viewer.set("hinge.bend", 10.0)
    go(viewer)
    assert np.degrees(viewer.session.here["hinge.bend"]) == pytest.approx(10.0)


@pytest.mark.parametrize("colouring", ["penetration", "distance", "stretch", "volume"])
def test_every_colouring_gives_one_number_a_vertex(viewer, colouring):
    viewer.colour_by(colouring)
    view, _ = go(viewer)
    values = view.values["strap"]
    assert values.shape == (len(view.surfaces["strap"][0]),)
    assert np.isfinite(values).all()
    assert viewer.scale()[0]


def test_stretch_and_volume_are_zero_at_rest(viewer):
    for colouring in ("stretch", "volume"):
        viewer.colour_by(colouring)
        view, _ = go(viewer)
        # the toy muscle is pressed out of the bone before the first frame, so not to rounding
        assert abs(np.median(view.values["strap"])) < 0.05


def test_unknown_colouring_is_refused(viewer):
    with pytest.raises(UsageError, match="known: nothing"):
        viewer.colour_by("mood")


def test_export_writes_a_surface_a_muscle(viewer, tmp_path):
    import trimesh

    view, _ = go(viewer)
    (path,) = viewer.export(view, tmp_path, viewer.label())
    assert trimesh.load(path).is_volume
    assert path.name == "strap_bend+0.ply"


def saved_run(tmp_path):
    from rbfmuscle.run import stream_run
    from rbfmuscle.scene.phantom import phantom_scene

    stream_run(phantom_scene(), tmp_path, model="pbd", frames="0:6:2", pictures=False)
    return tmp_path


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    return saved_run(tmp_path_factory.mktemp("run"))


def test_saved_run_is_scrubbed(run_folder):
    from rbfmuscle.output.saved import SavedRun

    viewer = SavedViewer(SavedRun(run_folder))
    assert viewer.count == 3
    first = viewer.advance()
    assert not viewer.pending
    viewer.scrub(viewer.place_of(2))
    assert viewer.pending
    last = viewer.advance()
    assert not np.allclose(first.surfaces["extensor"][0], last.surfaces["extensor"][0])
    assert "frame 2" in last.lines[0]
    with pytest.raises(UsageError, match="not written"):
        viewer.place_of(3)
    viewer.colour_by("stretch")
    assert np.abs(viewer.advance().values["extensor"]).max() > 0.01


# --- the command and the window ---------------------------------------------------------------------------


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only X11 has a DISPLAY")
@pytest.mark.parametrize("display", [{}, {"DISPLAY": ":987"}], ids=["unset", "dead"])
def test_without_a_display_one_line_says_what_to_do(display):
    code = "import sys; from rbfmuscle.cli import main; main(['view', 'phantom'])"
    env = {k: v for k, v in os.environ.items() if k != "DISPLAY"} | display
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 7
    assert len(done.stderr.strip().splitlines()) == 1
    assert "xvfb-run" in done.stderr


@pytest.fixture(scope="module")
def display():
    """A virtual display; the test is skipped where none can be had."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb to open a window on")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1400x1000x24", "-nolisten", "tcp"],
        pass_fds=[writing], stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(writing)
    with os.fdopen(reading) as pipe:
        number = pipe.readline().strip()
    if not number:
        server.wait()
        pytest.skip("Xvfb does not start here")
    yield f":{number}"
    server.terminate()
    server.wait()


def in_window(display, *arguments):
    """What `view_script` saw."""
    done = subprocess.run(
        [sys.executable, str(HERE / "view_script.py"), *map(str, arguments)],
        env=os.environ | {"DISPLAY": display}, capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert lines, done.stderr[-2000:]
    return json.loads(lines[0].removeprefix("RESULT "))


def test_dragging_the_slider_of_a_window_moves_the_muscles(display, tmp_path):
    seen = in_window(display, tmp_path)
    assert seen["target"] > 20
    assert seen["here"] == pytest.approx(seen["target"])
    extensor = np.subtract(seen["moved"]["extensor"], seen["rest"]["extensor"])
    assert np.linalg.norm(extensor) > 5.0
    assert seen["changed"] > 0.02
    assert seen["colouring"] == "distance"
    assert seen["recoloured"] > 0.02
    assert Path(seen["screenshot"]).stat().st_size > 10_000
    assert len(seen["exported"]) == 4
    assert all(Path(path).exists() for path in seen["exported"])


def test_saved_run_is_scrubbed_in_a_window(display, run_folder, tmp_path):
    seen = in_window(display, tmp_path, run_folder)
    assert seen["place"] == 2
    assert seen["changed"] > 0.005
