"""Signals at random moments of a run, the first import included: does each end with 130 and keep what is done?

python benchmarks/interrupts.py --moments 50 --seed 5 [--scene SCENE.toml]
python benchmarks/interrupts.py --kills 10 --seed 5        # SIGKILL, then export and render what is there

Each case starts the command anew and sends one SIGINT or SIGTERM after a random share of the time that a whole run
takes here. Told are the exit codes, tracebacks, and whether the frames that were left can be read and exported.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from rbfmuscle.study.files.export import export_run
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.show.render import render_run
from rbfmuscle.validation import RBFMuscleError

PROGRAM = [sys.executable, "-m", "rbfmuscle"]


def words(scene: str | None, folder: Path) -> list[str]:
    """The command: a scene's run, or the embedded hip's."""
    if scene is None:
        return [*PROGRAM, "demo", "-o", str(folder), "--frames", "0:12"]
    return [*PROGRAM, "run", scene, "-o", str(folder), "--frames", "0:12"]


def strike(command: list[str], delay: float, number: int) -> tuple[int, str]:
    """Start the command, send it the signal after the delay; its exit code and what it said."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    time.sleep(delay)
    process.send_signal(number)
    said = process.communicate()[1]
    return process.returncode, said


def what_is_kept(folder: Path, *, render: bool) -> str:
    """Whether the folder that was left can be used: nothing yet, or every frame that it has."""
    if not (folder / "run.json").exists():
        return "no folder yet"
    try:
        kept = SavedRun(folder)
        if not kept.frames or not kept.has_surfaces():
            return "no frame yet"
        for frame in kept.frames:
            for muscle in kept.muscles:
                vertices, faces = kept.surface(muscle, frame)
                if not (len(faces) and np.isfinite(vertices).all()):
                    return "a surface that is broken"
        export_run(folder, ["stl"])
        if render:
            render_run(folder, folder / "kept.png")
    except RBFMuscleError as error:
        return f"not usable: {error}"
    return "frames, read and exported"


def told(code: int, said: str, kills: bool) -> str:
    """What became of the command."""
    lines = [line for line in said.splitlines() if "Traceback" in line or ": a bug" in line]
    if lines:
        return f"code {code} with a traceback"
    if kills and code == -signal.SIGKILL:
        return "killed"
    if code < 0:
        return f"ended by the signal, as Python was starting ({code})"
    return f"code {code}"


def main() -> None:
    """Print a table of what became of the cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene")
    parser.add_argument("--moments", type=int, default=0)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as place:
        started = time.perf_counter()
        subprocess.run(words(arguments.scene, Path(place) / "whole"), check=True, capture_output=True)
        whole = time.perf_counter() - started
        table: Counter = Counter()
        for number in range(arguments.moments + arguments.kills):
            kills, folder = number >= arguments.moments, Path(place) / f"case{number}"
            # Half of the moments lie in the first second, where libraries are imported.
            early = number % 2 == 0 and not kills
            delay = float(rng.uniform(0.0, 1.0 if early else whole))
            how = signal.SIGKILL if kills else (signal.SIGINT, signal.SIGTERM)[number // 2 % 2]
            code, said = strike(words(arguments.scene, folder), delay, how)
            outcome = told(code, said, kills), what_is_kept(folder, render=kills)
            table["SIGKILL" if kills else "first second" if early else "later", *outcome] += 1
            if "traceback" in outcome[0] or "broken" in outcome[1] or "usable" in outcome[1]:
                print(f"case {number}, after {delay:.3f} s: {outcome}\n{said[-600:]}", flush=True)
    print(f"a whole run: {whole:.1f} s")
    print("| moment | ended with | kept | cases |\n|---|---|---|---|")
    for (when, ended, kept), count in sorted(table.items()):
        print(f"| {when} | {ended} | {kept} | {count} |")


if __name__ == "__main__":
    main()
