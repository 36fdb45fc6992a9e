"""How a process that runs a module of ours is started, wherever the library lies."""

import os
import subprocess
import sys
from pathlib import Path


def child_call(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a process that runs one of our modules with this interpreter.

    Nothing that lies in the present folder takes the place of a module there.
    """
    command = [sys.executable, "-P", "-m", module, *arguments]
    places = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}


def start_child(module: str, threads: int) -> subprocess.Popen[bytes]:
    """Such a process, spoken to by its pipes, whose loops and BLAS use so many threads."""
    command, environment = child_call(module)
    counts = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment |= dict.fromkeys(counts, str(threads))
    # A group of its own: an interrupt is for this process, which ends the child.
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0
    )
