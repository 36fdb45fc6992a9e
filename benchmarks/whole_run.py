"""How long a whole run takes, with everything written: `rbfmuscle run`, caches warm.

    python benchmarks/whole_run.py SCENE.toml [...] [--models rbf,pbd] [--frames A:B:S]
        [--repeat N] [-o docs/evidence/whole_run.json]

Processor time of one thread, and the part of it that a run of one frame takes as well; medians. The
first run of each scene and model, which compiles and builds, does not count.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from evidence import write_evidence

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = ["scene", "model", "frames", "whole run [s]", "of it before the second frame [s]"]


def used(scene, model, frames, folder):
    """Processor time of a run [s]."""
    words = [
        "run",
        str(scene),
        "-o",
        folder,
        "--model",
        model,
        *(["--frames", frames] * bool(frames)),
    ]
    environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", "rbfmuscle", *words],
        env={**environment, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(scene, model, frames, repeat):
    """A row of the table."""
    first = (frames or "0").partition(":")[0] or "0"
    one = f"{first}:{int(first) + 1}"
    with tempfile.TemporaryDirectory() as folder:
        used(scene, model, frames, folder)
        whole = [used(scene, model, frames, folder) for _ in range(repeat)]
        count = len(list(Path(folder, "surfaces").glob("*.vtp")))
        names = {path.name.rpartition("_")[0] for path in Path(folder, "surfaces").glob("*.vtp")}
        start = [used(scene, model, one, folder) for _ in range(repeat)]
    written = count // len(names)
    return [scene.stem, model, written, float(np.median(whole)), float(np.median(start))]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--models", default="rbf,pbd")
    parser.add_argument("--frames", default="")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    rows = []
    for scene in given.scenes:
        for model in given.models.split(","):
            rows.append(measure(scene, model, given.frames, given.repeat))
            print(*rows[-1], sep="  ")
    if given.output:
        command = ["benchmarks/whole_run.py", *map(str, given.scenes)]
        write_evidence(given.output, command, rows, COLUMNS)


if __name__ == "__main__":
    main()
