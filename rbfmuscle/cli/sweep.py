"""``rbfmuscle sweep``: one or several scenes under a grid of settings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.cli.options import Frames, Model, Output, Settings, Texts
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SolveError, UsageError, did_you_mean

if TYPE_CHECKING:
    from rbfmuscle.run import Run
    from rbfmuscle.scene.scene import Scene


def sweep(
    *scenes: str,
    output: Output,
    grid: Texts = None,
    model: Model = None,
    settings: Settings = None,
    frames: Frames = None,
    reference: Texts = None,
    jobs: int | None = None,
    cluster: str | None = None,
    error: str = "error_rms",
) -> None:
    """Run scenes under a grid of settings: errors, time per frame, Pareto front.

    Points that the folder holds done are not run again.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for the embedded hip.
    grid
        KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300.
    reference
        KEY=VALUE settings of the reference that errors are measured against; by default the finest values
        of the grid.
    jobs
        Points beside each other; all cores by default. The cores are shared out among them.
    cluster
        Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must see the folder.
    error
        The quantity that the front trades against time.
    """
    from rbfmuscle import interruption
    from rbfmuscle.experiments.sweep import parse_grid, plan_sweep
    from rbfmuscle.experiments.sweep_run import VALUES, run_sweep
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    if error not in VALUES:
        raise UsageError(f"unknown quantity {error!r}, {did_you_mean(error, VALUES)}")
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs must be 1 or more, got {jobs}")
    axes, changes = parse_grid(grid or []), parse_settings(settings)
    if not scenes or (len(scenes) == 1 and not axes):
        raise UsageError("a sweep needs several scenes, or a grid, for instance --grid model.centres=100,200")
    loaded = {
        name: configure_scene(open_scene(path), changes, model=model) for name, path in _names(scenes).items()
    }
    points = plan_sweep(loaded, axes, frames=frames, reference=parse_settings(reference))
    for point in points:  # a mistyped key is reported now, not after the first point
        configure_scene(loaded[point.scene], point.settings, frames=frames)
    options: dict[str, Any] = {"frames": frames, "jobs": jobs, "cluster": cluster}
    progress = Progress(f"sweep of {len(points)} points", what="point")
    with progress, interruption.keeping(lambda: f"finished points are kept in {output}"):
        run_sweep(run_point, loaded, points, output, progress=progress, **options)
    _finish(points, output, {name: scene.units for name, scene in loaded.items()}, error)


def _names(scenes):
    """Scene files by their names, or by those of their folders where names are the same."""
    for names in (
        [Path(path).stem for path in scenes],
        [Path(path).resolve().parent.name for path in scenes],
    ):
        if len(set(names)) == len(names):
            return dict(zip(names, scenes))
    raise UsageError("scenes of a sweep need different names, or folders of different names")


def run_point(scene: Scene, settings: dict[str, Any], frames: str | None) -> Run:
    """One run of a sweep, in memory; module-level, so that it can be sent to other processes."""
    from rbfmuscle.run import simulate

    return simulate(scene, settings=settings, frames=frames)


def _finish(points, output, units, error):
    from rbfmuscle.experiments.sweep_run import write_table
    from rbfmuscle.report.sweep_page import write_page

    table = write_table(points, output, units, quantity=error)
    write_page(table, output)
    for verdict in table["verdicts"]:
        print(verdict["text"])
    print(f"{table['done']} points done, {table['failed']} failed, in {output}, open {output}/sweep.html")
    bad = [row for row in table["rows"] if row["status"] != "done"]
    for row in bad[:5]:
        print(f"rbfmuscle: {row['scene']} {row['label']}: {row['error'] or row['status']}", file=sys.stderr)
    if bad:
        raise SolveError(
            f"{len(bad)} of {len(table['rows'])} points failed; the others are kept, the same command runs these again"
        )
