"""Running the points of a sweep side by side, in processes or on a Dask cluster; tables and Pareto
front.
"""

import json
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from rbfmuscle.experiments.front import WORST, mark_front
from rbfmuscle.experiments.sweep import SweepPoint
from rbfmuscle.experiments.sweep_table import SweepRow, SweepTable
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.threads import threads_limited
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.metrics.summary import QuantityFacts, Table
from rbfmuscle.output.run_data import RunData
from rbfmuscle.output.writer import write_csv, write_json
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Mesh
from rbfmuscle.validation import MissingDependencyError, RBFMuscleError, SolveError, UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_WITHIN = 20  # seconds for a scheduler and its first two workers
Runner = Callable[[Scene, dict[str, object], str | None], RunData]
OnProgress = Callable[[int, int], None]  # of what is done and the total
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
    error: str
    values: dict[str, float | None]
    summary: Table  # of the run, as limits read it
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
    frames: str | None = None,
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


def _connect_cluster(address: str) -> "Client":
    """A client of a Dask scheduler, as soon as two workers are there: to one alone joblib sends
    nothing.
    """
    try:
        from distributed import Client
    except ImportError as error:
        message = (
            "Dask is not installed, which a cluster needs: pip install -e '.[cluster]' in "
            "rbfmuscle's folder"
        )
        raise MissingDependencyError(message) from error
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
                    error = "the process ended without a message (out of memory, or a crash)"
                    folder.write({"key": call[2].key, "status": "failed", "error": error})
            advance(recount=True)  # of some that are done the pool has not said so
        _side_by_side(left[jobs:], folder, jobs, advance)
    except RuntimeError as error:  # of Dask, where worker after worker dies of a point
        raise SolveError(f"a point ended its workers ({error}); finished points are kept") from None


def measure_point(
    runner: Runner,
    scene: Scene,
    point: SweepPoint,
    folder: SweepFolder,
    frames: str | None,
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
        "error": "",
        "threads": threads,
        "machine": platform.node(),
        "process": os.getpid(),
    }
    try:
        with threads_limited(threads):
            run = runner(scene, point.settings, frames)
            values = _values(run)
            every = [(frame, *named) for frame in run.frames for named in frame.surfaces.items()]
            shown = {f"{_pose(frame)}|{name}": (s.vertices, s.faces) for frame, name, s in every}
            if point.role == "reference":
                arrays = {f"{place}|{k}": mesh[k] for place, mesh in shown.items() for k in (0, 1)}
                fresh = folder.references / f".{point.key}.{os.getpid()}.npz"
                np.savez_compressed(fresh, allow_pickle=False, **arrays)
                os.replace(fresh, folder.surfaces(point.key))
            elif point.reference:
                values |= _errors(shown, folder.surfaces(point.reference))
            result["values"] = values
            result["summary"] = run.summary
    except POINT_ERRORS as error:
        result["status"] = "failed"
        result["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"
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


def _pose(frame):
    values = sorted(frame.coordinates.items())
    return " ".join(f"{name}={round(value, 9) + 0.0:.9f}" for name, value in values) or "rest"


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
    rows = []
    for point in points:
        result = folder.read(point.key)
        values = result.get("values", {})
        row = SweepRow(
            scene=point.scene,
            units=units[point.scene],
            role=point.role,
            status=result.get("status", "missing"),
            settings=point.settings,
            values={name: value for name, value in values.items() if value is not None},
            seconds=result.get("seconds"),
            threads=result.get("threads"),
            machine=result.get("machine", ""),
            error=result.get("error", ""),
            label=point.label,
            reference=point.reference,
            key=point.key,
        )
        rows.append(row)
    return rows


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
    write_csv(folder.directory / "sweep.csv", _lines(rows))
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
    return table


def _lines(rows: Sequence[SweepRow]) -> Iterator[list[object]]:
    """Lines of ``sweep.csv``: settings, then facts and values of each point."""
    keys = list(dict.fromkeys(key for row in rows for key in row.settings))
    first = ("scene", "units", "role", "status", "front")
    last = ("seconds", "threads", "machine", "error", "reference", "key")
    yield [*keys, *first, *VALUES, *last]
    for row in rows:
        cells = [row.settings.get(key, "") for key in keys]
        cells += [getattr(row, name) for name in first]
        cells += [row.value(name) for name in VALUES]
        cells += ["" if getattr(row, name) is None else getattr(row, name) for name in last]
        # Digits beyond nine places are rounding.
        yield [f"{round(v, 9):.6g}" if isinstance(v, float) else v for v in cells]
