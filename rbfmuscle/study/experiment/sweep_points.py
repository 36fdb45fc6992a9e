"""Measuring the points of a sweep: one after another, side by side, or on a cluster."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.experiment.sweep import SweepFolder
from rbfmuscle.study.experiment.workers import threads_limited
from rbfmuscle.study.measure.metrics import surface_distance
from rbfmuscle.study.measure.quantities import ALL
from rbfmuscle.validation import RBFMuscleError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene
    from rbfmuscle.study.experiment.sweep import SweepPoint


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
