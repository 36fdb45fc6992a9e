"""``rbfmuscle run`` and ``rbfmuscle demo``: a scene through its motion, into a folder."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.scenes import PHANTOM, load_scene
from rbfmuscle.progress import Progress
from rbfmuscle.validation import RBFMuscleError

Output = Annotated[Path, Parameter(name=["--output", "-o"])]
Json = Annotated[bool, Parameter(name="--json", negative="")]
SHOWN = (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "solver_penetration_max",
    "rest_error_rms",
)


def demo(
    *,
    output: Output = Path("demo_output"),
    model: str | None = None,
    frames: str | None = None,
    as_json: Json = False,
) -> None:
    """Run the embedded hip: no data, no network.

    Parameters
    ----------
    output
        Folder for the results.
    model
        Model of every muscle.
    frames
        Frames of the motion, as A:B:S.
    as_json
        Print JSON and nothing else.
    """
    _run_scene(
        PHANTOM,
        output,
        model=model,
        frames=frames,
        settings={},
        fail_on=None,
        as_json=as_json,
    )


def run(
    scene: Path,
    *,
    output: Output,
    model: str | None = None,
    settings: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
    frames: str | None = None,
    fail_on: str | None = None,
    as_json: Json = False,
) -> None:
    """Run a scene through its motion and write surfaces, metrics and a report.

    Parameters
    ----------
    scene
        Scene file (TOML), or "phantom" for the embedded hip.
    output
        Folder for the results.
    model
        Model of every muscle, in place of the scene's.
    settings
        KEY=VALUE, for instance model.centres=200 or contact.substep_angle=1; may be repeated.
    frames
        Frames of the motion, as A:B:S (B not included).
    fail_on
        Limits that end with exit code 6, for instance volume_error=0.001,penetration_max, or all.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.scene.settings import parse_settings

    changes = parse_settings(settings)
    _run_scene(
        scene,
        output,
        model=model,
        frames=frames,
        settings=changes,
        fail_on=fail_on,
        as_json=as_json,
    )


def _run_scene(scene, output, *, as_json, **asked):
    from rbfmuscle import interruption

    start = time.perf_counter()
    done = 0
    with Progress(Path(scene).stem) as progress, interruption.keeping(lambda: done > 0):
        from rbfmuscle.run import stream_run

        loaded = load_scene(scene)

        def advance(count, total):
            nonlocal done
            done = count
            progress(count, total)
            interruption.check()

        try:
            info = stream_run(
                loaded,
                output,
                progress=advance,
                **asked,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted, {done} frames are kept in {output}") from None
        except RBFMuscleError as error:
            if done and error.exit_code == 5:
                raise type(error)(f"{error}; {done} frames are kept in {output}") from None
            raise
    if as_json:
        from rbfmuscle.output.writer import json_text

        print(json_text({"directory": str(output), **info}))
    else:
        _print_summary(info["muscles"], loaded.units)
        print(f"verdict: {info['verdict']}")
        report = output / "report.html"
        there = f"in {output}, open {report}" if report.exists() else f"in {output}"
        print(f"{len(info['frames'])} frames in {time.perf_counter() - start:.1f} s, {there}")


def _print_summary(muscles, units):
    """The worst of each muscle over all frames; lengths in the scene's unit."""
    from rbfmuscle.metrics.summary import shown_number

    muscles = {name: facts for name, facts in muscles.items() if any(key in facts for key in SHOWN)}
    if muscles:
        width = max(len(name) for name in muscles)
        print(f"worst over the frames; lengths in {units}")
        print(" ".join([" " * width, *(f"{key:>22}" for key in SHOWN)]))
    for name, facts in muscles.items():
        worst = [abs(facts.get(key, {}).get("worst", math.nan)) for key in SHOWN]
        print(" ".join([f"{name:{width}}", *(f"{shown_number(value):>22}" for value in worst)]))
