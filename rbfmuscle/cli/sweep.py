"""``rbfmuscle sweep``: scenes under a grid of settings."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    UNCHANGED,
    USUAL,
    Changes,
    FailOn,
    Frames,
    Jobs,
    Output,
    Pairs,
    Printing,
    named_scenes,
    one_line,
    print_result,
    refuse,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, RBFMuscleError, SolveError, UsageError


@Parameter(name="*")
@dataclass(frozen=True)
class Axes:
    """What a sweep varies, and the quantity that it weighs against time."""

    grid: Annotated[
        Pairs,
        Parameter(
            help="KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300; "
            "may be repeated."
        ),
    ] = None
    reference: Annotated[
        Pairs,
        Parameter(
            help="KEY=VALUE of the reference that errors are measured against; may be repeated; by "
            "default the finest values of the grid."
        ),
    ] = None
    quantity: Annotated[
        str | None,
        Parameter(
            help="The error on the axis of the Pareto front, error_rms by default; the other axis "
            "is time."
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Workers:
    """Where the points of a sweep are run."""

    jobs: Jobs = None
    cluster: Annotated[
        str | None,
        Parameter(
            help="Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must "
            "see the folder."
        ),
    ] = None


NO_AXES = Axes()


USUAL_WORKERS = Workers()


def sweep(
    *scenes: str,
    output: Output,
    axes: Axes = NO_AXES,
    changes: Changes = UNCHANGED,
    frames: Frames = None,
    workers: Workers = USUAL_WORKERS,
    fail_on: FailOn = None,
    printing: Printing = USUAL,
) -> int:
    """Run scenes under a grid of settings: errors, time per frame, Pareto front.

    Points that are already done in the folder are not run again.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for a hip made by formulas.
    """
    from rbfmuscle import interruption
    from rbfmuscle.metrics.summary import parse_limits
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.studies.sweep import parse_grid
    from rbfmuscle.studies.sweep import sweep as run_scenes

    grid, settings = parse_grid(axes.grid or []), changes.parse_settings()
    if not grid:
        refuse(
            "a sweep without --grid", {"--reference": axes.reference, "--quantity": axes.quantity}
        )
    if workers.cluster is not None:
        refuse("--cluster", {"--jobs": workers.jobs})
    if not scenes or (len(scenes) == 1 and not grid):
        raise UsageError(
            "a sweep needs several scenes, or a grid, for instance --grid model.centres=100,200"
        )
    opened = {name: open_scene(path) for name, path in named_scenes(scenes).items()}
    loaded = {
        name: configure_scene(each, settings, model=changes.model) for name, each in opened.items()
    }
    limits = {name: parse_limits(fail_on, each) for name, each in loaded.items()}
    progress = Progress("sweep", what="point")
    with progress, interruption.keeping(lambda: f"finished points are kept in {output}"):
        table = run_scenes(
            loaded,
            output,
            grid=grid,
            frames=frames,
            reference=parse_settings(axes.reference),
            jobs=workers.cluster or workers.jobs,
            quantity=axes.quantity or "error_rms",
            progress=progress,
        )
    return _finish(table, output, limits, printing)


def _beyond(table, output, limits):
    """What the points hold beyond the limits of their scenes, and what they did not measure, in
    words.
    """
    from rbfmuscle.metrics.summary import exceeded, shown_number, unmeasured
    from rbfmuscle.studies.sweep import SweepFolder

    folder = SweepFolder(output)
    for row in table.rows:
        facts, held = folder.read(row.key).get("summary", {}), limits[row.scene].failing()
        for found in exceeded(facts, held):
            value = shown_number(found.value)
            yield (
                f"{row.scene} {row.label}: {found.muscle}, {found.quantity} {value} (limit "
                f"{shown_number(found.limit)})"
            )
        for lacking in unmeasured(facts, held):
            yield f"{row.scene} {row.label}: {lacking.quantity} was not measured"


def _finish(table, output, limits, printing):
    bad = [row for row in table.rows if row.status != "done"]
    for row in bad[:5]:
        reason = one_line(row.message or row.status)
        print(f"rbfmuscle: {row.scene} {row.label}: {reason}", file=sys.stderr)
    remedy = "the others are kept, the same command runs these again"
    failed: RBFMuscleError | None = None
    if bad:
        failed = SolveError(f"{len(bad)} of {len(table.rows)} points failed; {remedy}")
    elif beyond := list(_beyond(table, output, limits)):
        failed = LimitExceededError("; ".join(beyond[:5]))
    lines = [
        *(verdict.text for verdict in table.verdicts),
        f"{table.done} points done, {table.failed} failed, in {output}, open {output}/sweep.html",
    ]
    return print_result(printing, table.model_dump(), lines, error=failed)
