"""The report of a run."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rbfmuscle.display.animation import pack_runs, read_animation
from rbfmuscle.display.page import (
    BAD,
    GOOD,
    NEAR,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    limit_state,
    number_cell,
)
from rbfmuscle.display.pictures import chosen_frames, render_run
from rbfmuscle.display.plots import Band, Track, arm_unit, line_plot, motion_axis
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, quantity_of
from rbfmuscle.metrics.summary import (
    COUNTS,
    LIMITS,
    LOWER_BOUNDS,
    Limits,
    QuantityFacts,
    limit_ratio,
    meets_limit,
    muscle_limit,
    parse_limits,
    shown_number,
)
from rbfmuscle.metrics.verdict import (
    MOVED,
    Verdict,
    describe_unmeasured,
    published_band,
    require_limits,
    verdict_facts,
    verdict_parts,
)
from rbfmuscle.run.data import RunData, moment_arm_coordinates
from rbfmuscle.run.info import RunInfo
from rbfmuscle.run.writer import PAGES, run_folder, write_json
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Event
from rbfmuscle.validation import UsageError

# What the rows beside the picture say, and the quantities that each holds to a limit.
LIGHTS = {
    "Keeps its volume": ("volume_error",),
    "Stays out of bones": (
        "penetration_max",
        "bone_penetration_max",
        "initial_overlap",
        "tunnelled",
    ),
    "Stays out of other muscles": ("neighbour_overlap_max",),
    "Is the scanned shape at rest": ("rest_error_rms",),
    "Is one closed piece": (
        "components",
        "euler_characteristic",
        "self_crossings",
        "unfitted_fraction",
    ),
    "Moves without jumps or bowing": ("flicker", "bowing"),
}
# Title, quantity, factor, unit (None: the scene's).
PANELS = (
    ("Length", "length", 1.0, None),
    ("Activation", "activation", 1.0, ""),
    ("Volume error", "volume_error", 100.0, "%"),
    ("Surface inside a bone", "penetration_max", 1.0, None),
    ("Bone inside the muscle", "bone_penetration_max", 1.0, None),
    ("Edge strain of the material mesh (RMS)", "edge_strain_rms", 100.0, "%"),
    ("Time per frame after the first", "time_frame", 1000.0, "ms"),
)
MOST_DOUBTS = 6  # that a page names
# Points of all muscles in all frames that a page holds.
_MOST_POINTS = 2_600_000
# Tables or plots of their own.
_ELSEWHERE = ("volume", "moment_arm", "time_solve", "time_fit", "time_extract")
_READING = """Depths in bones are exact distances to the bone meshes. A row is amber from 80 % of
its limit on. Times are medians, as the first frame may load and compile. Drag to turn the
picture, scroll or pinch to zoom, drag with shift to move it; names below it switch muscles and
their lines on and off."""


def write_report(directory: str | Path, *, pictures: bool = True) -> None:
    """Write a saved run's ``report.html``, with ``pictures`` a moving scene and ``preview.webp``;
    raises SolveError.
    """
    directory = Path(directory)
    saved = RunData.load(directory)
    if not pictures or not saved.has_surfaces:
        page = _page(saved)
        why = "they were switched off." if saved.has_surfaces else "this run kept no surfaces."
        page.missing = f"No pictures: {why}"
    else:
        pages: list[ReportPage] = []
        scenes: list[str] = []

        def draw_preview() -> None:
            if len(saved.frames) > 1:
                file = directory / "preview.webp"
                render_run(saved, file, views=["motion"], area=110_000, most=12, seconds=4.0)

        # Plots take the interpreter's lock, and pictures and packing leave it.
        each(
            lambda draw: draw(),
            [
                draw_preview,
                lambda: scenes.append(packed_scene({"": saved})),
                lambda: pages.append(_page(saved)),
            ],
        )
        page = pages[0]
        page.scene = scenes[0]
    page.write(directory / "report.html")


def packed_scene(runs: Mapping[str, RunData]) -> str:
    """Runs of one scene as data of a moving picture, of as many frames as a page holds."""
    first = next(iter(runs.values()))
    points = sum(
        len(run.mesh(name, run.frame_numbers[0])[0])
        for run in runs.values()
        for name in run.muscles
    )
    frames = chosen_frames(first.frame_numbers, max(2, _MOST_POINTS // max(points, 1)))
    return pack_runs(
        {
            title: read_animation(run, run.muscles, frames, unit=run.units)
            for title, run in runs.items()
        }
    )


def _page(saved: RunData) -> ReportPage:
    info = saved.info
    complete = info.status == "complete"
    answer, parts = info.outcome, {}
    if complete:
        verdict = Verdict(answer, info.beyond, info.not_measured, info.doubts)
        table = saved.summarise()
        parts = verdict_parts(verdict, table, info.scene.missing_bones, doubts=MOST_DOUBTS)
    else:
        answer = f"the run ended early ({info.status}): {info.message or ''}"
    return ReportPage(
        info.scene.name,
        _facts(saved),
        f"{answer[:1].upper()}{answer[1:].rstrip('.')}.",
        GOOD if complete and not (info.beyond or info.not_measured) else BAD,
        detail=" ".join(
            f"{head}: {'; '.join(texts).rstrip('.')}." for head, texts in parts.items()
        ),
        lights=_lights(saved),
        sections=[
            *_plots(saved),
            Section(
                "Every quantity of every muscle", "worst over the frames", table=_summary(saved)
            ),
            Section("Events", "each with its frame in events.csv", text=_events(saved.events)),
            Section(
                "How to read this",
                text=_READING,
                terms=[(name, text) for name, (_, text) in QUANTITIES.items()],
            ),
        ],
        footer=", ".join(f"{name} {value}" for name, value in info.versions.items()),
    )


def _facts(saved: RunData) -> list[str]:
    info = saved.info
    models = sorted({muscle.model.name for muscle in info.scene.muscles})
    median = (info.frame_time or {}).get("median")
    numbers = {"muscle": len(saved.muscles), "frame": len(saved.frames)}
    counts = [f"{number} {word}{'' if number == 1 else 's'}" for word, number in numbers.items()]
    whole = info.scene.motion.whole or 0
    if whole > len(saved.frames):
        counts[1] += f" of the motion's {whole}"
    times = [f"{shown_number(median, 's')} per frame", f"{info.times['wall']:.1f} s in all"]
    kernels = sorted(set(info.kernels.values()))
    kernel = [f"kernel{'s' if len(kernels) > 1 else ''} {', '.join(kernels)}"] if kernels else []
    return [f"model {', '.join(models)}", *kernel, *counts, *times]


def _lights(saved: RunData) -> list[CheckRow]:
    """A row for each of `LIGHTS`, then one for whatever else is beyond a limit."""
    known = {quantity for quantities in LIGHTS.values() for quantity in quantities}
    limits = Limits(saved.info.limits, saved.info.fail_on)
    missing = saved.info.not_measured
    beyond = {quantity_of(row.quantity) for row in saved.info.beyond}
    other = sorted((beyond | set(limits.fail_on)) - known)
    named = LIGHTS | {name: (name,) for name in other}
    rows = [_light(saved, limits, title, quantities) for title, quantities in named.items()]
    found = [row for row in (*rows, _overlap_light(saved)) if row]
    if missing:
        found.append(
            CheckRow(
                "Not measured", [Cell(str(len(missing)), BAD)], "", describe_unmeasured(missing)
            )
        )
    return found


def _light(
    saved: RunData, limits: Limits, title: str, quantities: Sequence[str]
) -> CheckRow | None:
    """The worst of some quantities against their limits, over muscles and frames."""
    found = []
    for muscle, table in saved.info.muscles.items():
        for name in quantities:
            facts = table.get(name)
            if facts and name in limits.values and muscle != ALL:
                value = facts.get("worst")
                worst = math.nan if value is None else value
                limit = muscle_limit(name, limits, table)
                near = (
                    0.0
                    if name in COUNTS and meets_limit(name, worst, limit)
                    else limit_ratio(name, worst, limit)
                )
                found.append((near, muscle, name, worst, facts, limit))
    if not found:
        return None
    _, muscle, name, worst, facts, limit = max(found, key=lambda entry: entry[0])
    unit = facts["unit"]
    note = LIMITS[name].title if name in LIMITS else name
    if note.replace(" ", "_") != name:
        note = f"{note} ({name})"  # its name in ``metrics.csv``
    if worst:
        note += f": {muscle.replace('_', ' ')}, frame {facts.get('worst_frame', '–')}"
    sign = "≥" if name in LOWER_BOUNDS else "≤"
    return CheckRow(
        title,
        [number_cell(worst, unit, limit_state(name, worst, limit))],
        limit=f"{sign} {limit:.3g}{'' if unit == '1' else ' ' + unit}",
        note=note,
    )


def _overlap_light(saved: RunData) -> CheckRow | None:
    """How far muscles are moved at rest beside overlaps with bones, which is a doubt about the
    scan; None where there are none.
    """
    name = "rest_error_at_overlap"
    moved = {
        muscle: value
        for muscle, table in saved.info.muscles.items()
        if (value := table.get(name, {}).get("first")) is not None
    }
    if not moved:
        return None
    muscle = max(moved, key=moved.__getitem__)
    most = from_mm(MOVED, saved.units)
    return CheckRow(
        "Overlaps no bone in the scan",
        [number_cell(moved[muscle], saved.units, GOOD if moved[muscle] <= most else NEAR)],
        limit=f"doubt > {most:.3g} {saved.units}",
        note=f"rest error beside overlaps ({name}): {muscle.replace('_', ' ')}",
    )


def _plots(saved: RunData) -> list[Section]:
    """Moment arms and lengths, then what else changes along the motion."""
    axis, label = motion_axis(saved)
    mechanics, errors = "Moment arms and lengths", "Errors and times over the motion"
    plots: dict[str, list[str]] = {mechanics: [], errors: []}
    about = moment_arm_coordinates(saved)
    arms = [
        (f"Moment arm: {name}", "moment_arm", 1.0, arm_unit(saved, name), name) for name in about
    ]
    for title, quantity, factor, unit, coordinate in [*arms, *((*panel, None) for panel in PANELS)]:
        tracks = _tracks(saved, quantity, factor, axis, coordinate)
        if tracks:
            unit, limit = saved.units if unit is None else unit, saved.info.limits.get(quantity)
            signed = any(np.nanmin(track.y) < 0.0 for track in tracks)
            limits = [factor * limit, -factor * limit][: 1 + signed] if limit else []
            zero = quantity != "length" and not signed
            group = mechanics if quantity in ("length", "activation", "moment_arm") else errors
            bands = []
            if coordinate:
                bands = _bands(tracks, coordinate, label, saved)
            text = line_plot(title, tracks, (label, unit), limits=limits, zero=zero, bands=bands)
            plots[group].append(text)
    hints = {
        mechanics: "shaded: 5th to 95th percentile of the fibres, where they are followed; dashed: "
        "published moment arms, where names match"
    }
    return [
        Section(title, hints.get(title, ""), plots=found, opened=title == mechanics)
        for title, found in plots.items()
    ]


def _bands(tracks: Sequence[Track], coordinate: str, label: str, saved: RunData) -> list[Band]:
    """Moment arms of the fibres of the tracks' muscles, from the 5th to the 95th percentile, and
    published ones about a coordinate that alone moves.
    """
    bands = []
    for track in tracks:
        low, high = (
            saved.series(track.name, f"fibre_moment_arm_{end}", coordinate)[1]
            for end in ("p05", "p95")
        )
        if len(low) == len(track.x):
            bands.append(Band(track.name, track.colour, track.x, low, high))
    for track in tracks:
        known = published_band(track.name, coordinate)
        if known is not None and label.startswith(coordinate):
            scale = from_mm(1.0, saved.units)
            ends = scale * known.least, scale * known.greatest
            bands.append(Band(track.name, track.colour, known.angle, *ends, dashed=True))
    return bands


def _tracks(
    saved: RunData, quantity: str, factor: float, axis: Mapping[int, float], coordinate: str | None
) -> list[Track]:
    """Lines of the muscles in the colours of the picture; of times without the first frame, and all
    together.
    """
    tracks = []
    several = quantity == "time_frame" and len(saved.muscles) > 1
    together = {ALL: "#26282b"} if several else {}
    for name, colour in (saved.colours | together).items():
        frames, values = saved.series(name, quantity, coordinate)
        if quantity == "time_frame":
            frames, values = frames[1:], values[1:]
        if len(frames) and np.isfinite(values).any():
            tracks.append(
                Track(name, colour, np.array([axis[frame] for frame in frames]), factor * values)
            )
    return tracks


def _summary(saved: RunData) -> Table:
    """A row for each muscle, those beyond most limits first."""
    muscles = saved.info.muscles
    values = saved.info.limits
    limits = Limits(values, saved.info.fail_on)
    used = [
        q
        for q in QUANTITIES
        if q not in _ELSEWHERE and any(q in found for found in muscles.values())
    ]
    head = ["muscle"]
    for name in used:
        unit = next(found[name]["unit"] for found in muscles.values() if name in found)
        limit = (
            ""
            if name not in values
            else f" ({'≥' if name in LOWER_BOUNDS else '≤'} {values[name]:g})"
        )
        head.append(f"{name.replace('_', ' ')}{'' if unit == '1' else f' [{unit}]'}{limit}")
    rows = [
        [Cell(name), *(_cell(q, found, limits) for q in used)] for name, found in muscles.items()
    ]
    return Table(head, sorted(rows, key=lambda row: -sum(cell.state == BAD for cell in row)))


def _cell(name: str, found: Mapping[str, QuantityFacts], limits: Limits) -> Cell:
    facts = found.get(name)
    if not facts or facts.get("worst") is None:
        return Cell("–")
    if name in ("length", "edge_strain_rms"):
        return Cell(f"{facts['min']:.4g} … {facts['max']:.4g}")
    if name == "time_frame":
        return number_cell(facts["median"], "s")
    limit = muscle_limit(name, limits, found) if name in limits.values else math.inf
    limit = limit if math.isfinite(limit) else None
    state = limit_state(name, facts["worst"], limit)
    cell = number_cell(facts["worst"], state=state) if state == BAD else number_cell(facts["worst"])
    own = limit is not None and limit != limits.values[name]
    return cell._replace(text=f"{cell.text} (≤ {limit:.3g})") if own else cell


def _events(events: Sequence[Event]) -> str:
    """How many events of each kind, the commonest first, and the muscles that have most of them."""
    kinds: dict[str, Counter[str]] = {}
    for event in events:
        kinds.setdefault(event.action, Counter()).update([event.muscle or event.bone])
    texts = []
    for kind, found in sorted(kinds.items(), key=lambda row: -row[1].total()):
        most = ", ".join(f"{name} {count}" for name, count in found.most_common(6))
        texts.append(f"{kind}: {found.total()} ({most}).")
    return " ".join(texts)


def redraw_run(
    directory: str | Path, *, fail_on: str | None = None, pictures: bool = True
) -> RunInfo:
    """Hold a saved run to limits again and write its pages; what ``run.json`` then holds.

    ``fail_on`` are limits as for `parse_limits`, those that the run had where not given;
    ``pictures`` are those of the report and the preview.

    Raises
    ------
    UsageError
        If the folder holds no run that has ended, or a file that is not the run's is in the way.
    LimitExceededError
        If a limit of ``fail_on`` is exceeded, or was not measured; everything is written.
    """
    directory = Path(directory)
    saved = RunData.load(directory)
    info = saved.info
    if info.status == "running":
        raise UsageError(f"{directory} holds a run that has not ended; run the scene again")
    folder = run_folder(directory)
    texts = [name if value is None else f"{name}={value!r}" for name, value in info.fail_on.items()]
    limits = parse_limits(texts if fail_on is None else fail_on, Scene(units=saved.units))
    table = saved.summarise()
    scene, stopped = info.scene, ""
    if info.status == "failed" and info.frames:
        stopped = f"{len(info.frames)} of {scene.motion.frames}"
    facts = verdict_facts(table, limits, info.doubts, scene.missing_bones, stopped=stopped)
    info = info.model_copy(update=facts)
    drawn = pictures and saved.has_surfaces and len(saved.frames) > 1
    folder.add(*(PAGES if drawn else PAGES[:1]))
    write_json(directory / "run.json", info.to_dict())
    write_report(directory, pictures=pictures)
    require_limits(table, limits)
    return info
