"""``rbfmuscle view``: a scene or a run in the browser."""

import math
import threading
import webbrowser
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    Model,
    Pairs,
    refuse,
)
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import (
    UsageError,
    did_you_mean,
)


def view(
    scene: Annotated[Path, Parameter(name=["scene", "--scene"])],
    *,
    model: Model = None,
    at: Pairs = None,
    colour: Literal["group", "fibres", "activation", "stretch", "penetration", "distance"]
    | None = None,
    browser: bool | None = None,
    port: int | None = None,
    screenshot: Path | None = None,
) -> None:
    """Show a scene or a run in the browser, with a slider for each joint coordinate or for the
    frames.

    Parameters
    ----------
    scene
        Scene file (TOML), "phantom" for a hip made by formulas, or the folder of a run or of a
        comparison.
    at
        Where to begin: COORDINATE=DEGREES, for instance hip.flexion=60; may be repeated. For a
        saved run: frame=N, where -1 is the last.
    colour
        What muscles are coloured by at first, in the browser; by default their group.
    browser
        Open the browser; --no-browser prints the address only.
    port
        Port of the address, which this machine alone can open; any free one by default.
    screenshot
        Draw this PNG at --at, without a display, and open nothing; the models of a comparison side
        by side.
    """
    stops = dict(_parse_stop(text) for text in at or [])
    if scene.is_dir():
        refuse(f"{scene}, the folder of a run,", {"--model": model})
    if screenshot is not None:
        refuse("--screenshot", {"--colour": colour, "--browser": browser, "--port": port})
    with Progress(f"view {scene.name}"):
        if screenshot is not None:
            with stage("drawing the picture"):
                _draw(_open(scene), model, stops, screenshot)
            print(screenshot)
            return
        from rbfmuscle.scene.file import read_scene_file
        from rbfmuscle.scene.phantom import PHANTOM
        from rbfmuscle.viewer import open_server

        if not scene.is_dir() and str(scene) != PHANTOM:
            read_scene_file(scene)  # its errors are shown before a browser opens
        server, address = open_server(port or 0)
        print(f"{address}  (Ctrl-C ends)", flush=True)
        if browser is not False:
            webbrowser.open(address)
        opened = _open(scene)
        from rbfmuscle.viewer.page import ViewerPage
        from rbfmuscle.viewer.sources import LiveSource, SavedSource

        with stage("building"):
            source = SavedSource(opened) if isinstance(opened, dict) else LiveSource(opened, model)
            _check_stops(stops, source.controls)
            if isinstance(opened, dict) and stops.get("frame", 0.0) < 0.0:
                shown = next(iter(opened.values())).frame(int(stops["frame"]))
                stops["frame"] = float(shown.index)
            ViewerPage(source, at=stops, colour=colour or "group", served=(server, address))
    threading.Event().wait()


def _parse_stop(text):
    name, _, value = text.partition("=")
    try:
        number = float(value)
        if not math.isfinite(number):
            raise ValueError
        return name, number
    except ValueError:
        raise UsageError(
            f"--at {text!r} is not COORDINATE=DEGREES, for instance hip.flexion=60"
        ) from None


def _check_stops(stops, known):
    for name in stops:
        if name not in known:
            raise UsageError(
                f"--at: unknown coordinate {name!r}, {did_you_mean(name, list(known))}"
            )


def _open(path):
    """A scene; of a folder the run in it, or those of the models of a comparison, by name."""
    from rbfmuscle.run.data import RunData
    from rbfmuscle.scene.phantom import open_scene

    if not path.is_dir():
        return open_scene(path)
    inside = sorted(file.parent for file in path.glob("*/run.json"))
    if (path / "run.json").exists() or not inside:
        return {path.resolve().name: RunData.load(path)}
    return {folder.name: RunData.load(folder) for folder in inside}


def _draw(opened, model, stops, path):
    """Draw a run's frame, or a scene's pose after a run to it, in the way `rbfmuscle render`
    does.
    """
    from rbfmuscle.display.pictures import check_picture, render_run
    from rbfmuscle.recording import simulate
    from rbfmuscle.scene.motion import coordinate_limits, inner_value, rest_coordinates
    from rbfmuscle.scene.objects import Motion

    check_picture(path)
    if not isinstance(opened, dict):  # a motion from rest to the pose
        _check_stops(stops, coordinate_limits(opened))
        rest = rest_coordinates(opened)
        scene = opened.with_options()
        there = {name: inner_value(scene, name, x) for name, x in stops.items()}
        scene.motion = Motion([rest, rest | there])
        render_run(simulate(scene, model), path, frame=1)
        return
    _check_stops(stops, ["frame"])
    first = next(iter(opened.values()))
    frame = int(stops.get("frame", first.frame_numbers[0]))
    if len(opened) > 1:
        render_run(opened, path, frame=frame, views=["motion"])
    else:
        render_run(first, path, frame=frame)
