"""Sweeps: runs of one or several scenes under a grid of settings, side by side in processes or on a
Dask cluster; tables, the Pareto front and a page.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import platform
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict

import numpy as np
from pydantic import BaseModel

from rbfmuscle.display.page import (
    GOOD,
    NEAR,
    PLAIN,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    number_cell,
)
from rbfmuscle.display.plots import Point, front_plot
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.threads import threads_limited
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.metrics.quantities import ALL, QUANTITIES
from rbfmuscle.metrics.summary import QuantityFacts, shown_number
from rbfmuscle.models import configure_scene
from rbfmuscle.recording import Run, simulate
from rbfmuscle.run.data import RunData, as_table, csv_rows
from rbfmuscle.run.writer import versions, write_csv, write_json
from rbfmuscle.scene.content import content_hash
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_value
from rbfmuscle.simulation.frame import Mesh
from rbfmuscle.studies.result import OnProgress, Study, study_folder
from rbfmuscle.validation import (
    MissingDependencyError,
    RBFMuscleError,
    SolveError,
    UsageError,
    did_you_mean,
)

if TYPE_CHECKING:
    from distributed import Client


def sweep(
    scene: Scene | str | Path | Mapping[str, Scene | str | Path],
    directory: str | Path | None = None,
    *,
    grid: Mapping[str, Sequence[object]] = MappingProxyType({}),
    settings: Mapping[str, object] | None = None,
    frames: slice | str | None = None,
    reference: Mapping[str, object] | None = None,
    jobs: int | str | None = None,
    quantity: str = "error_rms",
    progress: OnProgress | None = None,
) -> SweepTable:
    """Run scenes under every combination of some settings, and write tables and a page.

    Points that the folder, where one is given, holds done are not run again.

    Parameters
    ----------
    scene : Scene, path or "phantom", or mapping of str to these
        One scene, or several by name.
    directory : path, optional
        New, empty, or that of an earlier sweep.
    grid : mapping of str to sequence
        Values of each dotted key, as ``{"model.centres": [100, 200]}``; empty, the scenes are
        compared as they are.
    settings : mapping, optional
        Dotted keys with their values, of every point.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    reference : mapping, optional
        Settings of the run that errors are measured against, over the finest values of the grid.
    jobs : int or str, optional
        Cores to use, all by default: points run at the same time; or the address of a Dask
        scheduler whose workers see the folder.
    quantity : str
        The error on the axis of the Pareto front.
    progress : callable, optional
        Called as ``progress(done, total)`` after each point.

    Returns
    -------
    SweepTable
        What ``sweep.json`` holds (``done``, ``failed``, ``verdicts`` and ``rows``, one per
        point), with ``table()``, ``save(directory)`` and ``show()``.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene, sweep
    >>> scene = phantom_scene(end=0.0, spacing=6.0).with_options(model="pbd")
    >>> found = sweep(scene, grid={"contact.substep_angle": [1.0, 2.0]}, jobs=1)
    >>> found.done, len(found.table())
    (3, 3)
    """
    if isinstance(directory, Mapping):
        raise UsageError("give the grid by its name: sweep(scene, grid={...})")
    if quantity not in VALUES:
        raise UsageError(f"unknown quantity {quantity!r}, {did_you_mean(quantity, VALUES)}")
    if isinstance(jobs, int) and jobs < 1:
        raise UsageError(f"jobs must be 1 or more, got {jobs}")
    if isinstance(jobs, str) and directory is None:
        raise UsageError("a cluster needs a folder that its workers see")
    if not isinstance(scene, Mapping):
        scene = open_scene(scene)
        scene = {scene.name: scene}
    opened = {name: configure_scene(open_scene(one), settings) for name, one in scene.items()}
    values = {key: list(chosen) for key, chosen in grid.items()}
    points = plan_sweep(opened, values, frames=frames, reference=reference)
    for point in points:  # a mistyped key is reported now, not after the first point
        configure_scene(opened[point.scene], point.settings, frames=frames)
    units = {name: scene.units for name, scene in opened.items()}
    with study_folder(directory) as folder:
        run_sweep(run_point, opened, points, folder, frames=frames, jobs=jobs, progress=progress)
        table = write_table(points, folder, units, quantity=quantity)
        write_page(folder, table)
        return table.kept_in(folder, own=directory is None)


def run_point(scene: Scene, settings: dict[str, object], frames: slice | str | None) -> Run:
    """One run of a sweep, in memory; module-level, so that it can be sent to other processes."""
    return simulate(scene, settings=settings, frames=frames)


# Values of each setting that is varied.
Grid = Mapping[str, Sequence[object]]

# Of these keys the reference takes the greatest value of the grid, or the least; of all others the
# scene's own.
FINER_UP = ("model.centres", "model.samples", "model.nodes", "model.iterations", "model.resolution")
FINER_DOWN = ("contact.substep_angle", "motion.step")


@dataclass(frozen=True)
class SweepPoint:
    """One combination of settings of one scene.

    ``key`` is a hash of the library's version, the scene's content and the settings; ``scene`` a
    name; ``settings`` are dotted keys with their values, the model first; ``role`` is "reference",
    "default" (the scene's own settings) or ""; ``reference`` is the key of the point that the error
    is measured against, "" without a grid.
    """

    key: str
    scene: str
    settings: dict[str, object]
    role: str
    reference: str

    @property
    def label(self) -> str:
        """The settings in words."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items()) or "default"


def parse_grid(texts: Sequence[str]) -> Grid:
    """Return the grid of ``["KEY=a,b,c", ...]``; UsageError on other text, or a key given twice or
    without values.
    """
    grid: dict[str, list[object]] = {}
    for text in texts:
        name, found, values = text.partition("=")
        key = name.strip()
        if not found or not key or not values.strip():
            raise UsageError(f"{text!r} is not KEY=a,b,c, for instance model.centres=100,200,300")
        if key in grid:
            raise UsageError(f"{key} is given twice in the grid")
        try:
            parts = tomllib.loads(f"value = [{values}]")["value"]
        except tomllib.TOMLDecodeError:
            parts = [
                parse_value(part.strip(), context=key) for part in values.split(",") if part.strip()
            ]
        if key in (*FINER_UP, *FINER_DOWN) and not all(
            isinstance(part, int | float) for part in parts
        ):
            raise UsageError(f"{key}: {values} are not all numbers")
        grid[key] = [part for k, part in enumerate(parts) if part not in parts[:k]]
    return grid


def plan_sweep(
    scenes: Mapping[str, Scene],
    grid: Grid,
    *,
    frames: slice | str | None = None,
    reference: Mapping[str, object] | None = None,
) -> list[SweepPoint]:
    """Lay out a sweep scene by scene: reference, the scene's own settings, the grid; nothing is
    run.

    Without a grid scenes (by name) are compared as they are. ``frames`` are those of the motion,
    "A:B:S". ``reference`` holds settings of the reference, over those that follow from the grid:
    the greatest number of centres, samples, nodes, iterations and cells in it and the least angle
    and step.
    """
    wanted: list[tuple[str, dict[str, object]]] = [("default", {})]
    wanted += [("", dict(zip(grid, chosen))) for chosen in itertools.product(*grid.values())]
    if grid:
        wanted.insert(0, ("reference", _finest(grid) | dict(reference or {})))
    points: list[SweepPoint] = []
    for name, scene in scenes.items():
        content = scene_content(scene, frames)
        found: dict[str, SweepPoint] = {}
        target = ""
        for role, chosen in wanted:
            # The model comes first, as choosing another one drops its options.
            settings = dict(sorted(chosen.items(), key=lambda item: item[0] != "model"))
            key = content_hash(content, settings)[:16]
            target = key if role == "reference" else target
            found.setdefault(key, SweepPoint(key, name, settings, role, target))
        points += found.values()
    return points


def _finest(grid):
    """Of the settings that make a run finer the greatest value, or the least."""
    up = {key: max(values) for key, values in grid.items() if key in FINER_UP}
    return up | {key: min(values) for key, values in grid.items() if key in FINER_DOWN}


def scene_content(scene: Scene, frames: slice | str | None = None) -> str:
    """Hash of what a scene would simulate, wherever its files lie, and of the library's version."""
    return content_hash(scene, str(frames or ""), versions()["rbfmuscle"])


class SweepRow(BaseModel):
    """One point of a sweep.

    ``role`` is "reference", "default" or ""; ``status`` "done", "failed" or "missing"; ``values``
    are those of `VALUES` that are known, lengths in ``units``; ``reference`` is the key of the
    point that errors are measured against, "" where there is none.
    """

    scene: str
    units: str
    role: str = ""
    status: str = "done"
    front: bool = False
    settings: dict[str, object]
    values: dict[str, float]
    seconds: float | None = None
    threads: int | None = None
    machine: str = ""
    message: str = ""
    label: str
    reference: str
    key: str

    def value(self, quantity: str) -> float:
        """A value, NaN where it is not known."""
        return self.values.get(quantity, math.nan)


class FrontVerdict(BaseModel):
    """Where the default of a scene lies.

    ``factor`` is the least by which both error and time of the default must fall to lie on the
    front, 1 on it; ``near``: up to `NEAR_FRONT`; ``faster``, ``better``: keys of the quickest
    point of no greater error and the most accurate of no greater time, None where there is none;
    ``text``: all of it in words.
    """

    scene: str
    factor: float
    near: bool
    faster: str | None
    better: str | None
    default: str
    text: str


class SweepTable(BaseModel, Study):
    """What ``sweep.json`` holds; ``quantity`` is the error on the axis of the Pareto front, then
    follow counts of points.
    """

    command: ClassVar[str] = "sweep"
    page: ClassVar[str] = "sweep.html"

    quantity: str
    done: int
    failed: int
    missing: int
    verdicts: list[FrontVerdict]
    rows: list[SweepRow]

    def table(self) -> np.ndarray:
        """The points as a structured ndarray, with the columns of ``sweep.csv``: settings
        (as text), then facts and values.
        """
        keys = list(dict.fromkeys(key for row in self.rows for key in row.settings))
        first = ("scene", "units", "role", "status", "front")
        last = ("seconds", "threads", "machine", "message", "reference", "key")
        columns: dict[str, list[object]] = {
            key: [str(row.settings.get(key, "")) for row in self.rows] for key in keys
        }
        columns |= {name: [getattr(row, name) for row in self.rows] for name in first}
        columns |= {name: [row.value(name) for row in self.rows] for name in VALUES}
        columns |= {name: [getattr(row, name) for row in self.rows] for name in last}
        return as_table(columns)


# Worst over muscles and frames, by magnitude: of a point of a sweep, and of the README's table.
WORST = (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "solver_penetration_max",
    "neighbour_overlap_max",
    "rest_error_rms",
    "rest_error_max",
    "edge_strain_rms",
    "components",
    "flicker",
    "bowing",
    "self_crossings",
)
# In the scene's unit.
LENGTHS = ("error_rms", "error_max", *(name for name in WORST if QUANTITIES[name][0] == "length"))
# The default may be this much worse than the front, in error and in time at once.
NEAR_FRONT = 1.1


def pareto_front(errors: Sequence[float], times: Sequence[float]) -> list[int]:
    """Indices, by growing time, of points that no other beats in error or time without loss; NaN
    takes no part.
    """
    front, least = [], math.inf
    for k in sorted(range(len(errors)), key=lambda k: (times[k], errors[k])):
        if math.isfinite(errors[k]) and math.isfinite(times[k]) and errors[k] < least:
            front.append(k)
            least = errors[k]
    return front


def mark_front(rows: list[SweepRow], quantity: str = "error_rms") -> list[FrontVerdict]:
    """Mark the front among the points of each reference, and judge the default of each against
    ``time_frame``.

    References take no part: their error is zero by definition.
    """
    verdicts = []
    for group in dict.fromkeys(row.reference for row in rows if row.reference):
        mine = [row for row in rows if row.reference == group and row.role != "reference"]
        usable = [row for row in mine if row.status == "done"]
        errors = [row.value(quantity) for row in usable]
        for k in pareto_front(errors, [row.value("time_frame") for row in usable]):
            usable[k].front = True
        default = [
            row for row in usable if row.role == "default" and math.isfinite(row.value(quantity))
        ]
        verdicts += [_judge(row, usable, quantity) for row in default]
    return verdicts


def _judge(default: SweepRow, rows: list[SweepRow], quantity: str) -> FrontVerdict:
    def error(row: SweepRow) -> float:
        return row.value(quantity)

    def time(row: SweepRow) -> float:
        return row.value("time_frame")

    others = [row for row in rows if row is not default and math.isfinite(error(row))]
    ratios = [
        min(_ratio(error(default), error(row)), _ratio(time(default), time(row))) for row in others
    ]
    factor = max([1.0, *ratios])
    quicker = [r for r in others if error(r) <= error(default) and time(r) < time(default)]
    finer = [r for r in others if time(r) <= time(default) and error(r) < error(default)]
    faster = min(quicker, key=time, default=None)
    better = min(finer, key=error, default=None)
    off = "within 10 % of" if factor <= NEAR_FRONT else f"a factor of {factor:.2g} off"
    where = "on" if default.front else off
    text = (
        f"{default.scene}: the default lies {where} the Pareto front "
        f"({_figures(default, quantity)})"
    )
    for row, words in ((faster, "as accurate and quicker"), (better, "as quick and more accurate")):
        text += f"; {words}: {row.label} ({_figures(row, quantity)})" if row else ""
    return FrontVerdict(
        scene=default.scene,
        factor=factor,
        near=factor <= NEAR_FRONT,
        faster=faster and faster.key,
        better=better and better.key,
        default=default.key,
        text=f"{text}.",
    )


def _ratio(mine: float, other: float) -> float:
    return mine / other if other > 0 else (math.inf if mine > 0 else 1.0)


def _figures(row: SweepRow, quantity: str) -> str:
    unit = row.units if quantity in LENGTHS else ""
    error, time = row.value(quantity), row.value("time_frame")
    return f"{shown_number(error, unit)} at {shown_number(time, 's')} per frame"


CONNECT_WITHIN = 20  # seconds for a scheduler and its first two workers
Runner = Callable[[Scene, dict[str, object], slice | str | None], RunData]
# What a point may fail with and leave the others standing.
POINT_ERRORS = (
    RBFMuscleError,
    ArithmeticError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    ValueError,
)
TABLES = ("sweep.csv", "sweep.json", "sweep.html")
TIMES = ("time_frame", "time_frame_p95", "time_extract")
VALUES = ("error_rms", "error_max", *WORST, *TIMES)


class PointResult(TypedDict, total=False):
    """What is kept of a point; ``values`` are null where they were not finite."""

    key: str
    reference: str
    settings: dict[str, object]
    status: str
    message: str
    values: dict[str, float | None]
    summary: Mapping[str, Mapping[str, QuantityFacts]]  # of the run, as limits read it
    threads: int
    machine: str
    process: int
    seconds: float


class SweepFolder:
    """``points/KEY.json``, a result each, and ``references/KEY.npz``, surfaces that errors are
    measured against.
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(os.path.abspath(directory))
        self.points, self.references = self.directory / "points", self.directory / "references"
        self.output = OutputFolder(self.directory, "sweep", ("points", "references", *TABLES))
        self.output.add(*TABLES)

    def read(self, key: str) -> PointResult:
        """A point's result, empty where there is none."""
        try:
            return json.loads((self.points / f"{key}.json").read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError, RecursionError):
            return {}

    def write(self, result: PointResult) -> None:
        """Keep a point's result: whole or not at all."""
        write_json(self.points / f"{result['key']}.json", result)

    def surfaces(self, key: str) -> Path:
        """File of the surfaces of a reference."""
        return self.references / f"{key}.npz"

    def is_done(self, point: SweepPoint) -> bool:
        """Whether a point need not be run again: it is done, and was measured against the same
        reference.
        """
        kept = point.role != "reference" or self.surfaces(point.key).exists()
        found = self.read(point.key)
        return kept and (found.get("status"), found.get("reference")) == ("done", point.reference)


def run_sweep(
    runner: Runner,
    scenes: Mapping[str, Scene],
    points: Sequence[SweepPoint],
    directory: str | Path,
    *,
    frames: slice | str | None = None,
    jobs: int | str | None = None,
    progress: OnProgress | None = None,
) -> int:
    """Run the points that the folder does not hold done, references first; how many were run.

    ``runner(scene, settings, frames)`` gives a finished `Run`; it is module-level, so that it can
    be sent away. ``scenes``, ``points`` and ``frames`` are those of `plan_sweep`. ``jobs`` is the
    number of cores to use, all by default: as many points run beside each other, and where there
    are fewer each has several threads. Or it is the address of a Dask scheduler whose workers see
    the folder. ``progress(done, total)`` is called along the way.
    """
    from joblib import cpu_count, parallel_config

    folder = SweepFolder(directory)
    left = [point for point in points if not folder.is_done(point)]
    folder.output.add(*(f"points/{point.key}.json" for point in left))
    folder.output.add(*(f"references/{p.key}.npz" for p in left if p.role == "reference"))
    for point in left:
        (folder.points / f"{point.key}.json").unlink(missing_ok=True)
    cores = 1 if isinstance(jobs, str) else jobs or cpu_count()
    beside = -1 if isinstance(jobs, str) else min(cores, max(1, len(left)))
    threads = max(1, cores // beside)  # one on a cluster

    done = 0

    def advance(*, recount: bool = False) -> None:
        nonlocal done
        done = sum(bool(folder.read(point.key)) for point in left) if recount else done + 1
        if progress is not None:
            progress(done, len(left))

    with ExitStack() as stack:
        if isinstance(jobs, str):
            client = stack.enter_context(_connect_cluster(jobs))
            stack.enter_context(parallel_config(backend="dask", client=client))
        elif beside > 1:
            stack.enter_context(parallel_config(backend="loky", inner_max_num_threads=threads))
        for first in (True, False):
            stage = [point for point in left if (point.role == "reference") == first]
            calls = [(runner, scenes[p.scene], p, folder, frames, threads) for p in stage]
            _side_by_side(calls, folder, beside, advance)
    return len(left)


def _connect_cluster(address: str) -> Client:
    """A client of a Dask scheduler, as soon as two workers are there: to one alone joblib sends
    nothing.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingDependencyError(
            "Dask is not installed, which a cluster needs: pip install -e '.[cluster]' in "
            "rbfmuscle's folder"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_WITHIN)
        client.wait_for_workers(2, timeout=CONNECT_WITHIN)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Dask scheduler with two workers answers at {address!r} ({error})"
        ) from None
    return client


def _side_by_side(calls, folder, jobs, advance):
    """Run calls; after a process has died, those that were running each in a process of its own,
    then the others.
    """
    from joblib import Parallel, delayed
    from joblib.externals.loky import BrokenProcessPool, ProcessPoolExecutor

    try:
        tasks = (delayed(measure_point)(*call) for call in calls)
        for _ in Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)(tasks):
            advance()
    except BrokenProcessPool:
        left = [call for call in calls if not folder.read(call[2].key)]
        for call in left[:jobs]:
            with ProcessPoolExecutor(1) as pool:
                try:
                    pool.submit(measure_point, *call).result()
                except BrokenProcessPool:
                    message = "the process ended without a message (out of memory, or a crash)"
                    folder.write({"key": call[2].key, "status": "failed", "message": message})
            advance(recount=True)  # of some that are done the pool has not said so
        _side_by_side(left[jobs:], folder, jobs, advance)
    except RuntimeError as error:  # of Dask, where worker after worker dies of a point
        raise SolveError(f"a point ended its workers ({error}); finished points are kept") from None


def measure_point(
    runner: Runner,
    scene: Scene,
    point: SweepPoint,
    folder: SweepFolder,
    frames: slice | str | None,
    threads: int,
) -> None:
    """Run one point, measure it and keep the result; an error becomes the result of a failed
    point.
    """
    start = time.perf_counter()
    result: PointResult = {
        "key": point.key,
        "reference": point.reference,
        "settings": point.settings,
        "status": "done",
        "message": "",
        "threads": threads,
        "machine": platform.node(),
        "process": os.getpid(),
    }
    try:
        with threads_limited(threads):
            run = runner(scene, point.settings, frames)
            values = _values(run)
            every = [(frame, *named) for frame in run.frames for named in frame.surfaces.items()]
            shown = {}
            for frame, name, surface in every:
                at = sorted(frame.coordinates.items())
                pose = " ".join(f"{key}={round(value, 9) + 0.0:.9f}" for key, value in at) or "rest"
                shown[f"{pose}|{name}"] = surface.vertices, surface.faces
            if point.role == "reference":
                # Of NumPy's keywords none is among the keys.
                arrays: dict[str, Any] = {
                    f"{place}|{k}": mesh[k] for place, mesh in shown.items() for k in (0, 1)
                }
                fresh = folder.references / f".{point.key}.{os.getpid()}.npz"
                np.savez_compressed(fresh, **arrays)
                os.replace(fresh, folder.surfaces(point.key))
            elif point.reference:
                values |= _errors(shown, folder.surfaces(point.reference))
            result["values"] = values
            result["summary"] = run.summarise()
    except POINT_ERRORS as error:
        result["status"] = "failed"
        result["message"] = f"{type(error).__name__}: {' '.join(str(error).split())}"
    result["seconds"] = time.perf_counter() - start
    folder.write(result)


def _values(run: RunData) -> dict[str, float | None]:
    worst: dict[str, float] = {}
    for muscle, quantities in run.summary.items():
        for name in WORST:
            value = quantities.get(name, QuantityFacts()).get("worst")
            if muscle != ALL and value is not None and not math.isnan(value):
                worst[name] = max(worst.get(name, 0.0), abs(value))
    # The first frame loads and compiles, and settles what overlaps at rest.
    shown = run.frames[1:] or run.frames
    walls = np.array([frame.wall for frame in shown])
    extract = [
        sum(s.quantities.get("time_extract", 0.0) for s in f.surfaces.values()) for f in shown
    ]
    times = np.median(walls), np.percentile(walls, 95), np.median(extract)
    return {**worst, **{name: float(value) for name, value in zip(TIMES, times)}}


def _errors(shown: Mapping[str, Mesh], path: Path) -> dict[str, float | None]:
    """Surface distance to the reference, root mean square over frames and muscles, and greatest."""
    if not path.exists():
        raise UsageError("its reference is missing: that point failed, or the folder is not shared")
    with np.load(path) as kept:
        met = [(mesh, place) for place, mesh in shown.items() if f"{place}|0" in kept]
        pairs = [
            surface_distance(*mesh, kept[f"{place}|0"], kept[f"{place}|1"]) for mesh, place in met
        ]
    found = np.array(pairs)
    if not len(found):
        raise UsageError("no frame of this point is at a pose of the reference")
    return {
        "error_rms": math.sqrt(np.mean(found[:, 0] ** 2)),
        "error_max": float(found[:, 1].max()),
    }


def sweep_rows(
    points: Sequence[SweepPoint], folder: SweepFolder, units: Mapping[str, str]
) -> list[SweepRow]:
    """The rows of points; ``units`` are those of the scenes by name."""
    results = [folder.read(point.key) for point in points]
    return [
        SweepRow(
            scene=point.scene,
            units=units[point.scene],
            role=point.role,
            status=result.get("status", "missing"),
            settings=point.settings,
            values={k: v for k, v in result.get("values", {}).items() if v is not None},
            seconds=result.get("seconds"),
            threads=result.get("threads"),
            machine=result.get("machine", ""),
            message=result.get("message", ""),
            label=point.label,
            reference=point.reference,
            key=point.key,
        )
        for point, result in zip(points, results)
    ]


def write_table(
    points: Sequence[SweepPoint],
    directory: str | Path,
    units: dict[str, str],
    *,
    quantity: str = "error_rms",
) -> SweepTable:
    """Write ``sweep.csv``, a line a point, and ``sweep.json``; what the latter holds."""
    folder = SweepFolder(directory)
    rows = sweep_rows(points, folder, units)
    verdicts = mark_front(rows, quantity)
    statuses = [row.status for row in rows]
    table = SweepTable(
        quantity=quantity,
        done=statuses.count("done"),
        failed=statuses.count("failed"),
        missing=statuses.count("missing"),
        verdicts=verdicts,
        rows=rows,
    )
    write_json(folder.directory / "sweep.json", table.model_dump())
    # Digits beyond nine places are rounding.
    lines = [
        [f"{round(cell, 9):.6g}" if isinstance(cell, float) else cell for cell in row]
        for row in csv_rows(table.table())
    ]
    write_csv(folder.directory / "sweep.csv", lines)
    return table


ROUNDING = 1e-9  # errors below it are none
SHOWN = (
    "error_rms",
    "error_max",
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "time_frame",
)
_READING = """error_rms is the distance between a point's surfaces and those of the reference at
the same poses, both ways, root mean square over frames and muscles: how far a setting is from
the reference, not how far the model is from a real muscle. A point is on the front if no other
is as accurate in less time."""
_INSIDE = """ The reference is itself a point of the grid, so points near it err little by
definition. Give a finer one (--reference) to judge the default."""


def write_page(directory: str | Path, found: SweepTable) -> None:
    """Write the self-contained ``sweep.html`` of what `write_table` returns."""
    rows, quantity = found.rows, found.quantity
    picture = front_picture(rows, quantity)
    verdicts, inside = found.verdicts, inside_grid(rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    judged = PLAIN if inside or not verdicts else GOOD if all(v.near for v in verdicts) else NEAR
    ReportPage(
        f"Sweep of {', '.join(scenes)}"[:120],
        [
            f"{getattr(found, status)} points {status}"
            for status in ("done", "failed", "missing")
            if getattr(found, status)
        ],
        " ".join(v.text for v in verdicts) or f"{found.done} points are done; none is judged.",
        judged,
        plot=picture,
        missing="" if picture else "No front: no point has both an error and a time.",
        lights=_lights(rows, verdicts, quantity),
        heads=[quantity.replace("_", " "), "per frame"],
        sections=[
            Section("Every point", table=_point_table(rows)),
            Section("How to read this", text=_READING + (_INSIDE if inside else "")),
        ],
    ).write(Path(directory) / "sweep.html")


def inside_grid(rows: Iterable[SweepRow]) -> bool:
    """Whether a reference has no setting beyond those of the other points."""
    found = [(row.role, {(key, str(value)) for key, value in row.settings.items()}) for row in rows]
    others = set().union(*(settings for role, settings in found if role != "reference"))
    return any(settings <= others for role, settings in found if role == "reference")


def front_picture(rows: Iterable[SweepRow], quantity: str) -> str:
    """SVG of error against time per frame: a colour for each scene and model, fronts joined; no
    reference itself.
    """
    points = []
    for row in rows:
        if row.role != "reference" and row.status == "done" and row.value(quantity) > ROUNDING:
            group = f"{row.scene} {row.settings.get('model', '')}".strip()
            place = 1e3 * row.value("time_frame"), row.value(quantity), _short(row), group
            points.append(Point(*place, row.role == "default", row.front))
    return front_plot(points, ("time per frame [ms]", quantity.replace("_", " ")))


def _short(row: SweepRow) -> str:
    """A point's settings without what names the table that they are in."""
    if row.role == "default":
        return "default"
    named = {key.rpartition(".")[2]: value for key, value in row.settings.items() if key != "model"}
    return ", ".join(f"{key} {value}" for key, value in named.items())


def _lights(rows: list[SweepRow], verdicts: list[FrontVerdict], quantity: str) -> list[CheckRow]:
    """Of each default: itself, what is quicker, what is more accurate; then the two ends of the
    front.
    """
    front = sorted((row for row in rows if row.front), key=lambda row: row.value("time_frame"))
    chosen: list[tuple[str, str | None, str]] = []
    for verdict in verdicts:
        state = PLAIN if inside_grid(rows) else GOOD if verdict.near else NEAR
        name = f"default of {verdict.scene}" if len(verdicts) > 1 else "default"
        chosen += [
            (name, verdict.default, state),
            ("as accurate, quicker", verdict.faster, PLAIN),
            ("as quick, more accurate", verdict.better, PLAIN),
        ]
    if front:
        chosen += [
            ("the quickest", front[0].key, PLAIN),
            ("the most accurate", front[-1].key, PLAIN),
        ]
    by_key = {row.key: row for row in rows}
    lights = []
    for title, key, state in chosen:
        if key:
            row = by_key[key]
            unit = row.units if quantity in LENGTHS else ""
            cells = [
                number_cell(row.value(quantity), unit, state),
                number_cell(row.value("time_frame"), "s"),
            ]
            note = "" if row.role == "default" else _short(row)
            lights.append(CheckRow(title, cells, note=note))
    return lights


def _point_table(rows: list[SweepRow]) -> Table:
    settings = list(dict.fromkeys(key for row in rows for key in row.settings))
    head = [
        "scene",
        *settings,
        "role",
        "front",
        *(name.replace("_", " ") for name in SHOWN),
        "status",
    ]
    lines = []
    for row in rows:
        values = (str(row.settings.get(key, "")) for key in settings)
        numbers = (
            number_cell(row.value(name), "s" if name.startswith("time_") else "") for name in SHOWN
        )
        texts = row.scene, *values, row.role, "yes" if row.front else ""
        lines.append([*map(Cell, texts), *numbers, Cell(row.message or row.status)])
    return Table(head, lines)
