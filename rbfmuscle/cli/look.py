"""``rbfmuscle view``, ``render``, ``report`` and ``export``: a scene or a run in the browser, in
pictures, on its page and in other formats.
"""

import json
import math
import threading
import webbrowser
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    FailOn,
    Model,
    Muscles,
    OwnFolder,
    Pairs,
    RunFolder,
    refuse,
    split_list,
)
from rbfmuscle.cli.printing import USUAL, Printing, print_result
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import (
    LimitExceededError,
    MissingDependencyError,
    UsageError,
    did_you_mean,
)

# What a study keeps, and its page.
STUDIES = (
    ("compare", "comparison.json", "report.html"),
    ("kernels", "kernels.json", "kernels.html"),
    ("sweep", "sweep.json", "sweep.html"),
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
        Draw this PNG at --at, without a display, and open nothing.
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
        from rbfmuscle.viewer.server import open_server

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
    """A scene, or the runs in a folder."""
    from rbfmuscle.scene.phantom import open_scene

    return _open_runs(path) if path.is_dir() else open_scene(path)


def _open_runs(folder):
    """The run in a folder, or those of the models of a comparison, by name."""
    from rbfmuscle.run.data import RunData

    inside = sorted(path.parent for path in folder.glob("*/run.json"))
    if (folder / "run.json").exists() or not inside:
        return {folder.resolve().name: RunData.load(folder)}
    return {path.name: RunData.load(path) for path in inside}


def _draw(opened, model, stops, path):
    """Draw a run's frame, or a scene's pose after a run to it, in the way `rbfmuscle render`
    does.
    """
    from rbfmuscle.display.pictures import check_picture, render_run
    from rbfmuscle.recording import simulate

    check_picture(path)
    if isinstance(opened, dict):
        _check_stops(stops, ["frame"])
        if len(opened) > 1:
            names = ", ".join(opened)
            raise UsageError(f"--screenshot draws one run, give the folder of one of {names}")
        (saved,) = opened.values()
        frame = int(stops.get("frame", saved.frame_numbers[0]))
    else:
        saved, frame = simulate(_posed(opened, stops), model), 1
    render_run(saved, path, frame=frame)


def _posed(scene, stops):
    """The scene with a motion from rest to one pose."""
    from rbfmuscle.scene.motion import inner_value, rest_coordinates
    from rbfmuscle.scene.objects import Motion
    from rbfmuscle.simulation.live import coordinate_limits

    _check_stops(stops, coordinate_limits(scene))
    rest, scene = rest_coordinates(scene), scene.with_options()
    scene.motion = Motion(
        [rest, rest | {name: inner_value(scene, name, x) for name, x in stops.items()}]
    )
    return scene


def export(
    directory: RunFolder,
    *,
    formats: Annotated[str, Parameter(name="--format")],
    output: OwnFolder = None,
    units: str | None = None,
    muscles: Muscles = None,
    frames: str | None = None,
    fps: float | None = None,
    printing: Printing = USUAL,
) -> int:
    """Write the surfaces of a run in other formats and units.

    Parameters
    ----------
    formats
        Formats, separated by commas. pvd, vtp, ply, stl, obj or glb: files for each frame;
        animated-glb (Blender) or usd: all frames in one animated file.
    output
        Folder to write to, DIR/export by default.
    units
        m, cm or mm; the scene's by default (glb, animated-glb: m).
    muscles
        Muscles of the run, separated by commas; all by default. Bones are always written.
    frames
        Some of the written frames, FIRST:END:STEP as a Python slice.
    fps
        Frames per second of animated-glb and usd; by default the times of the motion's file, or 24.
    """
    with Progress(f"export {directory}"):
        from rbfmuscle.display.export import export_run
        from rbfmuscle.scene.frames import parse_slice

        chosen = parse_slice(frames) if frames is not None else None
        names, failed = split_list(formats), None
        try:
            written = export_run(
                directory,
                names,
                output=output,
                units=units,
                muscles=None if muscles is None else split_list(muscles),
                frames=chosen,
                fps=fps,
            )
        except MissingDependencyError as error:
            written, failed = error.written, error
            if not written:
                raise
    folders = sorted({str(path.parent) for path in written})
    several = f"{len(written)} files in {', '.join(folders)}"
    facts = {"files": [str(path) for path in written]}
    lines = [several if len(written) > 1 else str(written[0])]
    return print_result(printing, facts, lines, error=failed)


def render(
    directory: RunFolder,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    frame: int | None = None,
    view: str | None = None,
    seconds: float | None = None,
    printing: Printing = USUAL,
) -> int:
    """Draw a run: a picture (.png) or an animation (.gif, .webp).

    Parameters
    ----------
    output
        File to draw.
    frame
        Frame of a picture; -1, the last one, by default.
    view
        Views, separated by commas: front, back, left, right, top, bottom or motion (in its plane);
        front, right and back by default.
    seconds
        Length of an animation; 5 by default.
    """
    with Progress(f"render {directory}"):
        from rbfmuscle.display.pictures import render_run

        views = split_list(view) or None
        with stage("drawing pictures"):
            render_run(directory, output, frame=frame, views=views, seconds=seconds)
    return print_result(printing, {"file": str(output)}, [str(output)])


def report(
    directory: Annotated[
        Path, Parameter(help="Folder of a run, a comparison, a study of kernels or a sweep.")
    ],
    *,
    fail_on: FailOn = None,
    pictures: bool = True,
    printing: Printing = USUAL,
) -> int:
    """Write the page of a run or a study again, for instance after a change of limits.

    Parameters
    ----------
    pictures
        Draw pictures and the animation.
    """
    with Progress(f"report {directory}"), stage("drawing pictures" if pictures else "writing"):
        from rbfmuscle.display.report import redraw_run
        from rbfmuscle.run.data import RunData

        failed, page = None, directory / "report.html"
        study = _redraw_study(directory, pictures=pictures)
        if study is not None:
            if fail_on is not None:
                raise UsageError(f"--fail-on is for the folder of a run, {directory} holds several")
            page, facts = study
        else:
            try:
                facts = redraw_run(directory, fail_on=fail_on, pictures=pictures).to_dict()
            except LimitExceededError as error:
                facts, failed = RunData.load(directory).info.to_dict(), error
    return print_result(printing, facts, _report_lines(directory, facts, page), error=failed)


def _redraw_study(directory, *, pictures):
    """Write the page of a comparison, a study of kernels or a sweep again; the page, and what the
    JSON file beside it holds, or None where the folder holds none of these.
    """
    from rbfmuscle.folders import OutputFolder
    from rbfmuscle.studies import compare, kernels, sweep

    for command, name, page in STUDIES:
        path = directory / name
        if not path.exists():
            continue
        OutputFolder(directory, command, [page])
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
            if command == "compare":
                table = compare.Comparison.model_validate(facts)
                compare.write_page(directory, table, pictures=pictures)
            elif command == "kernels":
                kernels.write_page(directory, kernels.KernelFacts.model_validate(facts))
            else:
                sweep.write_page(directory, sweep.SweepTable.model_validate(facts))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            message = f"{path} is not as it was written ({error!r}); run the command again"
            raise UsageError(message) from None
        return directory / page, facts
    return None


def _report_lines(directory, facts, page):
    from rbfmuscle.cli.verdict import verdict_lines

    if page.name == "report.html":
        yield from [facts["answer"]] if "answer" in facts else verdict_lines(directory)
    yield f"open {page}"
