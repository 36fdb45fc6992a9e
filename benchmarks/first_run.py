"""The first minute: what a cold `rbfmuscle demo` costs until its first frame is written, and what it says meanwhile.

    python benchmarks/first_run.py [--against CHECKOUT] [--model rbf] [--frames A:B:S] [-o FILE.json]

Runs the demo with empty caches, again with full ones, from a copy of the sources, and twice at once with empty ones;
with ``--against`` the same cold and warm runs of another checkout (which holds .venv/bin/python), in turn with our
own. Times are of the processor, of the process and all it started (Linux), beside wall times.
"""

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_TICK = os.sysconf("SC_CLK_TCK")


class Start:
    """A demo that runs: watched for its first frame, its processor time and its silences on stderr."""

    def __init__(self, checkout, caches, out, model):
        self.out, self.begun = Path(out), time.monotonic()
        environment = {
            **os.environ, "PYTHONPATH": str(checkout), "NUMBA_CACHE_DIR": str(caches / "numba"),
            "RBFMUSCLE_LOOPS": str(caches / "loops"), "RBFMUSCLE_CACHE": str(caches / "fields"),
        }  # fmt: skip
        call = "from rbfmuscle.cli import main; main()"
        command = [_python(checkout), "-c", call, "demo", "--model", model[0], "-o", str(out), *model[1:]]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(command, env=environment, cwd=out.parent, **pipes)
        self.spoken = [self.begun]
        self.thread = threading.Thread(target=self._listen)
        self.thread.start()
        self.first = None

    def _listen(self):
        while self.process.stderr.read1(65536):
            self.spoken.append(time.monotonic())

    def watch(self):
        """Look once; true while it runs."""
        if self.process.poll() is not None:
            return False
        used = _processor_time(self.process.pid)
        if used is not None:
            self.used = used
        if self.first is None and list((self.out / "surfaces").glob("*.vtp")):
            self.first = (self.used, time.monotonic() - self.begun)
        return True

    def facts(self):
        self.thread.join()
        end = time.monotonic()
        times = [*self.spoken, end]
        first = self.first or (self.used, end - self.begun)
        info = json.loads((self.out / "run.json").read_text())
        return {
            "exit_code": self.process.returncode,
            "first_frame_processor": round(first[0], 2), "first_frame_wall": round(first[1], 2),
            "all_processor": round(self.used, 2), "all_wall": round(end - self.begun, 2),
            "longest_silence": round(max(b - a for a, b in itertools.pairwise(times)), 2),
            "frame_median": round(info["frame_time"]["median"], 4),
        }  # fmt: skip


def _python(checkout):
    own = Path(checkout) / ".venv" / "bin" / "python"
    return str(own) if own.exists() else sys.executable


def _processor_time(pid):
    """Processor time [s] of a process, of its children that live and of those that have ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return None
    own = sum(int(fields[k]) for k in (11, 12, 13, 14)) / _TICK
    return own + sum(_processor_time(int(child)) or 0.0 for child in children)


def run(*starts):
    """Facts of demos that run at the same time."""
    while any([start.watch() for start in starts]):  # all are looked at
        time.sleep(0.02)
    return [start.facts() for start in starts]


def measure(place, checkout, model, name):
    """Cold, then warm."""
    caches = place / name
    caches.mkdir()
    found = {}
    for state in ("cold", "warm"):
        (found[state],) = run(Start(checkout, caches, place / f"{name}_{state}", model))
        print(f"{name} {state}: {found[state]}", flush=True)
    return found


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path)
    parser.add_argument("--model", default="rbf")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--brief", action="store_true", help="cold and warm runs only")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--frames", help="of the motion, as A:B:S; all by default")
    chosen = parser.parse_args()
    chosen.model = [chosen.model, *(["--frames", chosen.frames] if chosen.frames else [])]
    table = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for k in range(chosen.rounds):
            if chosen.against:
                table.setdefault("other", []).append(
                    measure(place, chosen.against, chosen.model, f"other{k}")
                )
            table.setdefault("own", []).append(measure(place, ROOT, chosen.model, f"own{k}"))
        if not chosen.brief:
            copy = place / "copy"
            for package in ("rbfmuscle", "pbd_baseline"):
                shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
            (table["copy"],) = run(Start(copy, place / "own0", place / "copied", chosen.model))
            print(f"copy of the sources, same cache: {table['copy']}", flush=True)
            both = place / "both"
            both.mkdir()
            starts = [Start(ROOT, both, place / f"both{k}", chosen.model) for k in range(2)]
            table["two_at_once"] = run(*starts)
            print(f"two at once, cold: {table['two_at_once']}", flush=True)
    if chosen.output:
        chosen.output.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
