"""Runs the tests of one fault after another, each in a child of a process that has the heavy packages loaded.

The child works in a copy of the tree, so a fault never lies in the checkout, and nothing that it leaves behind meets
the next one. Compiled loops are kept by content: with the compiler on, a fault in plain Python costs no compiling; a
fault in a loop is run with the compiler off.
"""

from __future__ import annotations

import compileall
import importlib
import math
import os
import resource
import shutil
import signal
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Seconds of the processor after which a fault has been tried enough.
SPENT = 20.0
# No plugin of pytest (hypothesis): one that is loaded before pytest is a warning, and warnings are errors here.
HEAVY = (
    "numpy", "scipy.linalg", "scipy.sparse.linalg", "scipy.spatial.transform", "scipy.optimize", "scipy.interpolate",
    "numba", "trimesh", "pydantic", "matplotlib.figure", "skimage.measure", "igl", "cyclopts",
)  # fmt: skip
LEFT_OUT = (".git", ".venv", ".mutants", "__pycache__", "images", "*.egg-info", ".hypothesis", "demo_output")


def copy_tree(target: Path) -> None:
    """A fresh copy of the checkout, with the byte code that children then need not make."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
    for folder in ("rbfmuscle", "pbd_baseline", "benchmarks", "tests"):
        compileall.compile_dir(target / folder, quiet=2)


def preload() -> None:
    """Load what no fault can touch, once; threads of BLAS that spin would take the time of what is tried."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for name in HEAVY:
        importlib.import_module(name)


class Failures:
    """A pytest plugin that writes down the first test that failed, and ends the run when its time is spent."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path = path
        self.end = time.process_time() + seconds

    def pytest_runtest_logfinish(self, nodeid):
        if time.process_time() > self.end:
            # Fixtures and imports take what no recording foresees; the tests most apt to tell have run by now.
            os._exit(0 if not self.path.exists() else 1)

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.path.exists():
            self.path.write_text(report.nodeid, encoding="utf-8")


def run_tests(tree: Path, tests: list[str], *, compiler: bool, seconds: float) -> tuple[str, str]:
    """What became of the tests, and the first that failed.

    "noticed", "unnoticed", "slow" (noticed by the time it takes), or "wrong" where no test could be run. The test is ""
    where not a test failed but what comes before it: the import of a module, say. ``seconds`` are of the processor, so
    that a crowded machine makes nothing slow; a fault that waits for ever is ended by the clock, ten times later.
    """
    told = tree / ".failed"
    told.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 1))
        _be_child(tree, tests, compiler, Failures(told, SPENT))
    end = time.monotonic() + 10.0 * seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            first = told.read_text(encoding="utf-8") if told.exists() else ""
            outcomes = {0: "unnoticed", 5: "wrong", -signal.SIGXCPU: "slow", -signal.SIGKILL: "slow"}
            return outcomes.get(code, "noticed"), first
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "slow", ""


def _be_child(tree, tests, compiler, plugin):
    """Never returns: runs pytest in the tree, silently, and ends with its code."""
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    os.chdir(tree)
    paths = [str(tree), str(tree / "benchmarks"), str(tree / "tests")]
    own = str(ROOT)
    sys.path[:] = paths + [
        p for p in sys.path if p and p != own and not p.startswith(own + os.sep + "benchmarks")
    ]
    for name in [n for n in sys.modules if n.split(".")[0] in ("mutants", "peers")]:
        del sys.modules[name]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    os.environ["PYTHONDONTWRITEBYTECODE"] = os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    sys.dont_write_bytecode = True
    if not compiler:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
        from numba.core import config

        config.DISABLE_JIT = 1
    code = 3
    try:
        import pytest

        options = ["-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no"]
        code = int(pytest.main([*options, *tests], plugins=[plugin]))
    finally:
        os._exit(code)
