"""``rbfmuscle run`` and ``rbfmuscle demo``: a scene through its motion, into a folder."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.cli.options import Frames, Json, Model, Output, SceneName, Settings, chosen_muscle
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, SolveError

if TYPE_CHECKING:
    from rbfmuscle.output.info import RunInfo


def demo(
    *,
    output: Output = Path("demo_output"),
    model: Model = None,
    frames: Frames = None,
    as_json: Json = False,
) -> int:
    """Run the embedded hip: no data, no network."""
    return run(Path("phantom"), output=output, model=model, frames=frames, as_json=as_json)


def run(
    scene: SceneName,
    *,
    output: Output,
    model: Model = None,
    settings: Settings = None,
    muscle: str | None = None,
    frames: Frames = None,
    fail_on: str | None = None,
    as_json: Json = False,
) -> int:
    """Run a scene through its motion and write surfaces, metrics and a report.

    Parameters
    ----------
    muscle
        Name of one muscle to simulate, without the others and without [sliding]; all by default.
    fail_on
        Limits, by commas: a value beyond one of them, or none at all, makes the exit code 6. For
        instance volume_error=0.001,penetration_max, or all.
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

    with Progress(scene.stem) as progress, interruption.keeping(kept):
        from rbfmuscle.run import stream_run
        from rbfmuscle.scene.phantom import open_scene
        from rbfmuscle.scene.settings import parse_settings

        changes, loaded = parse_settings(settings), open_scene(scene)
        if muscle is not None:
            loaded.muscles, loaded.sliding = [chosen_muscle(loaded, muscle)], None
        options: dict[str, Any] = {"model": model, "frames": frames, "fail_on": fail_on}
        failed: dict[str, Any] = {}
        try:
            info = stream_run(loaded, output, settings=changes, progress=advance, **options)
        except SolveError as error:
            raise SolveError("; ".join(filter(None, [str(error), kept()]))) from None
        except LimitExceededError as error:
            info, failed = error.info, {"error": str(error), "exit_code": error.exit_code}
    if as_json:
        from rbfmuscle.output.writer import json_text

        print(json_text({"directory": str(output), **info.to_dict(), **failed}))
    else:
        _print_result(info, output, time.perf_counter() - start)
    if failed:
        print(f"rbfmuscle: {failed['error']}", file=sys.stderr)
    return failed.get("exit_code", 0)


def _print_result(info: "RunInfo", output: Path, seconds: float) -> None:
    print(f"verdict: {info.verdict}")
    report = output / "report.html"
    there = f"in {output}, open {report}" if report.exists() else f"in {output}"
    print(f"{len(info.frames)} frames in {seconds:.1f} s, {there}")
