"""``rbfmuscle compare``: models on one scene."""

from rbfmuscle.cli.options import (
    USUAL_WORK,
    FailOn,
    Frames,
    Output,
    SceneName,
    Settings,
    Work,
    print_result,
    split_list,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, SolveError


def compare(
    scene: SceneName,
    *,
    output: Output,
    models: str = "rbf,pbd",
    settings: Settings = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    pictures: bool = True,
    work: Work = USUAL_WORK,
) -> int:
    """Run models on a scene: the same motion, contacts and measures; tables, report, pictures.

    Each model's run is in a folder of its own; MODEL:KEY=VALUE is a setting for one model.

    Parameters
    ----------
    models
        Models, separated by commas; distances are measured to the first. Of others the
        converged ones, as pbd-converged, take long: they sweep until no vertex moves.
    pictures
        Draw pictures and the animation.
    """
    from rbfmuscle import interruption
    from rbfmuscle.metrics.summary import parse_limits
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.studies.compare import compare as run_models

    changes, opened = parse_settings(settings), open_scene(scene)
    limits = parse_limits(fail_on, opened)
    kept = f"finished runs are kept in {output}"
    with (
        Progress("compare") as progress,
        interruption.keeping(lambda: kept if output.exists() else ""),
    ):
        table = run_models(
            opened,
            output,
            models=split_list(models),
            settings=changes,
            frames=frames,
            jobs=work.jobs,
            pictures=pictures,
            progress=progress,
        )
    error = None
    if texts := list(_failures(table.models, output, limits)):
        error = LimitExceededError("; ".join(texts))
    if table.failed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in table.failed.items())
        error = SolveError(f"{reasons}; the other models are in {output}")
    return print_result(work, table.model_dump(), _table_lines(table, output), error=error)


def _failures(models, output, limits):
    """What each run is beyond a limit of ``--fail-on``, in words."""
    from rbfmuscle.metrics.verdict import describe_failures
    from rbfmuscle.run.data import RunData

    for name in models if limits.fail_on else ():
        for text in describe_failures(RunData.load(output / name).summarise(), limits):
            yield f"{name}: {text}"


def _table_lines(table, output):
    from rbfmuscle.studies.compare import LIGHTS, shown

    # As many columns as a terminal holds stand beside each other.
    for k in range(0, len(table.models), 3):
        names = table.models[k : k + 3]
        yield " " * 24 + "".join(f"{name:>18}" for name in names)
        for quantity in LIGHTS:
            values = [table.results[name]["all"].get(quantity) for name in names]
            cells = [f"{shown(table, quantity, value):>18}" for value in values]
            yield f"{quantity:24}" + "".join(cells)
    yield table.answer
    yield f"{table.frames} frames, in {output}, open {output / 'report.html'}"
