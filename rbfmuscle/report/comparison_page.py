"""The page of a comparison: what it amounts to, the models moving beside each other, five rows; all
else folded.
"""

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np

from rbfmuscle.experiments.comparison_answer import best_models
from rbfmuscle.experiments.comparison_table import Comparison
from rbfmuscle.experiments.measures import DEEPER, MEASURES
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, unit_text
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.output.appearance import MUSCLE_COLOURS
from rbfmuscle.output.run_data import RunData, moment_arm_coordinates
from rbfmuscle.report.page import (
    BAD,
    GOOD,
    PLAIN,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    limit_state,
)
from rbfmuscle.report.plots import Track, arm_unit, line_plot, motion_axis
from rbfmuscle.report.report import packed_scene

LIGHTS = (DEEPER, "volume_error", "bowing", "return_rms", "time_frame")
_DRAWN = ("penetration_max", "bone_penetration_max", "bowing")
_READING = """All models ran through the same frames and sub-steps, with the same bone fields and
number of threads. The time per frame leaves out the first, which loads and compiles. The
distance to the first model is no error. A mesh model keeps the overlap with bones that its mesh
has at rest; depth beyond rest leaves that out. A law is what every muscle keeps, whatever its
shape: volume, one piece, no bone inside, the same pose there and back."""


def write_page(folder: Path, found: Comparison, *, pictures: bool = True) -> None:
    """Write ``report.html`` of what `write_tables` found to the folder of its runs; raises
    SolveError.
    """
    runs = {found.labels[name]: RunData.load(folder / name) for name in found.models}
    page = _page(found, runs)
    if pictures:
        page.scene = packed_scene(runs)
    else:
        page.missing = "No pictures: they were switched off."
    page.write(folder / "report.html")


def _page(found: Comparison, runs: Mapping[str, RunData]) -> ReportPage:
    first = next(iter(runs.values()))
    failed = [f"{name} did not finish: {reason}" for name, reason in found.failed.items()]
    counts = {"muscles": len(first.muscles), "frames": found.frames, **found.machine}
    # Of the bowing each muscle has a limit of its own.
    limits = first.info.limits | {"bowing": None, DEEPER: first.info.limits.get("penetration_max")}
    terms = [(m.title, m.meaning) for m in MEASURES.values()]
    return ReportPage(
        f"{found.scene}: models compared",
        [f"{counts[what]} {what}" for what in ("muscles", "frames", "threads")],
        " ".join([found.answer, *failed]),
        BAD if failed else PLAIN,
        lights=[_light(found, name, limits.get(name)) for name in LIGHTS if _values(found, name)],
        heads=list(runs),
        sections=[
            Section(
                "Every measure",
                "worst of muscles and frames, best in green",
                table=_measures(found),
            ),
            Section("Mean and standard deviation over the frames", table=_statistics(found)),
            Section("What each model solves for", table=_unknowns(found)),
            Section("Over the motion", plots=_plots(runs)),
            Section("How to read this", text=_READING, terms=terms),
        ],
        footer=", ".join(f"{name} {value}" for name, value in found.versions.items()),
    )


def _values(found: Comparison, quantity: str) -> list[float | None]:
    """A measure of each model over all muscles; empty where none has it."""
    values = [found.results[name][ALL].get(quantity) for name in found.models]
    return values if any(value is not None for value in values) else []


def _light(found: Comparison, quantity: str, limit: float | None) -> CheckRow:
    values = _values(found, quantity)
    cells = [Cell(shown(found, quantity, x), limit_state(quantity, x, limit)) for x in values]
    # A column of limits would be off a phone's screen.
    note = MEASURES[quantity].meaning if limit is None else f"limit {shown(found, quantity, limit)}"
    return CheckRow(MEASURES[quantity].title, cells, note=note)


def shown(found: Comparison, quantity: str, value: float | None) -> str:
    """A value of a measure with its unit; lengths that do not count as zero."""
    measure, unit = MEASURES[quantity], found.measures[quantity].unit
    if value is not None and unit == "mm" and abs(value) < 0.5 * measure.floor:
        value = 0.0
    return shown_number(value, unit)


def _measures(found: Comparison) -> Table:
    rows = []
    for quantity, measure in MEASURES.items():
        if values := _values(found, quantity):
            best, models = best_models(found.results, quantity, found.units), found.models
            states = [
                GOOD if name in best and len(best) < len(models) else PLAIN for name in models
            ]
            texts = [shown(found, quantity, value) for value in values]
            rows.append([Cell(measure.title), Cell(measure.against), *map(Cell, texts, states)])
    return Table(["", "against", *(found.labels[name] for name in found.models)], rows)


def _statistics(found: Comparison) -> Table:
    """Length, moment arms, volume and time of each muscle, mean ± standard deviation."""
    models, rows = found.models, []
    first = found.statistics[models[0]]
    for muscle, quantities in first.items():
        names = ["length", *(name for name in quantities if name.startswith("moment_arm:"))]
        for name in [*names, "volume_error", "time_frame"]:
            quantity, _, about = name.partition(":")
            unit = unit_text(QUANTITIES[quantity][0], found.units)
            texts = []
            for model in models:
                spread = found.statistics[model].get(muscle, {}).get(name)
                pair = [shown_number(x, unit) for x in (spread.mean, spread.sd)] if spread else []
                texts.append(" ± ".join(pair) or "–")
            title = f"{quantity.replace('_', ' ')} {about}".strip()
            rows.append([Cell(muscle), Cell(title), *map(Cell, texts)])
    return Table(["", "", *(found.labels[name] for name in models)], rows)


def _unknowns(found: Comparison) -> Table:
    models = found.models
    rows = [
        [Cell(muscle), *(Cell(found.unknowns[name][muscle]) for name in models)]
        for muscle in found.unknowns[models[0]]
    ]
    return Table(["", *(found.labels[name] for name in models)], rows)


def _plots(runs: Mapping[str, RunData]) -> list[str]:
    """Moment arms, length and depths of each muscle, then the time; a line for each model, no plot
    of constants.
    """
    first, pictures = next(iter(runs.values())), []
    axis, label = motion_axis(first)
    panels: list[tuple[str, str, str, str, str | None]] = [
        (f"Moment arm: {muscle}, {about}", arm_unit(first, about), muscle, "moment_arm", about)
        for muscle in first.muscles
        for about in moment_arm_coordinates(first, muscle)
    ]
    shapes = {"length": ("Length", first.units)} | {
        name: (MEASURES[name].title.capitalize(), "" if MEASURES[name].kind == "1" else first.units)
        for name in _DRAWN
    }
    for quantity, (title, unit) in shapes.items():
        panels += [(f"{title}: {muscle}", unit, muscle, quantity, None) for muscle in first.muscles]
    panels.append(("Time per frame after the first", "s", ALL, "time_frame", None))
    for title, unit, muscle, quantity, about in panels:
        tracks = []
        for (name, run), colour in zip(runs.items(), cycle(MUSCLE_COLOURS)):
            frames, values = run.series(muscle, quantity, about)
            kept = slice(quantity == "time_frame", None)
            if np.isfinite(values[kept]).any():
                tracks.append(
                    Track(name, colour, np.array([axis[k] for k in frames])[kept], values[kept])
                )
        if any(np.ptp(track.y) != 0 for track in tracks):
            pictures.append(line_plot(title, tracks, (label, unit), legend=True))
    return pictures
