"""Models compared on one scene: the same motion, contacts and measures for each; tables, a page."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import BaseModel

from rbfmuscle.display.page import (
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
from rbfmuscle.display.plots import Track, arm_unit, line_plot, motion_axis
from rbfmuscle.display.report import packed_scene
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.threads import cores_limited, threads_limited
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.metrics.quantities import ALL, quantity_of, split_name, unit_text
from rbfmuscle.metrics.summary import LIMITS, QuantityFacts, shown_number
from rbfmuscle.models import (
    build_models,
    configure_scene,
    model_kind,
    model_title,
    solved_points,
)
from rbfmuscle.progress import stage
from rbfmuscle.recording import Run, stream_run
from rbfmuscle.run.appearance import MUSCLE_COLOURS
from rbfmuscle.run.data import RunData, as_table, csv_rows, moment_arm_coordinates
from rbfmuscle.run.writer import machine, run_folder, versions, write_csv, write_json
from rbfmuscle.scene.frames import pick_frames
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.options import OutputOptions
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import Scene, require_complete
from rbfmuscle.scene.settings import chooses_model
from rbfmuscle.simulation.frame import Mesh
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.studies.result import OnProgress, Study, part_progress, study_folder
from rbfmuscle.validation import SolveError, UsageError, listed

FILES = ("comparison.json", "comparison.csv", "statistics.csv", "report.html")
COARSER = 5  # the motion is repeated with frames this many times as far apart
FINER = 4  # and its last pose with sub-steps this many times as short, which every model solves by
ONE_THREAD = 5  # frames that are timed on one thread, the first of which does not count


def compare(
    scene: Scene | str | Path,
    directory: str | Path | None = None,
    *,
    models: Sequence[str] = ("rbf", "pbd"),
    settings: Mapping[str, object] | None = None,
    frames: slice | str | None = None,
    jobs: int | None = None,
    pictures: bool = True,
    progress: OnProgress | None = None,
) -> Comparison:
    """Run every model on a scene, measure all alike, and write tables, a report and pictures.

    Parameters
    ----------
    scene : Scene, path or "phantom"
    directory : path, optional
        Takes ``comparison.json``, tables, ``report.html`` and the run of each model.
    models : list of str
        Distances are to the first. One that cannot be solved is left out, and named in the tables.
    settings : mapping, optional
        Dotted keys with their values, for all models, or as "MODEL:KEY" for one.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    jobs : int, optional
        Cores to use, all by default.
    pictures : bool
        Whether the report has them.
    progress : callable, optional
        Called as ``progress(done, total)`` after each frame of each model.

    Returns
    -------
    Comparison
        What ``comparison.json`` holds, with ``table()``, ``save(directory)`` and ``show()``.

    Raises
    ------
    UsageError
        On an unknown model or setting, or a folder that holds something else.
    SolveError
        If no model could be solved.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> scene = phantom_scene(end=2.0, spacing=6.0)
    >>> found = compare(scene, models=["pbd", "xpbd"], pictures=False)
    >>> found.models, found.table()["value"].dtype
    (['pbd', 'xpbd'], dtype('float64'))
    """
    variants = _variants(open_scene(scene), list(models), settings or {}, frames)
    first = next(iter(variants.values()))
    last = len(first.motion) - 1
    poses = [int(first.motion.numbers[k]) for k in sorted({0, last // 2, last})]
    with cores_limited(jobs), study_folder(directory) as folder:
        output = OutputFolder(folder, "compare", FILES)
        for name in variants:
            run_folder(folder / name)
        output.clear()
        output.add(*FILES)
        results: dict[str, Values] = {}
        failed: dict[str, str] = {}
        for k, (name, variant) in enumerate(variants.items()):
            length = len(first.motion)
            count = part_progress(progress, k * length, len(variants) * length)
            try:
                with stage(name):
                    results[name] = _measure(name, variant, folder / name, count)
            except SolveError as error:
                failed[name] = str(error)
        if not results:
            raise SolveError("; ".join(f"{name}: {reason}" for name, reason in failed.items()))
        with stage("distances between models"):
            add_distances(results, folder, poses)
        table = write_tables(folder, variants, results, failed, poses)
        with stage("drawing pictures" if pictures else "writing the report"):
            write_page(folder, table, pictures=pictures)
        return table.kept_in(folder, own=directory is None)


def _variants(scene, models, settings, frames):
    """The scene for each model; every name and setting is checked before anything is run."""
    if len(models) < 2 or len(set(models)) < len(models):
        raise UsageError(f"give two or more different models, got {', '.join(models) or 'none'}")
    for name in models:
        model_kind(name)
    for key in settings:
        model = key.rpartition(":")[0]
        if model and model not in models:
            raise UsageError(f"{key}: model {model!r} is not compared; models: {', '.join(models)}")
        if model and key.removeprefix(f"{model}:").startswith("motion."):
            raise UsageError(f"{key}: all models have the same motion; leave out {model}:")
    variants = {}
    for name in models:
        mine = {
            k.rpartition(":")[2]: v
            for k, v in settings.items()
            if k.rpartition(":")[0] in ("", name)
        }
        # As in the scene file, a model given for all is the model whose settings these are; each
        # then takes its turn.
        whole = {key: value for key, value in mine.items() if chooses_model(key)}
        own = {key: value for key, value in mine.items() if not chooses_model(key)}
        variant = configure_scene(scene, whole).with_options(model=name)
        variants[name] = require_complete(configure_scene(variant, own, frames=frames))
        variants[name].output = OutputOptions(report=False)
    return variants


def _measure(name, scene, folder, progress):
    """One model: compile its loops, run, then there and back by fewer frames, and to the last pose
    by shorter sub-steps.
    """
    last = len(scene.motion) - 1
    _surfaces(scene, [*range(min(last, 1) + 1)])
    stream_run(scene, folder, pictures=False, progress=progress)
    coarse = [*range(0, last, COARSER)]
    with stage(f"{name}: there and back"):
        build, shown, _ = _surfaces(scene, [*coarse, last, *coarse[::-1]])
    with stage(f"{name}: by shorter sub-steps"):
        angle = scene.contact.substep_angle / FINER
        finer = scene.with_options({"contact.substep_angle": angle})
        turn = _surfaces(finer, [*coarse, last])[1][-1]
    with stage(f"{name}: on one thread"), threads_limited(1):
        walls = _surfaces(scene, [*range(min(last + 1, ONE_THREAD))])[2]
    with stage(f"{name}: measuring"):
        return measure_run(
            RunData.load(folder),
            build=build,
            one_thread=float(np.median(walls[1:] or walls)),
            turn=turn if coarse else None,
            end=shown[-1] if coarse else None,
        )


def _surfaces(scene, chosen):
    """Time to build the models, the surfaces of all muscles in frames of these numbers, in this
    order, and the wall time of each frame.
    """
    changed = scene.with_options()
    changed.motion = pick_frames(scene.motion, chosen)
    start = time.perf_counter()
    models = build_models(changed)
    build = time.perf_counter() - start
    frames = list(simulate_frames(changed, models))
    surfaces = [
        {name: (s.vertices, s.faces) for name, s in frame.surfaces.items()} for frame in frames
    ]
    return build, surfaces, [frame.wall for frame in frames]


LAW = "law"
MESH = "input mesh"
FIRST = "first model"
COST = "cost"


@dataclass(frozen=True)
class Measure:
    """A row of the table.

    ``unit`` is ``"1"``, ``"s"``, or of lengths the scene's, in `MEASURES` ``"length"``; ``against``
    says what a value is an error of or against; a value is better the smaller its distance from
    ``ideal``, and differences of less than ``floor`` (millimetres for lengths) do not count.
    """

    title: str
    unit: str
    against: str
    floor: float
    meaning: str
    ideal: float = 0.0


DEEPER = "depth_beyond_rest"
_ROWS: dict[str, tuple] = {
    "volume_error": ("volume error", "1", LAW, 1e-5, "relative to the input mesh"),
    DEEPER: ("depth beyond rest", "length", LAW, 0.02, "of muscle or bone, less that at rest"),
    "penetration_max": ("surface in a bone", "length", LAW, 0.02, "deepest vertex"),
    "bone_penetration_max": ("bone in the muscle", "length", LAW, 0.02, "deepest bone vertex"),
    "solver_penetration_max": ("depth after the solve", "length", LAW, 0.02, "contact points"),
    "neighbour_overlap_max": ("muscles overlap", "length", LAW, 0.02, "depth beyond that at rest"),
    "neighbour_gap": ("gap of muscles", "length", LAW, 0.1, "where they touched at rest, 95 %"),
    "initial_overlap": ("overlap left at rest", "length", LAW, 0.02, "of muscle and bones"),
    "bowing": ("bowing", "1", LAW, 0.005, "centreline over shortest path", 1.0),
    "components": ("pieces", "1", LAW, 0.0, "connected pieces, most in any frame"),
    "euler_characteristic": (
        "Euler characteristic",
        "1",
        LAW,
        0.0,
        "2; two less for a handle",
        2.0,
    ),
    "self_crossings": ("self-crossings", "1", LAW, 0.0, "triangles that cross others"),
    "unfitted_fraction": ("surface not fitted", "1", LAW, 1e-4, "share of vertices off the field"),
    "flicker": ("flicker", "length", LAW, 0.05, "off the material mesh, change between frames"),
    "tunnelled": ("tunnelled points", "1", LAW, 0.0, "points beyond a bone"),
    "return_rms": ("return error (RMS)", "length", LAW, 0.02, "first pose, there and back"),
    "return_max": ("return error (greatest)", "length", LAW, 0.1, "greatest distance"),
    "step_rms": (
        "step dependence (RMS)",
        "length",
        LAW,
        0.02,
        "last pose by shorter sub-steps",
    ),
    "step_max": ("step dependence (greatest)", "length", LAW, 0.1, "greatest distance"),
    "rest_error_rms": ("rest error (RMS)", "length", MESH, 0.02, "surface to mesh at rest"),
    "rest_error_max": ("rest error (greatest)", "length", MESH, 0.1, "greatest distance"),
    "rest_error_at_overlap": ("rest beside overlaps", "length", MESH, 0.1, "within 10 mm of them"),
    "distance_rms": ("distance (RMS)", "length", FIRST, 0.0, "to the first's, worst pose"),
    "distance_max": ("distance (greatest)", "length", FIRST, 0.0, "greatest distance"),
    "length_rms": ("length (RMS)", "length", FIRST, 0.0, "difference over the frames"),
    "moment_arm_rms": ("moment arm (RMS)", "length", FIRST, 0.0, "difference over the frames"),
    "time_frame": ("time per frame", "s", COST, 0.0, "median of all muscles, with surfaces"),
    "time_frame_p95": ("time per frame (95 %)", "s", COST, 0.0, "exceeded by one in 20"),
    "time_one_thread": ("time on one thread", "s", COST, 0.0, "median of the first frames"),
    "time_build": ("time to build", "s", COST, 0.0, "all muscles, once, with filled caches"),
}
MEASURES = {name: Measure(*row) for name, row in _ROWS.items()}
FROM_METRICS = [name for name, m in MEASURES.items() if m.against in (LAW, MESH) and name != DEEPER]
# Quantities whose means and standard deviations are written, and those that the page shows.
STATISTICS = (*FROM_METRICS, "length", "moment_arm")
_STATISTICS_SHOWN = ("length", "moment_arm", "volume_error")


# Values by muscle, "all" included, and quantity.
Values = dict[str, dict[str, float]]


class Comparison(BaseModel, Study):
    """What ``comparison.json`` holds.

    ``poses`` are the numbers of the frames at which distances were measured, ``labels`` models as
    tables name them, ``failed`` why models were not solved, ``answer`` all of it in sentences,
    ``within`` how many muscles of each model are within all limits, ``unknowns`` the points that
    each model solves for, in words, by model and muscle. ``results`` are by model.
    """

    command: ClassVar[str] = "compare"
    page: ClassVar[str] = "report.html"

    format: int
    scene: str
    units: str
    frames: int
    poses: list[int]
    models: list[str]
    labels: dict[str, str]
    failed: dict[str, str]
    answer: str
    within: dict[str, int] = {}
    unknowns: dict[str, dict[str, str]]
    measures: dict[str, Measure]
    results: dict[str, Values]
    machine: dict[str, str | int | None]
    versions: dict[str, str]

    def table(self) -> np.ndarray:
        """Every value as a structured ndarray, with the columns of ``comparison.csv``."""
        rows = [
            (model, muscle, name, values[name], measure.unit, measure.against)
            for model, muscles in self.results.items()
            for muscle, values in muscles.items()
            for name, measure in self.measures.items()
            if name in values
        ]
        names = ("model", "muscle", "quantity", "value", "unit", "against")
        return as_table(dict(zip(names, zip(*rows))))

    def save(self, directory: str | Path) -> None:
        """Write what the command writes, the run of each model among it.

        UsageError if the folder cannot be written to, or holds anything but an earlier result.
        """
        for name in self.models:
            run_folder(Path(directory) / name)
        super().save(directory)
        for name in self.models:
            Run.load(self._folder / name).save(Path(directory) / name)


FORMAT = 5  # of comparison.json


def measure_run(
    saved: RunData,
    *,
    build: float,
    one_thread: float,
    turn: Mapping[str, Mesh] | None = None,
    end: Mapping[str, Mesh] | None = None,
) -> Values:
    """Values of every measure but the distances for one model: muscle -> quantity -> value.

    Under ``"all"`` the worst over muscles, or the wall time. ``build`` is the time to build the
    model, ``one_thread`` that of a frame on one thread [s]; where the motion has more than one
    frame, ``turn`` are surfaces by muscle at the last pose by shorter sub-steps, and ``end`` back
    at the first after the motion there and back.
    """
    found: Values = {}
    for muscle in saved.muscles:
        facts = saved.info.muscles.get(muscle, {})
        worst = {q: facts.get(q, QuantityFacts()).get("worst") for q in FROM_METRICS}
        values = {q: value for q, value in worst.items() if value is not None}
        # How deep it is in a bone, or a bone in it, beyond what is left at rest.
        depths = [values.get(name, 0.0) for name in ("penetration_max", "bone_penetration_max")]
        values[DEEPER] = max(0.0, max(depths) - values.get("initial_overlap", 0.0))
        times = saved.series(muscle, "time_frame")[1][1:]  # the first loads and compiles
        if len(times):
            values["time_frame"] = float(np.median(times))
        for name, frame, meshes in (("return", 0, end), ("step", -1, turn)):
            if meshes is not None:
                mine = saved.mesh(muscle, saved.frame_numbers[frame])
                pair = surface_distance(*mine, *meshes[muscle])
                values[f"{name}_rms"], values[f"{name}_max"] = pair
        found[muscle] = values
    together: dict[str, float] = {}
    for name, measure in MEASURES.items():
        known = [values[name] for values in found.values() if name in values]
        if known:
            together[name] = max(known, key=lambda value: abs(value - measure.ideal))
    wall = saved.series(ALL, "time_frame")[1][1:]
    if len(wall):
        together["time_frame"] = float(np.median(wall))
        together["time_frame_p95"] = float(np.percentile(wall, 95))
    together["time_build"] = build
    together["time_one_thread"] = one_thread
    found[ALL] = together
    return found


def add_distances(results: dict[str, Values], folder: Path, poses: list[int]) -> None:
    """Add the distances of each model's surfaces to those of the first, the worst of some poses of
    a folder's runs, and the differences of lengths and moment arms.
    """
    first, *others = (RunData.load(folder / name) for name in results)
    for found, run in zip(list(results.values())[1:], others):
        for muscle in first.muscles:
            pairs = [surface_distance(*first.mesh(muscle, k), *run.mesh(muscle, k)) for k in poses]
            apart = dict(zip(("distance_rms", "distance_max"), map(max, zip(*pairs))))
            apart["length_rms"] = _apart(first, run, muscle, "length", None)
            arms = [
                _apart(first, run, muscle, "moment_arm", about)
                for about in moment_arm_coordinates(first, muscle)
            ]
            apart |= {"moment_arm_rms": max(arms)} if arms else {}
            for name, value in apart.items():
                if np.isfinite(value):
                    found[muscle][name] = value
                    found[ALL][name] = max(found[ALL].get(name, 0.0), value)


def _apart(first: RunData, other: RunData, muscle: str, quantity: str, about: str | None) -> float:
    """Root mean square over the frames of the difference of a quantity; NaN where frames differ."""
    (frames, mine), (others, values) = (
        run.series(muscle, quantity, about) for run in (first, other)
    )
    if not len(frames) or not np.array_equal(frames, others):
        return float("nan")
    return float(np.sqrt(np.mean((mine - values) ** 2)))


def write_tables(
    folder: Path,
    variants: Mapping[str, Scene],
    results: dict[str, Values],
    failed: dict[str, str],
    poses: list[int],
) -> Comparison:
    """Write ``comparison.json``, which is returned, ``comparison.csv``: values by model, muscle and
    quantity, and ``statistics.csv``: their means and standard deviations over the frames.

    ``variants`` are the scene of each model, ``poses`` the numbers of the frames at which distances
    were measured.
    """
    scene = next(iter(variants.values()))
    labels = {name: model_title(variants[name].muscles[0]) for name in results}
    runs = {name: RunData.load(folder / name) for name in results}
    beyond = {name: muscles_beyond(run) for name, run in runs.items()}
    table = Comparison(
        format=FORMAT,
        scene=scene.name,
        units=scene.units,
        frames=len(scene.motion),
        poses=poses,
        models=list(results),
        labels=labels,
        failed=failed,
        answer=describe(results, labels, beyond),
        within={name: len(runs[name].muscles) - len(found[ALL]) for name, found in beyond.items()},
        unknowns={
            name: {m.name: solved_points(m, variants[name]) for m in variants[name].muscles}
            for name in results
        },
        measures={
            name: replace(measure, unit=unit_text(measure.unit, scene.units))
            for name, measure in MEASURES.items()
        },
        results=results,
        machine=machine(),
        versions=versions(),
    )
    write_json(folder / "comparison.json", table.model_dump())
    write_csv(folder / "comparison.csv", csv_rows(table.table()))
    rows: list[tuple[object, ...]] = [("model", "muscle", "quantity", "mean", "sd", "unit")]
    rows += [
        (model, muscle, name, facts["mean"], facts["sd"], facts["unit"])
        for model, run in runs.items()
        for muscle, quantities in run.summary.items()
        for name, facts in quantities.items()
        if quantity_of(name) in STATISTICS and "sd" in facts
    ]
    write_csv(folder / "statistics.csv", rows)
    return table


# How many quantities beyond limits are named.
MOST_TOLD = 4
_TIE = 1.05  # models whose values differ by less are equally good

Beyond = Mapping[str, Mapping[str, set[str]]]


def best_models(results: dict[str, Values], quantity: str, units: str) -> list[str]:
    """Models that are as good as the best in a measure: within 5 %, or within what does not
    count.
    """
    measure = MEASURES[quantity]
    known = {
        name: found[ALL][quantity] for name, found in results.items() if quantity in found[ALL]
    }
    values = {name: abs(value - measure.ideal) for name, value in known.items()}
    if measure.against == FIRST or len(values) < 2:
        return []
    scale = from_mm(1.0, units) if measure.unit == "length" else 1.0
    limit = _TIE * min(values.values()) + measure.floor * scale
    return [name for name, value in values.items() if value <= limit]


def muscles_beyond(saved: RunData) -> dict[str, set[str]]:
    """The muscles of a run that are not within a limit, by quantity, `ALL` for the bones; under
    ``"all"`` those muscles that are not within all limits, or not measured for one.
    """
    found: dict[str, set[str]] = {ALL: set()}
    pairs = [(row.muscle, row.quantity) for row in saved.info.beyond]
    pairs += [(row.muscle, row.quantity) for row in saved.info.not_measured if row.muscle != ALL]
    for muscle, quantity in pairs:
        found.setdefault(quantity_of(quantity), set()).add(muscle)
        if muscle != ALL:
            found[ALL].add(muscle)
    return found


def _failures(beyond: Beyond, labels: dict[str, str]) -> list[str]:
    """For each model what its muscles, or the bones, are not within the limits of, most muscles
    first.
    """
    texts = []
    for model, found in beyond.items():
        named = {
            quantity: sorted("the bones" if name == ALL else name for name in muscles)
            for quantity, muscles in found.items()
            if quantity != ALL
        }
        most = sorted(named, key=lambda quantity: len(named[quantity]), reverse=True)[:MOST_TOLD]
        told = [
            f"{LIMITS[quantity].title} ({listed(named[quantity], MOST_TOLD)})" for quantity in most
        ]
        if told:
            texts.append(f"Beyond limits, {labels[model]}: {', '.join(told)}")
    return texts


def describe(results: dict[str, Values], labels: dict[str, str], beyond: Beyond) -> str:
    """How many muscles of each model are within all limits, what the others are beyond, which model
    is the best by the limits, and which the quickest.

    Arguments are those of `write_tables`, ``beyond`` is `muscles_beyond` of each model.
    """
    muscles = len(next(iter(results.values()))) - 1
    kept = {name: muscles - len(found[ALL]) for name, found in beyond.items()}
    counts = [f"{count} of {muscles} ({labels[name]})" for name, count in kept.items()]
    texts = [f"Muscles within all limits: {', '.join(counts)}", *_failures(beyond, labels)]
    if len(results) > 1:
        best = [labels[name] for name, count in kept.items() if count == max(kept.values())]
        texts.append(
            f"By the limits {' and '.join(best)} are equal"
            if len(best) > 1
            else f"By the limits {best[0]} is the best"
        )
        times = {
            name: found[ALL]["time_frame"]
            for name, found in results.items()
            if "time_frame" in found[ALL]
        }
        if len(times) > 1:
            quick = min(times, key=times.__getitem__)
            longer = [
                f"{labels[name]} takes {time / times[quick]:.2g} times as long"
                for name, time in times.items()
                if name != quick
            ]
            texts.append(f"{labels[quick]} is the quickest: {', '.join(longer)}")
        texts.append(
            "The comparison does not show which shape is right; docs/validation.md compares with "
            "finite elements"
        )
    return f"{'. '.join(texts)}."


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
    first = next(iter(runs.values()))
    failed = [f"{name} did not finish: {reason}" for name, reason in found.failed.items()]
    counts = {"muscles": len(first.muscles), "frames": found.frames, **found.machine}
    # Of the bowing each muscle has a limit of its own.
    limits = first.info.limits | {"bowing": None, DEEPER: first.info.limits.get("penetration_max")}
    terms = [(m.title, m.meaning) for m in MEASURES.values()]
    models = found.models
    rows = [
        [Cell(muscle), *(Cell(found.unknowns[name][muscle]) for name in models)]
        for muscle in found.unknowns[models[0]]
    ]
    ReportPage(
        f"{found.scene}: models compared",
        [f"{counts[what]} {what}" for what in ("muscles", "frames", "threads")],
        " ".join([found.answer, *failed]),
        BAD if failed else PLAIN,
        scene=packed_scene(runs) if pictures else "",
        missing="" if pictures else "No pictures: they were switched off.",
        lights=[_light(found, name, limits.get(name)) for name in LIGHTS if _values(found, name)],
        heads=list(runs),
        sections=[
            Section(
                "Every measure",
                "worst of muscles and frames, best in green",
                table=_measures(found),
            ),
            Section("Mean and standard deviation over the frames", table=_statistics(runs)),
            Section(
                "What each model solves for",
                table=Table(["", *(found.labels[name] for name in models)], rows),
            ),
            Section("Over the motion", plots=_plots(runs)),
            Section("How to read this", text=_READING, terms=terms),
        ],
        footer=", ".join(f"{name} {value}" for name, value in found.versions.items()),
    ).write(folder / "report.html")


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
    measure = found.measures[quantity]
    if value is not None and measure.unit == "mm" and abs(value) < 0.5 * measure.floor:
        value = 0.0
    return shown_number(value, measure.unit)


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


def _statistics(runs: Mapping[str, RunData]) -> Table:
    """Length, moment arms and volume of each muscle, mean ± standard deviation."""
    first, rows = next(iter(runs.values())), []
    for muscle, quantities in first.summary.items():
        for name in quantities:
            quantity, about = split_name(name)
            if quantity not in _STATISTICS_SHOWN:
                continue
            texts = []
            for run in runs.values():
                facts = run.summary.get(muscle, {}).get(name, QuantityFacts())
                known = [facts["mean"], facts["sd"]] if "sd" in facts else []
                texts.append(" ± ".join(shown_number(x, facts["unit"]) for x in known) or "–")
            title = f"{quantity.replace('_', ' ')} {about}".strip()
            rows.append([Cell(muscle), Cell(title), *map(Cell, texts)])
    return Table(["", "", *runs], rows)


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
        name: (MEASURES[name].title.capitalize(), "" if MEASURES[name].unit == "1" else first.units)
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
