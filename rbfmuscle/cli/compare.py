"""``rbfmuscle compare``: models on one or several scenes."""

from __future__ import annotations

from rbfmuscle.cli.options import (
    USUAL_WORK,
    FailOn,
    Frames,
    Output,
    Settings,
    Work,
    named_scenes,
    split_list,
)
from rbfmuscle.cli.printing import print_result
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, SolveError


def compare(
    *scenes: str,
    output: Output,
    models: str | None = None,
    settings: Settings = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    pictures: bool = True,
    work: Work = USUAL_WORK,
) -> int:
    """Run models on one or several scenes: the same motion, contacts and measures; tables, report,
    pictures.

    Each model's run is in a folder of its own, for several scenes in a folder for each;
    MODEL:KEY=VALUE is a setting for one model.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for a hip made by formulas.
    models
        Models, separated by commas, for instance rbf,pbd; distances are measured to the first. By
        default rbf, the mesh models and pbd-converged, which takes long: it sweeps until no vertex
        moves.
    pictures
        Draw pictures and the animation.
    """
    from rbfmuscle import interruption
    from rbfmuscle.metrics.summary import parse_limits
    from rbfmuscle.models import COMPARED
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    chosen, changes = split_list(models) or list(COMPARED), parse_settings(settings)
    opened = {name: open_scene(path) for name, path in named_scenes(scenes).items()}
    limits = {name: parse_limits(fail_on, each) for name, each in opened.items()}
    kept = f"finished runs are kept in {output}"
    with (
        Progress("compare") as progress,
        interruption.keeping(lambda: kept if output.exists() else ""),
        work.threads(),
    ):

        def advance(model, done, total):
            if done == 0:
                progress.show(model, done, total)
            progress(done, total)
            interruption.check()

        table = _compare(
            opened,
            output,
            chosen,
            frames=frames,
            settings=changes,
            pictures=pictures,
            progress=advance,
        )
    return (_print_one if len(opened) == 1 else _print_scenes)(table, output, limits, work)


def _compare(opened, output, models, **options):
    from rbfmuscle.compare import compare_models, compare_scenes

    if len(opened) > 1:
        return compare_scenes(opened, output, models, **options)
    (scene,) = opened.values()
    return compare_models(scene, output, models, **options)


def _print_one(table, output, limits, printing):
    """Print a comparison on one scene, and what did not finish or is beyond limits."""
    (limit,) = limits.values()
    error = _failure(table.failed, output) or _excess(table.models, output, limit)
    return print_result(printing, table.model_dump(), _table_lines(table, output), error=error)


def _print_scenes(table, output, limits, printing):
    """Print a comparison of several scenes, and what did not finish or is beyond limits."""
    failed = {
        f"{scene}, {model}": reason
        for scene, reasons in table.failed.items()
        for model, reason in reasons.items()
    }
    error = _failure(failed, output)
    for scene in table.scenes:
        beyond = _excess(table.models, output / scene, limits[scene])
        if beyond is not None and error is None:
            error = LimitExceededError(f"{scene}: {beyond}")
    lines = [
        *(f"{scene}: {answer}" for scene, answer in table.answers.items()),
        table.answer,
        f"{len(table.scenes)} scenes, in {output}, open {output / 'report.html'}",
    ]
    return print_result(printing, table.model_dump(), lines, error=error)


def _failure(failed, output):
    """The error that some models could not be solved; None where all were."""
    if not failed:
        return None
    reasons = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
    return SolveError(f"{reasons}; the other models are in {output}")


def _excess(models, output, limits):
    """The error that a run is beyond a limit of ``--fail-on``; None where none is."""
    from rbfmuscle.metrics.summary import Summary
    from rbfmuscle.output.run_data import RunData
    from rbfmuscle.report.verdict import require_limits

    texts = []
    for name in models if limits.fail_on else ():
        summary = Summary()
        summary.add(RunData.load(output / name).metrics)
        try:
            require_limits(summary.table(), limits)
        except LimitExceededError as error:
            texts.append(f"{name}: {error}")
    return LimitExceededError("; ".join(texts)) if texts else None


def _table_lines(table, output):
    from rbfmuscle.report.comparison_page import LIGHTS, shown

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
