"""Lengths and moment arms of a run next to those of the OpenSim model's own muscle paths."""

from __future__ import annotations

import csv
import html
import io
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfmuscle.opensim.beside import ask_opensim
from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.show.appearance import line_colours
from rbfmuscle.study.show.page import embedded_image
from rbfmuscle.study.show.plots import PLOT_STYLE, arm_unit, motion_axis, wrapped

if TYPE_CHECKING:
    from rbfmuscle.study.files.saved import SavedRun

COLUMNS = ("frame", "coordinate", "muscle", "path", "quantity", "value", "unit")
HEADING = "Beside the model's own paths"
MEANING = (
    "Dashed grey: the muscle paths of the OpenSim model at the same coordinates, by OpenSim, wrapping included. "
    "Lengths begin at 0: a path includes its tendon, our line ends where the mesh does. Moment arms are positive "
    "where the muscle shortens as the coordinate grows. The numbers of the model are in opensim.csv."
)


class ModelPaths(NamedTuple):
    """What OpenSim says of a run's muscles.

    Attributes
    ----------
    frames : list of int
    paths : dict
        Muscle -> muscle of the model -> ``length`` and ``arms`` (see `ask_opensim`).
    notes : list of str
        One line each: what is not shown, and why.
    """

    frames: list[int]
    paths: dict[str, Any]
    notes: list[str]


def model_paths(saved: SavedRun) -> ModelPaths | None:
    """Ask OpenSim for the paths of a run's model, and keep them as ``opensim.csv`` in its folder.

    Returns
    -------
    ModelPaths or None
        None where the scene names no model.
    """
    table = saved.info["scene"].get("opensim")
    if not table:
        return None
    muscles = {name: table["muscles"].get(name, [name]) for name in saved.muscles}
    wanted = {name: saved.arm_coordinates(name) for name in saved.muscles}
    found, reason = ask_opensim(table["model"], saved.units, coordinates_si(saved), muscles, wanted)
    if reason:
        return ModelPaths(saved.frames, {}, [f"The model's own paths are not shown: {reason}."])
    beside = ModelPaths(saved.frames, found["paths"], [f"{note}." for note in found["notes"]])
    _write(saved, beside)
    return beside


def coordinates_si(saved: SavedRun) -> list[dict[str, float]]:
    """Coordinates of every written frame, those that rest included [radian, metre]."""
    scene = saved.info["scene"]
    units, rest = scene.get("coordinate_units", {}), {}
    for joint in scene["joints"]:
        for name in joint.get("coordinates") or joint.get("axes") or {}:
            facts = joint.get("coordinates", {}).get(name, {})
            rest[f"{joint['name']}.{name}"] = facts.get("default", facts.get("rest", 0.0))

    def inner(name, value):
        unit = units.get(name)
        if unit is None:
            return math.radians(value)
        return value * MM_PER_UNIT[saved.units] / 1000.0 if unit.strip() else value

    rows = [{**rest, **frame["coordinates"]} for frame in saved.info["frames"]]
    return [{name: inner(name, value) for name, value in row.items()} for row in rows]


def _write(saved, beside):
    with (saved.directory / "opensim.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for muscle, paths in beside.paths.items():
            for path, facts in paths.items():
                tracks = [("", "length", facts["length"], saved.units)]
                tracks += [(c, "moment_arm", arms, arm_unit(saved, c)) for c, arms in facts["arms"].items()]
                for about, quantity, values, unit in tracks:
                    for frame, value in zip(beside.frames, values):
                        rows.writerow((frame, about, muscle, path, quantity, repr(float(value)), unit))


def beside_section(runs: dict[str, SavedRun]) -> str:
    """The section of a report: panels of each muscle, a line a run, and the model's paths; empty without a model.

    Parameters
    ----------
    runs : dict of str to SavedRun
        Name -> run, all through the same motion.
    """
    first = next(iter(runs.values()))
    beside = model_paths(first)
    if beside is None:
        return ""
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in beside.notes)
    if not beside.paths:
        return f"<h2>{HEADING}</h2>{notes}"
    panels = "".join(
        f"<figure>{embedded_image(data, 'svg+xml', title)}</figure>"
        for title, data in _panels(runs, first, beside)
    )
    legend = "".join(
        f'<span><i style="background:{colour}"></i>{html.escape(name)}</span>'
        for name, colour in line_colours(runs).items()
    )
    head = f'<h2>{HEADING}</h2><p class="note">{MEANING}</p>{notes}<p class="legend">{legend}</p>'
    return f'{head}<div class="plots">{panels}</div>'


def _panels(runs, first, beside):
    import matplotlib

    axis, label = motion_axis(first)
    pictures = []
    with matplotlib.rc_context(PLOT_STYLE):
        for muscle, paths in beside.paths.items():
            own = {name: run.series(muscle, "length") for name, run in runs.items()}
            theirs = {path: facts["length"] for path, facts in paths.items()}
            title = f"Change of length: {muscle}"
            pictures.append(
                (title, _panel(title, own, theirs, beside.frames, (axis, label, first.units), True))
            )
            for about in first.arm_coordinates(muscle):
                own = {name: run.series(muscle, "moment_arm", about) for name, run in runs.items()}
                theirs = {
                    path: facts["arms"][about] for path, facts in paths.items() if about in facts["arms"]
                }
                title, unit = f"Moment arm: {muscle}, {about}", arm_unit(first, about)
                pictures.append(
                    (title, _panel(title, own, theirs, beside.frames, (axis, label, unit), False))
                )
    return pictures


def _panel(title, own, theirs, frames, place, from_first):
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    axis, label, unit = place
    figure = Figure(figsize=(4.6, 2.7), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for path, values in theirs.items():
        values = np.asarray(values) - (values[0] if from_first else 0.0)
        places = [axis[frame] for frame in frames]
        axes.plot(places, values, color="#777777", lw=1.1, ls=(0, (4, 2)))
        axes.annotate(
            path, (places[-1], values[-1]), (2, 0), textcoords="offset points", fontsize=6, color="#777777"
        )
    for name, colour in line_colours(own).items():
        times, values = own[name]
        if len(values):
            values = values - (values[0] if from_first else 0.0)
            axes.plot([axis[frame] for frame in times], values, color=colour, lw=1.6, marker="o", ms=2.0)
    axes.set(title=wrapped(title), xlabel=label, ylabel=unit)
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()
