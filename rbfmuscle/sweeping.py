"""Sweeps: runs of one or several scenes under a grid of settings, with tables and a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rbfmuscle.experiments.sweep import plan_sweep
from rbfmuscle.experiments.sweep_run import VALUES, OnProgress, run_sweep, write_table
from rbfmuscle.experiments.sweep_table import SweepTable
from rbfmuscle.folders import given_folder
from rbfmuscle.models import configure_scene
from rbfmuscle.report.sweep_page import write_page
from rbfmuscle.run import Run, simulate
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import UsageError, did_you_mean


def sweep(
    scenes: Mapping[str, Scene],
    grid: Mapping[str, Sequence[object]],
    directory: str | Path | None = None,
    *,
    frames: str | None = None,
    reference: Mapping[str, object] | None = None,
    jobs: int | str | None = None,
    error: str = "error_rms",
    progress: OnProgress | None = None,
) -> SweepTable:
    """Run scenes under every combination of some settings, and write tables and a page.

    Points that the folder, where one is given, holds done are not run again.

    Parameters
    ----------
    scenes : mapping of str to Scene
        Scenes by name.
    grid : mapping of str to sequence
        Values of each dotted key, as ``{"model.centres": [100, 200]}``; empty, the scenes are
        compared as they are.
    directory : path, optional
        New, empty, or that of an earlier sweep; without one nothing is kept but what is returned.
    frames : str, optional
        Frames of the motion, "A:B:S".
    reference : mapping, optional
        Settings of the run that errors are measured against, over the finest values of the grid.
    jobs : int or str, optional
        Points that run at the same time, as many as cores by default; or the address of a Dask
        scheduler whose workers see the folder.
    error : str
        The error on the axis of the Pareto front.
    progress : callable, optional
        Called with the number of points that are done, and of all.

    Returns
    -------
    SweepTable
        ``done``, ``failed``, ``verdicts`` and ``rows``, one per point, as in ``sweep.json``.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene, sweep
    >>> scene = phantom_scene(end=0.0, spacing=6.0).with_options(model="pbd")
    >>> table = sweep({"hip": scene}, {}, jobs=1)
    >>> table.done, len(table.rows)
    (1, 1)
    """
    if error not in VALUES:
        raise UsageError(f"unknown quantity {error!r}, {did_you_mean(error, VALUES)}")
    if isinstance(jobs, int) and jobs < 1:
        raise UsageError(f"jobs must be 1 or more, got {jobs}")
    if isinstance(jobs, str) and directory is None:
        raise UsageError("a cluster needs a folder that its workers see")
    values = {key: list(several) for key, several in grid.items()}
    points = plan_sweep(scenes, values, frames=frames, reference=reference)
    for point in points:  # a mistyped key is reported now, not after the first point
        configure_scene(scenes[point.scene], point.settings, frames=frames)
    units = {name: scene.units for name, scene in scenes.items()}
    with given_folder(directory) as folder:
        run_sweep(run_point, scenes, points, folder, frames=frames, jobs=jobs, progress=progress)
        table = write_table(points, folder, units, quantity=error)
        write_page(table, folder)
    return table


def run_point(scene: Scene, settings: dict[str, object], frames: str | None) -> Run:
    """One run of a sweep, in memory; module-level, so that it can be sent to other processes."""
    return simulate(scene, settings=settings, frames=frames)
