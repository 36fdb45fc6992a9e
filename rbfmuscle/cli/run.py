"""``rbfmuscle run`` and ``rbfmuscle demo``: a scene through its motion, into a folder."""

import time
from itertools import chain
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL_WORK,
    FailOn,
    Frames,
    Model,
    Output,
    SceneName,
    Settings,
    Work,
    keep_muscles,
    print_result,
)
from rbfmuscle.cli.report import verdict_lines
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, RBFMuscleError, SolveError

Simulated = Annotated[
    str | None,
    Parameter(help="Muscles to simulate, separated by commas, without the others; all by default."),
]


def demo(
    *,
    output: Output = Path("demo_output"),
    model: Model = None,
    settings: Settings = None,
    muscles: Simulated = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    work: Work = USUAL_WORK,
) -> int:
    """Run the phantom hip: no data, no network. A word for `run phantom -o demo_output`."""
    return run(
        Path("phantom"),
        output=output,
        model=model,
        settings=settings,
        muscles=muscles,
        frames=frames,
        fail_on=fail_on,
        work=work,
    )


def run(
    scene: SceneName,
    *,
    output: Output,
    model: Model = None,
    settings: Settings = None,
    muscles: Simulated = None,
    frames: Frames = None,
    fail_on: FailOn = None,
    work: Work = USUAL_WORK,
) -> int:
    """Run a scene through its motion and write surfaces, metrics and a report."""
    from rbfmuscle import interruption

    start, progress = time.perf_counter(), Progress(scene.stem)

    def kept():
        return f"{progress.done} frames are kept in {output}" if progress.done else ""

    failed: RBFMuscleError | None = None
    with progress, interruption.keeping(kept), work.threads():
        from rbfmuscle.recording import stream_run
        from rbfmuscle.run.data import RunData
        from rbfmuscle.scene.phantom import open_scene
        from rbfmuscle.scene.settings import parse_settings

        changes, loaded = parse_settings(settings), open_scene(scene)
        keep_muscles(loaded, muscles)
        try:
            stream_run(
                loaded,
                output,
                model=model,
                settings=changes,
                frames=frames,
                fail_on=fail_on,
                progress=progress,
            )
        except SolveError as error:
            failed = SolveError("; ".join(filter(None, [str(error), kept()])))
            if not progress.done:
                raise failed from None
        except LimitExceededError as error:
            failed = error
        saved = RunData.load(output)
    facts = {"directory": str(output), **saved.info.to_dict()}
    seconds = time.perf_counter() - start
    report = output / "report.html"
    there = f"in {output}, open {report}" if report.exists() else f"in {output}"
    last = f"{len(saved)} frames in {seconds:.1f} s, {there}"
    return print_result(work, facts, chain(verdict_lines(saved), [last]), error=failed)
