"""SIGINT at random moments of several commands: does each end with 130, in one line, and keep what is done?

python benchmarks/interrupts.py --moments 60 --seed 5

Each case starts a command anew and interrupts it after a random share of the time that it took whole, the first import
and the last moments included; for `run` half of the moments lie where frames are being made. Whatever a command leaves
must be usable: frames whole and exported, tables and scenes readable. A command that was done before the signal came
ends with 0, and counts as such.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from combined_motions import phantom_files

from rbfmuscle.study.files.export import export_run
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.validation import RBFMuscleError

PROGRAM = [sys.executable, "-m", "rbfmuscle"]
# Python's own start, before anything of ours can be asked [s]: signals are sent after it.
PYTHON = 0.05
# For so many cases of `run` there is one of each other command.
CYCLE = ("run", "run frames", "compare", "run frames", "kernels", "run", "new", "run frames")


class Command(NamedTuple):
    """Words of a command that writes into a folder, and what says in which state a folder is that was left."""

    words: Callable[[Path], list[str]]
    kept: Callable[[Path], str]


def kept_run(folder: Path) -> str:
    """Whether every frame that a run has left is whole and can be exported."""
    if not (folder / "run.json").exists():
        return "nothing yet"
    kept = SavedRun(folder)
    if not kept.frames or not kept.has_surfaces():
        return "no frame yet"
    for frame in kept.frames:
        for muscle in kept.muscles:
            vertices, faces = kept.surface(muscle, frame)
            if not (len(faces) and np.isfinite(vertices).all()):
                return "BROKEN"
    export_run(folder, ["stl"])
    return "frames, exported"


def kept_models(folder: Path) -> str:
    """The same of each model that a comparison has begun."""
    if not folder.exists():
        return "nothing yet"
    if (folder / "comparison.json").exists():
        json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    found = {kept_run(path) for path in folder.iterdir() if path.is_dir()}
    return "BROKEN" if "BROKEN" in found else max(found, key=len, default="nothing yet")


def kept_study(folder: Path) -> str:
    """Whether a study of kernels is whole, or not there."""
    tables = sorted(folder.glob("*.csv"))
    return (
        "whole files" if all(path.read_text().endswith("\n") for path in tables) and tables else "nothing yet"
    )


def kept_scene(folder: Path) -> str:
    """Whether the scene file is whole, or not there."""
    path = folder / "scene.toml"
    if not path.exists():
        return "nothing yet"
    return "whole files" if "muscle" in tomllib.loads(path.read_text(encoding="utf-8")) else "BROKEN"


def one_muscle(path: Path) -> Path:
    """A scene file with the first of its muscles alone."""
    head, first, *_ = path.read_text(encoding="utf-8").split("[[muscle]]")
    short = path.with_name("short.toml")
    short.write_text(f"{head}[[muscle]]{first}", encoding="utf-8")
    return short


def commands(home: Path) -> dict[str, Command]:
    """The commands, on the embedded hip as files; those that solve take one of its muscles."""
    source = home / "source"
    source.mkdir()
    scene = str(one_muscle(phantom_files(source)))
    mesh = str(next(source.glob("*abductor*.ply")))
    meshes = home / "meshes"
    meshes.mkdir()
    for path in source.glob("*.ply"):
        (meshes / path.name).write_bytes(path.read_bytes())
    return {
        "run": Command(lambda out: ["run", scene, "-o", str(out), "--frames", "0:16"], kept_run),
        "compare": Command(
            lambda out: ["compare", scene, "-o", str(out), "--models", "rbf,pbd", "--frames", "0:6"],
            kept_models,
        ),
        "kernels": Command(
            lambda out: [
                "kernels",
                mesh,
                "-o",
                str(out),
                "--kernels",
                "cubic,quintic,linear",
                "--centres",
                "150,200",
            ],
            kept_study,
        ),
        "new": Command(
            lambda out: ["new", str(meshes), "--units", "mm", "-o", str(out / "scene.toml")], kept_scene
        ),
    }


def start(words: list[str]) -> subprocess.Popen:
    """A command whose SIGINT is not ignored, as it is in what a shell without job control starts with ``&``."""
    return subprocess.Popen(
        [*PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def whole_time(words: list[str], folder: Path) -> tuple[float, float]:
    """How long a command takes undisturbed, and when its first frame was there, if any is [s]."""
    begun = time.perf_counter()
    process, first = start(words), 0.0
    while process.poll() is None:
        if not first and any(folder.glob("surfaces/*_0000.*")):
            first = time.perf_counter() - begun
        time.sleep(0.02)
    if process.wait():
        raise SystemExit(process.communicate()[1])
    return time.perf_counter() - begun, first


def strike(words: list[str], delay: float) -> tuple[int, str]:
    """Start a command, interrupt it after the delay; its exit code and what it said."""
    process = start(words)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    return process.returncode, said


def ended(code: int, said: str) -> str:
    """What became of a command."""
    if "Traceback" in said or ": a bug" in said:
        return f"{code} with a TRACEBACK"
    return f"{code}" if code >= 0 else f"DEATH by signal {-code}"


def one_case(command: Command, folder: Path, delay: float) -> tuple[str, str]:
    """How a command ended that was interrupted, and what it left."""
    folder.mkdir(exist_ok=True)
    code, said = strike(command.words(folder), delay)
    try:
        kept = command.kept(folder)
    except (RBFMuscleError, OSError, ValueError) as error:
        kept = f"BROKEN: {error}"
    outcome = ended(code, said), kept
    if any(word in text for text in outcome for word in ("TRACEBACK", "DEATH", "BROKEN")):
        print(
            f"after {delay:.3f} s of {' '.join(command.words(folder)[:1])}: {outcome}\n{said[-600:]}",
            flush=True,
        )
    return outcome


def main() -> int:
    """Print a table of what became of the cases; 1 where one was not clean."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--moments", type=int, default=60)
    parser.add_argument("--seed", type=int, default=5)
    asked = parser.parse_args()
    rng, table = np.random.default_rng(asked.seed), Counter()
    with tempfile.TemporaryDirectory() as place:
        home = Path(place)
        known, times = commands(home), {}
        for name, command in known.items():
            out = home / f"whole_{name}"
            out.mkdir()
            times[name] = whole_time(command.words(out), out)
            print(f"{name}: {times[name][0]:.1f} s, first frame after {times[name][1]:.1f} s", flush=True)
        for number in range(asked.moments):
            name, _, late = CYCLE[number % len(CYCLE)].partition(" ")
            length, first = times[name]
            delay = float(rng.uniform(first if late else PYTHON, length))
            outcome = one_case(known[name], home / f"case{number}", delay)
            table[name, *outcome] += 1
    print("| command | ended with | kept | cases |\n|---|---|---|---|")
    for (name, code, kept), count in sorted(table.items()):
        print(f"| {name} | {code} | {kept} | {count} |")
    bad = sum(n for key, n in table.items() if key[1] not in ("0", "130") or "BROKEN" in key[2])
    print(
        f"{asked.moments - bad} of {asked.moments} clean; seed {asked.seed}, processes of {os.uname().sysname}"
    )
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
