"""``rbfmuscle sweep``: scenes under a grid of settings."""

import sys

from rbfmuscle.cli.options import (
    USUAL,
    FailOn,
    Frames,
    Jobs,
    Model,
    Output,
    Pairs,
    Printing,
    Settings,
    named_scenes,
    one_line,
    print_result,
    refuse,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, RBFMuscleError, SolveError, UsageError


def sweep(
    *scenes: str,
    output: Output,
    grid: Pairs = None,
    reference: Pairs = None,
    quantity: str | None = None,
    model: Model = None,
    settings: Settings = None,
    frames: Frames = None,
    jobs: Jobs = None,
    cluster: str | None = None,
    fail_on: FailOn = None,
    printing: Printing = USUAL,
) -> int:
    """Run scenes under a grid of settings: errors, time per frame, Pareto front.

    Points that are already done in the folder are not run again.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for a hip made by formulas.
    grid
        KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300; may be
        repeated.
    reference
        KEY=VALUE of the reference that errors are measured against; may be repeated; by default the
        finest values of the grid.
    quantity
        The error on the axis of the Pareto front, error_rms by default; the other axis is time.
    cluster
        Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must see the
        folder.
    """
    from rbfmuscle import interruption
    from rbfmuscle.metrics.summary import parse_limits
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.studies.sweep import parse_grid
    from rbfmuscle.studies.sweep import sweep as run_scenes

    values, changes = parse_grid(grid or []), parse_settings(settings)
    if not values:
        refuse("a sweep without --grid", {"--reference": reference, "--quantity": quantity})
    if cluster is not None:
        refuse("--cluster", {"--jobs": jobs})
    if not scenes or (len(scenes) == 1 and not values):
        raise UsageError(
            "a sweep needs several scenes, or a grid, for instance --grid model.centres=100,200"
        )
    opened = {name: open_scene(path) for name, path in named_scenes(scenes).items()}
    loaded = {name: configure_scene(each, changes, model=model) for name, each in opened.items()}
    limits = {name: parse_limits(fail_on, each) for name, each in loaded.items()}
    progress = Progress("sweep", what="point")
    with progress, interruption.keeping(lambda: f"finished points are kept in {output}"):
        table = run_scenes(
            loaded,
            output,
            grid=values,
            frames=frames,
            reference=parse_settings(reference),
            jobs=cluster or jobs,
            quantity=quantity or "error_rms",
            progress=progress,
        )
    bad = [row for row in table.rows if row.status != "done"]
    for row in bad[:5]:
        reason = one_line(row.message or row.status)
        print(f"rbfmuscle: {row.scene} {row.label}: {reason}", file=sys.stderr)
    remedy = "the others are kept, the same command runs these again"
    failed: RBFMuscleError | None = None
    if bad:
        failed = SolveError(f"{len(bad)} of {len(table.rows)} points failed; {remedy}")
    elif texts := list(_failures(table, output, limits)):
        failed = LimitExceededError("; ".join(texts[:5]))
    lines = [
        *(verdict.text for verdict in table.verdicts),
        f"{table.done} points done, {table.failed} failed, in {output}, open {output}/sweep.html",
    ]
    return print_result(printing, table.model_dump(), lines, error=failed)


def _failures(table, output, limits):
    """What each point is beyond a limit of ``--fail-on`` of its scene, in words."""
    from rbfmuscle.metrics.verdict import describe_failures
    from rbfmuscle.studies.sweep import SweepFolder

    folder = SweepFolder(output)
    for row in table.rows:
        for text in describe_failures(folder.read(row.key).get("summary", {}), limits[row.scene]):
            yield f"{row.scene} {row.label}: {text}"
