"""The page of a comparison: what it amounts to, the models moving beside each other, five rows; all else folded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.experiments.comparison import MEASURES, best_models
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.output.appearance import MUSCLE_COLOURS
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.page import (
    BAD,
    GOOD,
    PLAIN,
    Cell,
    Light,
    Page,
    Section,
    Table,
    embedded_image,
    limit_state,
)
from rbfmuscle.report.plots import Track, arm_unit, line_plot, motion_axis
from rbfmuscle.report.render import draw_preview
from rbfmuscle.report.report import COUNTS, packed_scene

LIGHTS = ("volume_error", "penetration_max", "bone_penetration_max", "return_rms", "time_frame")
Series = tuple[Integers, Floats]
# Pixels of a picture of one model, and of all together.
_AREA, _WHOLE = 90_000, 400_000
_READING = """All models ran through the same frames and sub-steps, one after another with the same bone fields and
number of threads. The time per frame is the wall time of prediction, solution, contacts and surface of all muscles,
without the first frame, which loads and compiles. The distance to the first model is no error: it says how far models
differ."""


def write_page(folder: Path, found: dict[str, Any], *, pictures: bool = True) -> None:
    """Write ``report.html`` and ``models.webp``.

    Parameters
    ----------
    folder : pathlib.Path
        With a run of each model.
    found : dict
        From `rbfmuscle.experiments.comparison.write_tables`.
    pictures : bool

    Raises
    ------
    SolveError
        If a file cannot be written.
    """
    runs = {name: SavedRun(folder / name) for name in found["models"]}
    page = _page(found, runs)
    if pictures:
        moving = folder / "models.webp"
        labelled = {found["labels"][name]: run for name, run in runs.items()}
        draw_preview(labelled, moving, area=min(_AREA, _WHOLE / len(runs)))
        page.scene = packed_scene(labelled)
        page.picture = embedded_image(moving.read_bytes(), "webp")
    else:
        page.missing = "No pictures: they were switched off."
    page.write(folder / "report.html")


def _page(found: dict[str, Any], runs: Mapping[str, SavedRun]) -> Page:
    machine = found["machine"]
    failed = [f"{name} did not finish: {reason}" for name, reason in found["failed"].items()]
    return Page(
        f"{found['scene']}: models compared",
        [
            f"{len(next(iter(runs.values())).muscles)} muscles",
            f"{found['frames']} frames",
            f"{machine['threads']} threads",
        ],
        " ".join([found["answer"], *failed]),
        BAD if failed else PLAIN,
        lights=[light for quantity in LIGHTS if (light := _light(found, runs, quantity))],
        heads=[found["labels"][name] for name in found["models"]],
        sections=[
            Section(
                "Every measure", "worst over muscles and frames; the best in green", table=_measures(found)
            ),
            Section("Over the motion", plots=_plots(found, runs)),
            Section(
                "How to read this", text=_READING, terms=[(m.title, m.meaning) for m in MEASURES.values()]
            ),
        ],
        footer=", ".join(f"{name} {value}" for name, value in found["versions"].items()),
        layout="below",
    )


def _light(found: dict[str, Any], runs: Mapping[str, SavedRun], quantity: str) -> Light | None:
    limit = next(iter(runs.values())).info["limits"].get(quantity)
    cells = []
    for name in found["models"]:
        value = found["results"][name][ALL].get(quantity)
        state = PLAIN if value is None else limit_state(value, limit, count=quantity in COUNTS)
        cells.append(Cell(shown(found, quantity, value), value, state))
    if all(cell.value is None for cell in cells):
        return None
    # A column of limits would be off a phone's screen.
    note = MEASURES[quantity].meaning if limit is None else f"limit {shown(found, quantity, limit)}"
    return Light(MEASURES[quantity].title, cells, note=note)


def shown(found: dict[str, Any], quantity: str, value: float | None) -> str:
    """A value of a measure with its unit; lengths that do not count as zero."""
    measure, unit = MEASURES[quantity], found["measures"][quantity]["unit"]
    if value is not None and unit == "mm" and abs(value) < 0.5 * measure.floor:
        value = 0.0
    return shown_number(value, unit)


def _measures(found: dict[str, Any]) -> Table:
    rows = []
    for quantity, measure in MEASURES.items():
        values = [found["results"][name][ALL].get(quantity) for name in found["models"]]
        if all(value is None for value in values):
            continue
        good = best_models(found["results"], quantity, found["units"])
        good = [] if len(good) == len(values) else good
        cells = [
            Cell(shown(found, quantity, value), value, GOOD if name in good else PLAIN)
            for name, value in zip(found["models"], values)
        ]
        rows.append([Cell(measure.title), Cell(measure.against), *cells])
    return Table(["", "against", *(found["labels"][name] for name in found["models"])], rows)


def _plots(found: dict[str, Any], runs: Mapping[str, SavedRun]) -> list[str]:
    """Moment arms and lengths of each muscle, then the worst over muscles and the time, a line for each model."""
    first = next(iter(runs.values()))
    panels: list[tuple[str, str, Callable[[SavedRun], Series]]] = []
    for muscle in first.muscles:
        for about in first.moment_arm_coordinates(muscle):
            arms = partial(SavedRun.series, muscle=muscle, quantity="moment_arm", coordinate=about)
            panels.append((f"Moment arm: {muscle}, {about}", arm_unit(first, about), arms))
    for muscle in first.muscles:
        lengths = partial(SavedRun.series, muscle=muscle, quantity="length")
        panels.append((f"Length: {muscle}", first.units, lengths))
    for quantity in LIGHTS[1:3]:
        worst = partial(worst_series, quantity=quantity)
        panels.append((f"{MEASURES[quantity].title}, worst muscle", first.units, worst))
    panels.append(("Time per frame after the first", "s", _times))
    pictures = [_model_plot(found, runs, *panel) for panel in panels]
    return [picture for picture in pictures if picture]


def _model_plot(
    found: dict[str, Any],
    runs: Mapping[str, SavedRun],
    title: str,
    unit: str,
    series: Callable[[SavedRun], Series],
) -> str:
    """A line for each model, nothing where all are constant."""
    axis, label = motion_axis(next(iter(runs.values())))
    tracks = []
    for (name, run), colour in zip(runs.items(), cycle(MUSCLE_COLOURS)):
        frames, values = series(run)
        if np.isfinite(values).any():
            places = np.array([axis[frame] for frame in frames])
            tracks.append(Track(found["labels"][name], colour, places, values))
    constant = all(np.ptp(track.y) == 0 for track in tracks)
    return "" if constant else line_plot(title, tracks, (label, unit), legend=True)


def _times(run: SavedRun) -> Series:
    frames, values = run.series(ALL, "time_frame")
    return frames[1:], values[1:]


def worst_series(run: SavedRun, quantity: str) -> Series:
    """Frames, and of each frame the value of greatest magnitude among the muscles."""
    found = [series for muscle in run.muscles if len((series := run.series(muscle, quantity))[0])]
    if not found:
        return np.zeros(0, dtype=int), np.zeros(0)
    values = np.array([values for _, values in found])
    return found[0][0], values[np.argmax(np.abs(values), axis=0), np.arange(values.shape[1])]
