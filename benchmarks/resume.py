"""Runs that are killed at random moments and resumed, against one that was not: the same folder but for times.

    python benchmarks/resume.py --kills 10 --seed 1

Each run is a process of its own, ended by SIGKILL; then the same command goes on. Frames that were lost are those
since the last checkpoint.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from blend_model import files_in
from run_folders import timeless

RUN = """
import sys
from rbfmuscle import phantom_scene
from rbfmuscle.run import stream_run
settings = {"output.report": False, "output.preview": False}
stream_run(phantom_scene(end=60.0), sys.argv[1], settings=settings, pictures=False, resume=True)
"""


def start(folder: Path) -> subprocess.Popen:
    """Begin a run, or go on with one."""
    return subprocess.Popen([sys.executable, "-c", RUN, str(folder)])


def frames_in(folder: Path) -> int:
    """Whole frames that a killed run has left, as its readers find them."""
    from rbfmuscle.study.files.saved import SavedRun

    return len(SavedRun(folder).frames) if (folder / "run.json").exists() else 0


def main() -> int:
    """Kill, resume, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    draw, same = random.Random(asked.seed), 0
    with tempfile.TemporaryDirectory() as home:
        whole = Path(home) / "whole"
        begun = time.perf_counter()
        if start(whole).wait():
            return 1
        length = time.perf_counter() - begun
        print(f"unbroken: {frames_in(whole)} frames in {length:.1f} s")
        for number in range(asked.kills):
            folder = Path(home) / f"killed{number}"
            process = start(folder)
            moment = draw.uniform(0.1, 1.0) * length
            time.sleep(moment)
            process.kill()
            process.wait()
            there = frames_in(folder)
            ended = start(folder).wait()
            names = files_in(whole)
            alike = files_in(folder) == names and all(
                timeless(whole / name) == timeless(folder / name) for name in names
            )
            same += alike and ended == 0
            print(
                f"killed after {moment:5.1f} s with {there:2d} whole frames: {'the same' if alike else 'OTHER'}"
            )
    print(f"{same} of {asked.kills} the same")
    return same != asked.kills


if __name__ == "__main__":
    sys.exit(main())
