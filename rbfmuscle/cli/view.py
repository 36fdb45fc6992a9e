"""``rbfmuscle view``: a window on a scene that is moved by hand, or on a saved run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.scenes import load_scene
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import UsageError

# What each quality changes in a muscle's model table; "as given" changes nothing.
QUALITIES = {
    "as given": {},
    "fast": {"rbf": {"resolution": 32, "samples": 1000}},
    "fine": {"rbf": {"resolution": 64}},
}


def view(
    scene: Annotated[Path, Parameter(name=["scene", "--scene"])],
    *,
    model: str | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("view"),
    colour: str = "nothing",
    at: Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)] = None,
    screenshot: Path | None = None,
) -> None:
    """Open a window: a slider for each joint coordinate, or for the frames of a saved run.

    Parameters
    ----------
    scene
        Scene file (TOML), "phantom" for the embedded hip, or the folder of a run.
    model
        Model to begin with, in place of the scene's.
    output
        Folder for screenshots and exported surfaces.
    colour
        nothing, penetration, distance (to the bones), stretch or volume.
    at
        COORDINATE=DEGREES to begin at, for instance hip.flexion=60; may be repeated. Of a saved run: frame=N.
    screenshot
        Write the window to this PNG as soon as it stands at --at, and close it.
    """
    from rbfmuscle.output.saved import SavedRun
    from rbfmuscle.report.viewer.viewer import COLOURINGS
    from rbfmuscle.report.viewer.window import Window, require_display

    stops = [_parse_stop(text) for text in at or []]
    if colour not in COLOURINGS:
        raise UsageError(f"unknown colouring {colour!r}; known: {', '.join(COLOURINGS)}")
    # A wrong path is told before a display is asked for.
    opened = SavedRun(scene) if scene.is_dir() else load_scene(str(scene))
    require_display()
    with Progress(f"view {scene.name}"):
        viewer, motion, title = _open_saved(opened) if scene.is_dir() else _open_scene(opened, model)
        viewer.colour_by(colour)
        with stage("building"):
            _begin_at(viewer, stops)
    window = Window(viewer, output, motion=motion, title=title)
    window.open(until_closed=screenshot is None)
    if screenshot is not None:
        while window.tick():
            pass
        screenshot.parent.mkdir(parents=True, exist_ok=True)
        window.write_picture(screenshot)
        window.close()
        print(screenshot)


def _parse_stop(text):
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise UsageError(f"--at {text!r} is not COORDINATE=DEGREES, for instance hip.flexion=60") from None


def _begin_at(viewer, stops):
    from rbfmuscle.validation import did_you_mean

    for name, value in stops:
        known = list(viewer.coordinates) if viewer.live else ["frame"]
        if name not in known:
            raise UsageError(f"--at: unknown coordinate {name!r}, {did_you_mean(name, known)}")
        if viewer.live:
            viewer.set(name, value)
        else:
            viewer.scrub(viewer.place_of(value))


def _open_saved(run):
    from rbfmuscle.report.viewer.saved import SavedViewer

    return SavedViewer(run), None, f"rbfmuscle: {run.directory}"


def _open_scene(loaded, model):
    from rbfmuscle.models import build_models, configure_scene
    from rbfmuscle.report.viewer.live import LiveViewer
    from rbfmuscle.scene.motion import shown_value
    from rbfmuscle.simulation.live import LiveSession

    scene = configure_scene(loaded, model=model)
    scene.validate()
    print(f"rbfmuscle: preparing {scene.name}", file=sys.stderr)
    models = [scene.muscles[0].model]
    models += [name for name in ("rbf", "pbd", "xpbd", "arap-volume") if name not in models]

    def build(name, quality):
        changed = QUALITIES[quality].get(name, {})
        chosen = scene if name == models[0] else scene.with_options(model=name)
        settings = {f"model.{key}": value for key, value in changed.items()}
        return build_models(chosen.with_options(settings))

    viewer = LiveViewer(LiveSession(scene), build, models, list(QUALITIES))
    free = viewer.coordinates
    motion = [{k: shown_value(scene, k, v) for k, v in q.items() if k in free} for q in scene.motion.frames]
    return viewer, motion, f"rbfmuscle: {scene.name}"
