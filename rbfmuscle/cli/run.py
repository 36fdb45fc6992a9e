"""``rbfmuscle run`` and ``rbfmuscle demo``: a scene through its motion, into a folder."""

import time
from functools import partial
from pathlib import Path

from rbfmuscle.cli.options import (
    FailOn,
    Frames,
    Jobs,
    Model,
    Muscles,
    Output,
    SceneName,
    Settings,
    chosen_muscles,
    threads,
)
from rbfmuscle.cli.printing import USUAL, Printing, print_result
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, RBFMuscleError, SolveError


def demo(
    *,
    output: Output = Path("demo_output"),
    model: Model = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    jobs: Jobs = None,
    printing: Printing = USUAL,
) -> int:
    """Run the embedded hip: no data, no network. The same as `run phantom`."""
    return run(
        Path("phantom"),
        output=output,
        model=model,
        frames=frames,
        fail_on=fail_on,
        jobs=jobs,
        printing=printing,
    )


def run(
    scene: SceneName,
    *,
    output: Output,
    model: Model = None,
    settings: Settings = None,
    muscles: Muscles = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    jobs: Jobs = None,
    printing: Printing = USUAL,
) -> int:
    """Run a scene through its motion and write surfaces, metrics and a report.

    Parameters
    ----------
    muscles
        Muscles to simulate, separated by commas, without the others and without [sliding]; all by
        default.
    """
    from rbfmuscle import interruption

    start, done = time.perf_counter(), 0

    def kept():
        return f"{done} frames are kept in {output}" if done else ""

    def advance(count, total):
        nonlocal done
        done = count
        progress(count, total)
        interruption.check()

    failed: RBFMuscleError | None = None
    with Progress(scene.stem) as progress, interruption.keeping(kept), threads(jobs):
        from rbfmuscle.output.run_data import RunData
        from rbfmuscle.run import stream_run
        from rbfmuscle.scene.phantom import open_scene
        from rbfmuscle.scene.settings import parse_settings

        changes, loaded = parse_settings(settings), open_scene(scene)
        if muscles is not None:
            loaded.muscles, loaded.sliding = chosen_muscles(loaded, muscles), None
        limited = partial(stream_run, frames=frames, fail_on=fail_on, progress=advance)
        try:
            limited(loaded, output, model=model, settings=changes)
        except SolveError as error:
            failed = SolveError("; ".join(filter(None, [str(error), kept()])))
            if not done:
                raise failed from None
        except LimitExceededError as error:
            failed = error
        info = RunData.load(output).info
    facts = {"directory": str(output), **info.to_dict()}
    seconds = time.perf_counter() - start
    return print_result(printing, facts, _lines(output, len(info.frames), seconds), error=failed)


def _lines(output, frames, seconds):
    from rbfmuscle.cli.verdict import verdict_lines

    yield from verdict_lines(output)
    report = output / "report.html"
    there = f"in {output}, open {report}" if report.exists() else f"in {output}"
    yield f"{frames} frames in {seconds:.1f} s, {there}"
