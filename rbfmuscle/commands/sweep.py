"""``rbfmuscle sweep``: a scene under a grid of settings, error against time a frame."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from rbfmuscle.commands.run import Json, Output
from rbfmuscle.commands.scenes import load_scene
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.run import Run
    from rbfmuscle.sim.scene.scene import Scene


Texts = Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)]


def sweep(
    *scene: str,
    output: Output,
    grid: Texts = None,
    model: str | None = None,
    frames: str | None = None,
    reference: Texts = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    task: str | None = None,
    merge: Annotated[list[Path] | None, Parameter(negative="", consume_multiple=True)] = None,
    error: str = "error_rms",
    retry: Annotated[bool, Parameter(negative="")] = False,
    settings: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
    as_json: Json = False,
) -> None:
    """Run a scene under a grid of settings: errors, time a frame, Pareto front; or the scenes of a cohort.

    What the folder holds already is not run again, so a sweep that was ended goes on where it stood.

    Parameters
    ----------
    scene
        Scene file (TOML), or "phantom" for the embedded hip; for a cohort a table of subjects and trials (CSV with the
        columns subject, trial, scene, motion, model, frames and settings), a pattern in quotes, or several files.
    output
        Folder for the results; with --merge, of the merged sweep.
    grid
        KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300; MODEL:KEY=a,b for one
        model of a grid with model=...
    model
        Model of every muscle, in place of the scene's.
    frames
        Frames of the motion, as A:B:S.
    reference
        KEY=VALUE settings of the reference that errors are measured against; by default the finest values
        of the grid.
    jobs
        Points beside each other; all cores by default. The cores are shared out among them.
    scheduler
        Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must see the folder.
    task
        I/N, the I-th of N slices, for an array job; 0/N runs the references alone.
    merge
        Folders of a sweep's tasks, to be gathered in the output folder.
    error
        The quantity that the front trades against time.
    retry
        Run points or jobs again that failed before.
    settings
        KEY=VALUE for all jobs of a cohort, as for run --set; a column of the table goes before it.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.study.cohort.jobs import is_cohort
    from rbfmuscle.study.experiment.sweep import SweepFolder, check_key, parse_task
    from rbfmuscle.study.experiment.sweep_points import VALUES

    check_key(error, VALUES)
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs must be 1 or more, got {jobs}")
    if is_cohort(scene):
        from rbfmuscle.commands.cohort import check_options, sweep_cohort
        from rbfmuscle.sim.scene.settings import parse_settings

        check_options(grid=grid, reference=reference, task=task, merge=merge)
        asked = {"model": model, "frames": frames, "settings": parse_settings(settings)}
        how: dict[str, Any] = {"jobs": jobs, "scheduler": scheduler, "retry": retry, "as_json": as_json}
        return sweep_cohort(scene, output, asked=asked, **how)
    if settings:
        raise UsageError("--set is for a cohort; settings of one scene belong into its --grid or its file")
    if merge:
        from rbfmuscle.study.experiment.sweep_table import merge_sweeps

        if scene or grid or task:
            raise UsageError("--merge takes the folders of a sweep, no scene, grid or task")
        return _finish(merge_sweeps(merge, output), output, error, as_json)
    if not scene:
        raise UsageError("give a scene file, or --merge with the folders of a sweep")
    part = parse_task(task) if task else None
    plan, ready = _measure(scene[0], output, grid, model, frames, reference, jobs, scheduler, part, retry)
    if part and any(SweepFolder(output).read(point.key) is None for point in plan.points):
        return _finish_task(plan, ready, output, as_json)
    return _finish(plan, output, error, as_json)


def run_point(scene: Scene, settings: dict[str, Any], frames: str | None) -> Run:
    """One run of a sweep, in memory; module-level, so that it can be sent to other processes."""
    from rbfmuscle.run import simulate

    return simulate(scene, settings=settings, frames=frames)


def _measure(scene, output, grid, model, frames, reference, jobs, scheduler, part, retry):
    from rbfmuscle import interruption
    from rbfmuscle.models import configure_scene
    from rbfmuscle.sim.scene.settings import parse_settings
    from rbfmuscle.study.experiment.sweep import parse_grid, plan_sweep
    from rbfmuscle.study.experiment.sweep_runner import SweepRunner

    axes = parse_grid(grid or [])
    loaded = configure_scene(load_scene(scene), model=model)
    chosen = parse_settings(reference)
    plan = plan_sweep(loaded, axes, frames=frames, reference=chosen)
    for point in plan.points:  # a mistyped key is told now, not after the first point
        configure_scene(loaded, point.settings)
    with Progress(f"sweep of {loaded.name}", what="point") as progress, interruption.keeping(lambda: True):
        runner = SweepRunner(
            run_point, loaded, plan, output, frames=frames, jobs=jobs, scheduler=scheduler, progress=progress
        )
        try:
            runner.run(part=part, retry=retry)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted; finished points are kept in {output}, the same command goes on"
            ) from None
    return plan, runner.total


def _finish_task(plan, measured, output, as_json):
    if as_json:
        print(json.dumps({"directory": str(output), "measured": measured, "points": len(plan.points)}))
    else:
        print(
            f"{measured} points measured; when all tasks are done: rbfmuscle sweep --merge {output} -o {output}"
        )


def _finish(plan, output, error, as_json):
    from rbfmuscle.study.experiment.sweep_table import write_table
    from rbfmuscle.study.files.writer import json_text
    from rbfmuscle.study.show.sweep_page import write_page

    table = write_table(plan, output, quantity=error)
    write_page(table, output)
    if as_json:
        print(json_text({"directory": str(output), **table}))
    else:
        for verdict in table["verdicts"]:
            print(verdict["text"])
        print(
            f"{table['done']} points done, {table['failed']} failed, {table['missing']} missing, "
            f"in {output}, open {output / 'sweep.html'}"
        )
    bad = [row for row in table["rows"] if row["status"] != "done"]
    if bad:
        for row in bad[:5]:
            print(f"rbfmuscle: point {row['label']}: {row['error'] or row['status']}", file=sys.stderr)
        raise SolveError(
            f"{len(bad)} of {len(table['rows'])} points failed or are missing; the others are kept"
        )
