"""Runs and comparisons that are killed at random moments and resumed, against one that was not: the same but for times.

    python benchmarks/resume.py --kills 10 --seed 1
    python benchmarks/resume.py --kills 10 --seed 1 --what compare

Each is a process of its own, ended by SIGKILL; then the same command goes on. Frames of a run that were lost are those
since the last checkpoint; a comparison keeps the models that it has measured.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from blend_model import files_in
from run_folders import timeless, without_times

RUN = """
import sys
from rbfmuscle import phantom_scene
from rbfmuscle.run import stream_run
settings = {"output.report": False, "output.preview": False}
stream_run(phantom_scene(end=60.0), sys.argv[1], settings=settings, pictures=False, resume=True)
"""
COMPARE = """
import sys
from rbfmuscle import phantom_scene
from rbfmuscle.compare import compare_models
compare_models(phantom_scene(end=8.0), sys.argv[1], ["rbf", "pbd", "xpbd"], pictures=False, resume=True)
"""
# Rows of tables that a clock or the process's size wrote, and files that show them.
COSTS, SHOWN = (",time_", ",memory,"), ("report.html", "measures.npz")


def start(folder: Path, code: str) -> subprocess.Popen:
    """Begin a run or a comparison, or go on with one."""
    return subprocess.Popen([sys.executable, "-c", code, str(folder)])


def left_in(folder: Path, code: str) -> str:
    """What a killed process has left, as its readers find it."""
    from rbfmuscle.study.files.saved import SavedRun

    if code == COMPARE:
        return f"{len(list(folder.glob('*/measures.npz')))} models measured"
    frames = len(SavedRun(folder).frames) if (folder / "run.json").exists() else 0
    return f"{frames} whole frames"


def content(path: Path) -> Any:
    """What a file holds, without what a clock wrote into it."""
    if path.name == "comparison.json":
        return _without_costs(without_times(json.loads(path.read_text())))
    if path.name == "comparison.csv":
        return [line for line in path.read_text().splitlines() if not any(word in line for word in COSTS)]
    return None if path.name in SHOWN else timeless(path)


def _without_costs(value: Any) -> Any:
    """A tree without memory, and without verdicts on times and memory."""
    if isinstance(value, dict):
        return {key: _without_costs(item) for key, item in value.items() if key != "memory"}
    if not isinstance(value, list):
        return value
    judged = [str(item.get("quantity", "") if isinstance(item, dict) else item) for item in value]
    return [_without_costs(v) for v, name in zip(value, judged) if not name.startswith(("time_", "memory"))]


def same(one: Path, other: Path) -> bool:
    """Whether two folders hold the same."""
    names = files_in(one)
    return files_in(other) == names and all(content(one / name) == content(other / name) for name in names)


def main() -> int:
    """Kill, resume, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--what", choices=("run", "compare"), default="run")
    asked = parser.parse_args()
    code = RUN if asked.what == "run" else COMPARE
    draw, alike = random.Random(asked.seed), 0
    with tempfile.TemporaryDirectory() as home:
        whole = Path(home) / "whole"
        begun = time.perf_counter()
        if start(whole, code).wait():
            return 1
        length = time.perf_counter() - begun
        print(f"unbroken: {left_in(whole, code)} in {length:.1f} s", flush=True)
        for number in range(asked.kills):
            folder = Path(home) / f"killed{number}"
            process = start(folder, code)
            moment = draw.uniform(0.1, 1.0) * length
            time.sleep(moment)
            process.kill()
            process.wait()
            there, ended = left_in(folder, code), start(folder, code).wait()
            good = ended == 0 and same(whole, folder)
            alike += good
            print(f"killed after {moment:5.1f} s with {there}: {'the same' if good else 'OTHER'}", flush=True)
    print(f"{alike} of {asked.kills} the same")
    return alike != asked.kills


if __name__ == "__main__":
    sys.exit(main())
