"""Runs the tests of one fault after another, each in a child of a process that has the heavy packages loaded.

The child works in a copy of the tree, so a fault never lies in the checkout, and nothing that it leaves behind meets
the next one. Compiled loops are kept by content: with the compiler on, a fault in plain Python costs no compiling; a
fault in a loop is run with the compiler off.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAVY = (
    "numpy", "scipy.linalg", "scipy.sparse.linalg", "scipy.spatial.transform", "scipy.optimize", "scipy.interpolate",
    "numba", "trimesh", "pydantic", "pytest", "hypothesis", "matplotlib.figure", "skimage.measure", "igl", "cyclopts",
)  # fmt: skip
LEFT_OUT = (".git", ".venv", ".mutants", "__pycache__", "images", "*.egg-info", ".hypothesis", "demo_output")


def copy_tree(target: Path) -> None:
    """A fresh copy of the checkout."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)


def preload() -> None:
    """Load what no fault can touch, once."""
    for name in HEAVY:
        importlib.import_module(name)


def run_tests(tree: Path, tests: list[str], *, compiler: bool, seconds: float) -> str:
    """ "noticed", "unnoticed", "slow" (noticed by the time it takes), or "wrong" where no test could be run."""
    child = os.fork()
    if child == 0:
        _be_child(tree, tests, compiler)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return {0: "unnoticed", 4: "wrong", 5: "wrong"}.get(code, "noticed")
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "slow"


def _be_child(tree, tests, compiler):
    """Never returns: runs pytest in the tree, silently, and ends with its code."""
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    os.chdir(tree)
    paths = [str(tree), str(tree / "benchmarks"), str(tree / "tests")]
    own = str(ROOT)
    sys.path[:] = paths + [
        p for p in sys.path if p and not (p == own or p.startswith(own + os.sep + "benchmarks"))
    ]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.dont_write_bytecode = True
    if not compiler:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
        from numba.core import config

        config.DISABLE_JIT = 1
    code = 3
    try:
        import pytest

        code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", *tests]))
    finally:
        os._exit(code)
