"""The report of a run: its verdict, the moving scene, five rows with limits; plots and tables folded."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.metrics.quantities import ALL, QUANTITIES
from rbfmuscle.metrics.summary import LEAST, exceeded, excess, muscle_limit, within
from rbfmuscle.output.animation.moving import read_moving
from rbfmuscle.output.animation.page import pack_runs
from rbfmuscle.output.appearance import motion_direction, muscle_colours, muscle_groups
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.page import (
    BAD,
    GOOD,
    PLAIN,
    Cell,
    Light,
    Page,
    Section,
    definitions,
    embedded_image,
    limit_state,
    number,
    sentence,
    table,
)
from rbfmuscle.report.plots import Track, arm_unit, line_plot, motion_axis
from rbfmuscle.report.render import chosen_frames, draw_preview

# What the rows beside the picture say, and the quantities that each holds to a limit.
LIGHTS = {
    "Keeps its volume": ("volume_error",),
    "Stays out of bones": ("penetration_max", "bone_penetration_max", "initial_overlap", "tunnelled"),
    "Is the scanned shape at rest": ("rest_error_rms", "end_gap"),
    "Is one closed piece": ("components", "euler", "self_crossings", "unfitted_fraction"),
    "Moves without jumps or bowing": ("flicker", "slack"),
}
COUNTS = ("components", "euler", "self_crossings", "tunnelled")
# Title, quantity, factor, unit (None: the scene's), whether it can be of either sign.
PANELS = (
    ("Length", "length", 1.0, None, False),
    ("Activation", "activation", 1.0, "", False),
    ("Volume error", "volume_error", 100.0, "%", True),
    ("Surface inside a bone", "penetration_max", 1.0, None, False),
    ("Bone inside the muscle", "bone_penetration_max", 1.0, None, False),
    ("Edge strain of the carried mesh (RMS)", "edge_strain_rms", 100.0, "%", False),
    ("Time per frame after the first", "time_frame", 1000.0, "ms", False),
)
_MECHANICS = ("length", "activation")
# Below this share of its limit a quantity is flat, and named in place of a plot.
_FLAT = 0.01
# Points of all muscles in all frames that a page holds.
_MOST_POINTS = 2_600_000
# Tables or plots of their own.
_ELSEWHERE = ("volume", "moment_arm", "time_solve", "time_fit", "time_extract")
_READING = """<p>Each muscle is one closed surface in each frame. Depths in bones are exact distances to the bone
meshes; where the model cuts the bone out of the surface, the depth before the cut is given too. A row is amber from
four fifths of its limit. Times are medians, as the first frame may load and compile. Drag to turn the picture, scroll
or pinch to zoom, drag with shift to move it; names below it switch muscles and their lines on and off.</p>"""


def write_report(directory: str | Path, *, pictures: bool = True) -> None:
    """Write ``report.html`` of a saved run, and with ``pictures`` its moving scene and ``preview.webp``.

    Raises
    ------
    SolveError
        If the files cannot be written.
    """
    saved = SavedRun(directory)
    page = _page(saved)
    if not pictures or not saved.has_surfaces():
        why = "they were switched off." if saved.has_surfaces() else "this run kept no surfaces."
        page.missing = f"No pictures: {why}"
    else:
        page.scene = packed_scene({"": saved})
        if len(saved.frames) > 1:
            moving = saved.directory / "preview.webp"
            draw_preview({"": saved}, moving)
            page.picture = embedded_image(moving.read_bytes(), "webp", "the motion")
    page.write(saved.directory / "report.html")


def packed_scene(runs: Mapping[str, SavedRun]) -> str:
    """Runs of one scene as data of a moving picture, of as many frames as a page holds."""
    first = next(iter(runs.values()))
    points = sum(len(run.surface(name, run.frames[0])[0]) for run in runs.values() for name in run.muscles)
    frames = chosen_frames(first.frames, max(2, _MOST_POINTS // max(points, 1)))
    groups = muscle_groups(first.info)
    return pack_runs(
        {title: read_moving(run, frames, unit=run.units) for title, run in runs.items()},
        [first.caption(frame) for frame in frames],
        direction=motion_direction([first.poses[frame] for frame in frames], first.body),
        groups=groups | dict.fromkeys(first.tendons, "tendons") if len(first.muscles) > 1 else {},
        colours=muscle_colours(first.muscles, groups),
    )


def _page(saved: SavedRun) -> Page:
    info = saved.info
    complete = info["status"] == "complete"
    answer, _, detail = info["verdict"].partition(". ")
    if not complete:
        answer, detail = f"the run ended early ({info['status']}): {info['message'] or ''}", ""
    reading = _READING + definitions((n, meaning) for n, (_, meaning) in QUANTITIES.items())
    sections = [
        *_plots(saved),
        Section("Every quantity of every muscle", _summary(saved), "worst over the frames"),
        Section("Neighbours", _neighbours(saved)),
        Section("Events", _events(saved.events), "each with its frame in events.csv"),
        Section("How to read this", reading),
    ]
    return Page(
        info["scene"]["name"],
        _facts(saved),
        sentence(answer),
        BAD if info["beyond"] or not complete else GOOD,
        detail=sentence(detail) if detail else "",
        lights=_lights(saved),
        sections=sections,
        footer=", ".join(f"{name} {value}" for name, value in info["versions"].items()),
    )


def _facts(saved: SavedRun) -> list[str]:
    info = saved.info
    models = sorted({muscle["model"]["name"] for muscle in info["scene"]["muscles"]})
    frame = info.get("frame_time") or {}
    time = f"{number(frame['median'], 's')} per frame" if frame.get("median") else ""
    facts = [
        f"model {', '.join(models)}",
        f"{len(saved.muscles)} muscles",
        f"{len(saved.frames)} frame{'s'[: len(saved.frames) != 1]}",
        time,
        f"{info['times']['wall']:.1f} s in all",
    ]
    return [fact for fact in facts if fact]


def _lights(saved: SavedRun) -> list[Light]:
    """A row for each of `LIGHTS`, then one for whatever else is beyond a limit."""
    muscles, limits = saved.info["muscles"], saved.info["limits"]
    rows = [_light(saved, title, quantities) for title, quantities in LIGHTS.items()]
    known = {quantity for quantities in LIGHTS.values() for quantity in quantities}
    other = {name.partition(":")[0] for _, name, *_ in exceeded(muscles, limits)} - known
    return [row for row in rows if row] + [row for q in sorted(other) if (row := _light(saved, q, (q,)))]


def _light(saved: SavedRun, title: str, quantities: Sequence[str]) -> Light | None:
    """The worst of some quantities against their limits, over muscles and frames."""
    limits, found = saved.info["limits"], []
    for muscle, table_ in saved.info["muscles"].items():
        for name in quantities:
            facts = table_.get(name)
            if facts and limits.get(name) is not None and muscle != ALL:
                worst = math.nan if facts.get("worst") is None else facts["worst"]
                limit = muscle_limit(name, limits[name], table_)
                near = 0.0 if name in COUNTS and within(name, worst, limit) else excess(name, worst, limit)
                found.append((near, muscle, name, worst, facts, limit))
    if not found:
        return None
    _, muscle, name, worst, facts, limit = max(found, key=lambda entry: entry[0])
    unit = facts["unit"]
    sign = "≥" if name in LEAST else "≤"
    state = limit_state(worst, limit, least=name in LEAST, count=name in COUNTS)
    note = f"{name}: {muscle}, frame {facts.get('worst_frame', '–')}".replace("_", " ")
    shown = f"{sign} {limit:.3g}{'' if unit == '1' else ' ' + unit}"
    return Light(
        title, [Cell(number(worst, unit), worst, state)], shown, note if worst else name.replace("_", " ")
    )


def _plots(saved: SavedRun) -> list[Section]:
    """Moment arms and lengths, then what else changes along the motion."""
    axis = motion_axis(saved)
    arms = [
        (f"Moment arm: {name}", "moment_arm", 1.0, arm_unit(saved, name), False, name)
        for name in saved.moment_arm_coordinates()
    ]
    mechanics, errors, flat = [], [], []
    for title, quantity, factor, unit, both, coordinate in [*arms, *((*panel, None) for panel in PANELS)]:
        tracks = _tracks(saved, quantity, factor, axis[0], coordinate)
        if not tracks:
            continue
        limit, greatest = (
            saved.info["limits"].get(quantity),
            max(np.nanmax(np.abs(t.y), initial=0.0) for t in tracks),
        )
        if quantity not in _MECHANICS and not coordinate and greatest <= _FLAT * factor * (limit or 0.0):
            flat.append(f"{title.lower()} at most {greatest:.2g} {saved.units if unit is None else unit}")
            continue
        limits = [] if limit is None else [factor * limit, -factor * limit] if both else [factor * limit]
        labels = axis[1], saved.units if unit is None else unit
        zero = quantity not in ("length", "moment_arm") and not both
        picture = line_plot(title, tracks, labels, limits=limits, zero=zero)
        (mechanics if coordinate or quantity in _MECHANICS else errors).append(picture)
    flat_note = f'<p class="note">Flat over the motion: {"; ".join(flat)}.</p>' if flat else ""
    return [
        Section("Moment arms and lengths", _grid(mechanics)),
        Section("Errors and times over the motion", _grid(errors) + flat_note),
    ]


def _grid(pictures: Sequence[str]) -> str:
    return f'<div class="plots">{"".join(pictures)}</div>' if pictures else ""


def _tracks(
    saved: SavedRun, quantity: str, factor: float, axis: Mapping[int, float], coordinate: str | None
) -> list[Track]:
    """Lines of the muscles in the colours of the picture; of times without the first frame, and all together."""
    colours = muscle_colours(saved.muscles, muscle_groups(saved.info))
    if quantity == "time_frame" and len(saved.muscles) > 1:
        colours[ALL] = "#26282b"
    tracks = []
    for name, colour in colours.items():
        frames, values = saved.series(name, quantity, coordinate)
        if quantity == "time_frame":
            frames, values = frames[1:], values[1:]
        if len(frames) and np.isfinite(values).any():
            tracks.append(Track(name, colour, np.array([axis[frame] for frame in frames]), factor * values))
    return tracks


def _summary(saved: SavedRun) -> str:
    """A row for each muscle, those beyond most limits first."""
    muscles, limits = saved.info["muscles"], saved.info["limits"]
    used = [q for q in QUANTITIES if q not in _ELSEWHERE and any(q in found for found in muscles.values())]
    head = ["muscle"]
    for name in used:
        unit = next(found[name]["unit"] for found in muscles.values() if name in found)
        limit = "" if name not in limits else f" ({'≥' if name in LEAST else '≤'} {limits[name]:g})"
        head.append(f"{name.replace('_', ' ')}{'' if unit == '1' else f' [{unit}]'}{limit}")
    rows: list[tuple[int, list[Cell | str]]] = []
    for muscle, found in muscles.items():
        own = {
            name: muscle_limit(name, limits[name], found) for name in used if name in limits and name in found
        }
        cells = [_cell(name, found.get(name), own.get(name)) for name in used]
        rows.append((-sum(cell.state == BAD for cell in cells), [muscle, *cells]))
    return table(head, [row for _, row in sorted(rows, key=lambda row: row[0])])


def _cell(name: str, facts: Mapping[str, Any] | None, limit: float | None) -> Cell:
    if not facts or facts.get("worst") is None:
        return Cell("–")
    if name in ("length", "edge_strain_rms"):
        return Cell(f"{facts['min']:.4g} … {facts['max']:.4g}", facts["max"])
    if name == "time_frame":
        return Cell(number(facts["median"], "s"), facts["median"])
    state = limit_state(facts["worst"], limit, least=name in LEAST, count=name in COUNTS)
    return Cell(number(facts["worst"]), facts["worst"], BAD if state == BAD else PLAIN)


def _neighbours(saved: SavedRun) -> str:
    """Pairs of muscles that slide on each other, the deepest overlap first."""
    rows: list[list[Cell | str]] = [
        [
            " and ".join(pair["muscles"]),
            Cell(f"{number(pair['overlap_max'])}, frame {pair['overlap_frame']}", pair["overlap_max"]),
            Cell(f"{number(pair['gap_rms'])}, frame {pair['gap_frame']}", pair["gap_rms"]),
        ]
        for pair in saved.info.get("neighbours") or []
    ]
    head = ["pair", f"overlap [{saved.units}]", f"gap opened, RMS [{saved.units}]"]
    return table(head, rows) if rows else ""


def _events(events: Iterable[Sequence[Any]]) -> str:
    """How many events of each kind, the commonest first, and the muscles that have most of them."""
    kinds: dict[str, Counter[str]] = {}
    for event in events:
        kinds.setdefault(event[4], Counter()).update([event[1] or event[2]])
    rows: list[list[Cell | str]] = [
        [kind, Cell(str(n := found.total()), n), ", ".join(f"{name} {k}" for name, k in found.most_common(6))]
        for kind, found in sorted(kinds.items(), key=lambda row: -row[1].total())
    ]
    return table(["event", "how often", "most often"], rows) if rows else ""
