"""Runs cases, each in a process of its own, and says what became of it.

One process loads the program once, runs the small scene once with each model, and is then forked
for every case: what ends a case ends no other, and its memory and time are its own.
"""

import math
import os
import re
import resource
import shutil
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import igl
import numpy as np

CLEAN_CODES = (2, 3, 4, 5, 6, 7)
FINE, CLEAN = "fine", "clean error"
BUG = "a bug told as such, or a traceback"
DEATH = "death of the process"
TIMEOUT = "more than 20 s"
MEMORY = "more than 2 GB"
NOISE = "more than one line, or a library's own"
WRONG = "NaN or a wrong volume, and code 0"
OUTCOMES = (CLEAN, FINE, BUG, DEATH, TIMEOUT, MEMORY, NOISE, WRONG)
SECONDS = 20  # processor time of a case; a sleeping one ends by the wall clock after:
HANG = 300
MOST_MEMORY = 2_000_000  # KB
LONGEST = 1200  # characters of a message
WRONG_CODE = 99
# Beside the one line of an error: warnings, frames, and, where it takes long, what goes on and
# since when.
EXPECTED = re.compile(
    r"rbfmuscle: (warning: |compiling loops )|\w+: (frame \d+ of \d+|[a-z ]+) \(\d+ s\)$"
)


class WrongResult(Exception):
    """A case passed for fine whose result is not."""


def run_case(action: Callable[[], int], folder: Path) -> tuple[str, str, float]:
    """Run one case in a forked process; its outcome, what it said, and the processor time it took
    [s].
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    said = folder / "said.txt"
    # What waits in a buffer would be written by both processes.
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _limit(said, folder.parent)
        code = 1
        try:
            code = action()
        except WrongResult as error:
            print(f"wrong: {error}", file=sys.stderr)
            code = WRONG_CODE
        except BaseException:  # noqa: BLE001 - what reaches this is what is looked for
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    _, status, usage = os.wait4(pid, 0)
    text = said.read_text(errors="replace") if said.exists() else ""
    shutil.rmtree(folder, ignore_errors=True)
    return _judge(status, usage, text), text, usage.ru_utime + usage.ru_stime


def _limit(said, folder):
    """Bound the time of this process, and catch what it prints, compiled libraries included."""
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(HANG)
    target = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(target, 1)
    os.dup2(target, 2)
    os.chdir(folder)


def _judge(status, usage, text):
    if os.WIFSIGNALED(status):
        return (
            TIMEOUT
            if os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM, signal.SIGKILL)
            else DEATH
        )
    if usage.ru_maxrss > MOST_MEMORY:
        return MEMORY
    code = os.WEXITSTATUS(status)
    if code == WRONG_CODE:
        return WRONG
    if code not in (0, *CLEAN_CODES) or "Traceback" in text or ": a bug:" in text:
        return BUG
    lines = [line for line in text.splitlines() if not EXPECTED.match(line)]
    if any(len(line) > LONGEST for line in text.splitlines()):
        return NOISE
    if code == 0:
        return FINE if not lines else NOISE
    return CLEAN if len(lines) == 1 and lines[0].startswith("rbfmuscle: ") else NOISE


def tell(error: Exception) -> int:
    """Print an error meant for users as the command line does; its exit code."""
    from rbfmuscle.cli.app import one_line

    print(f"rbfmuscle: {one_line(error)}", file=sys.stderr)
    return error.exit_code


def show_warnings() -> None:
    """Let warnings be told as the command line tells them."""
    warnings.simplefilter("always")
    warnings.showwarning = lambda message, *rest, **more: print(
        f"rbfmuscle: warning: {' '.join(str(message).split())}", file=sys.stderr
    )


def check_finite(values, name: str) -> None:
    """Raise WrongResult unless there are values, all finite."""
    if not (len(values) and np.isfinite(values).all()):
        raise WrongResult(f"{name} is empty or not finite")


def check_volume(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Raise WrongResult unless the divergence theorem agrees with winding numbers of places tried
    at random.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    box = float(np.prod(high - low))
    if not (math.isfinite(volume) and 0 < volume <= box * (1 + 1e-9)):
        raise WrongResult(f"{name}: volume {volume} in a box of {box}")
    places = low + (high - low) * np.random.default_rng(0).random((600, 3))
    share = float((igl.winding_number(vertices, faces, places) > 0.5).mean())
    # Four deviations of a share found from 600 places, and a tenth for surfaces that cross
    # themselves a little.
    allowed = 0.1 * volume / box + 4 * math.sqrt(max(share * (1 - share), 1e-3) / 600)
    if abs(share - volume / box) > allowed:
        raise WrongResult(f"{name}: volume {volume:.4g}, but {share * box:.4g} inside the surface")
