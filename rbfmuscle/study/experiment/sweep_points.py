"""Measuring the points of a sweep: one after another, side by side, or on a cluster."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.experiment.sweep import SweepFolder
from rbfmuscle.study.measure.metrics import ALL, surface_distance
from rbfmuscle.validation import MissingPartError, RBFMuscleError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene
    from rbfmuscle.study.experiment.sweep import SweepPlan, SweepPoint


CONNECT_WITHIN = 20  # seconds for a scheduler and its first two workers
# What a point may fail with and leave the others standing.
POINT_ERRORS = (
    RBFMuscleError,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
# Worst over muscles and frames, by magnitude.
WORST = (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "solver_penetration_max",
    "rest_error_rms",
    "edge_strain_rms",
    "components",
)
TIMES = ("time_frame", "time_frame_p95", "time_extract")
VALUES = ("error_rms", "error_max", *WORST, *TIMES)


def measure_point(
    runner: Callable[..., Any],
    scene: Scene,
    point: SweepPoint,
    folder: SweepFolder,
    *,
    frames: str | None = None,
    threads: int = 1,
    jobs: int = 1,
) -> dict[str, Any]:
    """Run one point, measure it and keep the result; an error becomes the result of a failed point.

    Parameters
    ----------
    runner : callable
        ``runner(scene, settings, frames)`` gives a finished `Run`; module-level, so that it can be sent away.
    scene : Scene
    point : SweepPoint
    folder : SweepFolder
    frames : str, optional
    threads, jobs : int
        Threads for this point, and how many points run beside each other.

    Returns
    -------
    dict
        As kept in ``points/KEY.json``.
    """
    start = time.perf_counter()
    result = {
        "key": point.key,
        "settings": point.settings,
        "status": "done",
        "error": "",
        "values": {},
        "threads": threads,
        "jobs": jobs,
        "machine": platform.node(),
        "process": os.getpid(),
    }
    marker = folder.points / f"{point.key}.running"
    marker.touch()
    try:
        with threads_limited(threads):
            run = runner(scene, point.settings, frames)
            result["values"] = _values_of(run)
            _compare(run, point, folder, result)
    except POINT_ERRORS as error:
        _fail(result, error)
    result["seconds"] = time.perf_counter() - start
    folder.write(result)
    marker.unlink(missing_ok=True)
    return result


def finish_point(point: Any, folder: Any) -> Any:
    """Compare a point that was run before its reference was there."""
    result, waiting = folder.read(point.key, waiting=True), folder.waiting_file(point.key)
    result["status"] = "done"
    try:
        poses, arrays = _kept_surfaces(waiting, 0)
        _take_error(_shown_of(poses, arrays), point, folder, result)
    except POINT_ERRORS as error:
        _fail(result, error)
    folder.write(result)
    return result


def _fail(result, error):
    result["status"] = "failed"
    result["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"


def _compare(run, point, folder, result):
    """Keep a reference's surfaces; take another point's distance to them, or keep its own until they are there."""
    shown = [
        (_pose_name(frame.coordinates), {n: (s.vertices, s.faces) for n, s in frame.surfaces.items()})
        for frame in run.frames
    ]
    if point.is_reference:
        # float32 is 1e-7 of a length, far below any error measured against it
        _keep_surfaces(shown, folder.surface_file(point.key), np.float32)
    elif folder.surface_file(point.reference).exists() or folder.read(point.reference) is not None:
        _take_error(shown, point, folder, result)
    else:
        _keep_surfaces(shown, folder.waiting_file(point.key), np.float64)
        result["status"] = "waiting"


def _take_error(shown, point, folder, result):
    rms, worst = _distance_to(shown, folder.surface_file(point.reference))
    result["values"] = {"error_rms": rms, "error_max": worst, **result["values"]}


class threads_limited:
    """Context in which loops and BLAS use so many threads."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __enter__(self) -> None:
        import numba
        from threadpoolctl import threadpool_limits

        self.before = numba.get_num_threads()
        numba.set_num_threads(max(1, min(self.count, numba.config.NUMBA_NUM_THREADS)))
        self.limits = threadpool_limits(self.count)

    def __exit__(self, *error: Any) -> None:
        import numba

        self.limits.restore_original_limits()
        numba.set_num_threads(self.before)


def _values_of(run):
    values = {}
    for muscle, quantities in run.summary.items():
        for name in WORST:
            worst = abs(quantities.get(name, {}).get("worst", math.nan))
            if muscle != ALL and not math.isnan(worst):
                values[name] = max(values.get(name, 0.0), worst)
    # The first frame loads and compiles, and settles what overlaps at rest.
    walls = np.array([frame.wall for frame in run.frames][1:] or [run.frames[0].wall])
    values["time_frame"], values["time_frame_p95"] = float(np.median(walls)), float(np.percentile(walls, 95))
    extract = [
        sum(surface.quantities.get("time_extract", 0.0) for surface in frame.surfaces.values())
        for frame in run.frames
    ]
    values["time_extract"] = float(np.median(extract[1:] or extract))
    return values


def _pose_name(coordinates):
    return " ".join(f"{name}={angle:.9f}" for name, angle in sorted(coordinates.items())) or "rest"


def _keep_surfaces(shown, path, kind):
    """Surfaces of every frame in one file, written in one move."""
    arrays = {"poses": np.array([pose for pose, _ in shown])}
    for index, (_, surfaces) in enumerate(shown):
        for name, (vertices, faces) in surfaces.items():
            arrays[f"v:{index}:{name}"] = np.asarray(vertices, dtype=kind)
            arrays[f"f:{index}:{name}"] = np.asarray(faces, dtype=np.int32)
    fresh = path.with_name(f".{os.getpid()}.{path.name}")
    np.savez_compressed(fresh, **arrays)
    os.replace(fresh, path)


@lru_cache(maxsize=2)
def _kept_surfaces(path, _modified):
    with np.load(path) as file:
        poses = {str(pose): index for index, pose in enumerate(file["poses"])}
        return poses, {name: file[name] for name in file.files if name != "poses"}


def _shown_of(poses, arrays):
    """What `_keep_surfaces` was given."""
    shown = [(pose, {}) for pose in poses]
    for label, vertices in arrays.items():
        kind, index, name = label.split(":", 2)
        if kind == "v":
            shown[int(index)][1][name] = vertices, arrays[f"f:{index}:{name}"]
    return shown


def _distance_to(shown, path):
    """Surface distance to the reference, root mean square over frames and muscles, and greatest."""
    try:
        poses, arrays = _kept_surfaces(path, path.stat().st_mtime_ns)
    except FileNotFoundError:
        raise UsageError(
            f"the reference {path.stem} is missing: its point failed, or the folder is not shared"
        ) from None
    squares, worst = [], 0.0
    for pose, surfaces in shown:
        index = poses.get(pose)
        if index is None:
            continue
        for name, (vertices, faces) in surfaces.items():
            other = arrays[f"v:{index}:{name}"].astype(float), arrays[f"f:{index}:{name}"].astype(np.int64)
            rms, most = surface_distance(vertices, faces, *other)
            squares.append(rms**2)
            worst = max(worst, most)
    if not squares:
        raise UsageError("no frame of this point is at a pose of the reference")
    return math.sqrt(float(np.mean(squares))), worst


class SweepRunner:
    """Measures what is missing of a sweep.

    Parameters
    ----------
    runner, scene, plan, directory
        See `measure_point` and `SweepPlan`.
    frames : str, optional
    jobs : int, optional
        Points beside each other; all cores by default. Each gets cores / jobs threads.
    scheduler : str, optional
        Address of a Dask scheduler whose workers see the folder too.
    progress : callable, optional
        ``progress(done, total)``.
    """

    def __init__(
        self,
        runner: Callable[..., Any],
        scene: Scene,
        plan: SweepPlan,
        directory: Path,
        *,
        frames: str | None = None,
        jobs: int | None = None,
        scheduler: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.runner, self.scene, self.plan, self.frames = runner, scene, plan, frames
        self.folder = SweepFolder(os.path.abspath(directory))
        self.cores = available_cores()
        # The same threads for every point of a sweep, so that times compare. A Dask worker has one.
        self.jobs = 1 if scheduler else jobs or self.cores
        self.threads = 1 if scheduler else max(1, self.cores // self.jobs)
        self.scheduler, self.progress = scheduler, progress
        self.done = 0

    def run(self, *, part: tuple[int, int] | None = None, retry: bool = False) -> int:
        """Measure the references, then the points of a slice (all by default), leaving out what is there.

        Returns
        -------
        int
            How many points were measured.
        """
        self.folder.prepare(self.plan)
        wanted = self.plan.slice(part)
        if retry:
            self._forget_failed(self.plan.references + wanted)
        for point in self.plan.references:
            found = self.folder.read(point.key)
            if found and found["status"] == "done" and not self.folder.surface_file(point.key).exists():
                self.folder.forget(point.key)
        # The references first: who is done before they are there keeps its surfaces, and is compared later.
        points = self._missing(self.plan.references + wanted)
        self.total = len(points)
        self._measure(self._unmeasured(points))
        late = [p for p in points if self.folder.is_waiting(p.key)]
        if late:
            self._side_by_side(delayed_calls(finish_point, ((p, self.folder) for p in late)), advance=False)
        return self.total

    def _missing(self, points):
        return [point for point in points if self.folder.read(point.key) is None]

    def _unmeasured(self, points):
        return [point for point in self._missing(points) if not self.folder.is_waiting(point.key)]

    def _forget_failed(self, points):
        for point in points:
            found = self.folder.read(point.key)
            if found and found["status"] == "failed":
                self.folder.forget(point.key)

    def _measure(self, points):
        """All points of a stage; a process that dies takes only its own point along."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        if not points:
            return
        options = {"frames": self.frames, "threads": self.threads, "jobs": self.jobs}
        calls = ((self.runner, self.scene, point, self.folder) for point in points)
        try:
            self._side_by_side(delayed_calls(measure_point, calls, **options))
        except TerminatedWorkerError:
            left = self._unmeasured(points)
            suspects = [p for p in left if (self.folder.points / f"{p.key}.running").exists()]
            for point in suspects or left:
                self._alone(point)
            self._measure(self._unmeasured(left))

    def _side_by_side(self, tasks, *, advance=True):
        from joblib import Parallel, parallel_config

        config = {"backend": "sequential"}
        if self.jobs > 1:
            config = {"backend": "loky", "inner_max_num_threads": self.threads}
        with self._cluster() as client:
            if client is not None:
                config = {"backend": "dask", "client": client}
            with parallel_config(**config):
                count = -1 if client else self.jobs
                for _ in Parallel(n_jobs=count, return_as="generator_unordered", batch_size=1)(tasks):
                    if advance:
                        self._advance()

    def _alone(self, point):
        """A point that was under way when a process died: in a process of its own, so that it shows which."""
        kept = {"frames": self.frames, "threads": self.threads, "jobs": 1}
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                pool.submit(measure_point, self.runner, self.scene, point, self.folder, **kept).result()
            except BrokenProcessPool:
                error = "the process ended without a word (out of memory, or a crash)"
                self.folder.write(
                    {
                        "key": point.key,
                        "settings": point.settings,
                        "status": "failed",
                        "error": error,
                        "values": {},
                    }
                )
                (self.folder.points / f"{point.key}.running").unlink(missing_ok=True)
        self._advance()

    def _cluster(self):
        """Context of a connection to the scheduler, of None where there is none."""
        # With one thread in all, joblib would not send anything away.
        return connect_cluster(self.scheduler, 2) if self.scheduler else nullcontext()

    def _advance(self):
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)


def connect_cluster(scheduler: str, least: int) -> Any:
    """A client of a Dask scheduler, as soon as so many workers are there.

    Raises
    ------
    MissingPartError
        If Dask is not installed.
    UsageError
        If no scheduler with workers answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingPartError(
            "Dask is not installed, which --scheduler needs: pip install 'rbfmuscle[cluster]'"
        ) from error
    try:
        client = Client(scheduler, timeout=CONNECT_WITHIN)
        client.wait_for_workers(least, timeout=CONNECT_WITHIN)
    except (OSError, ValueError) as error:
        many = "two workers" if least == 2 else "a worker"
        raise UsageError(f"no Dask scheduler with {many} answers at {scheduler!r} ({error})") from None
    return client


def delayed_calls(function: Callable[..., Any], calls: Iterator[Any], **options: Any) -> Iterator[Any]:
    """joblib's tasks for calls with these positional arguments."""
    from joblib import delayed

    return (delayed(function)(*arguments, **options) for arguments in calls)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
