"""A share of ``make fuzz`` that takes seconds: the same cases, by the same command."""

import os
import subprocess
import sys

from conftest import ROOT


def test_damaged_scenes_and_meshes_end_in_one_line_or_are_fine():
    words = [sys.executable, "-m", "fuzz", "--scene", "60", "--mesh", "80", "--frames", "6"]
    done = subprocess.run(
        words, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT / "tests")}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "146 cases" in done.stdout


def test_fuzzer_tells_what_is_not_clean(tmp_path):
    """Planted: a death, an endless loop, a bug, chatter, a wrong volume; each is counted as what it is."""
    code = (
        "import os, sys\n"
        "import numpy as np\n"
        "from pathlib import Path\n"
        "from fuzz import harness\n"
        "from fuzz.base import muscle_mesh\n"
        "def loop():\n    while True: pass\n"
        "def wrong():\n"
        "    mesh = muscle_mesh()\n"
        "    harness.check_volume(mesh.vertices, np.tile(mesh.faces, (2, 1)), 'twice')\n    return 0\n"
        "def eat():\n    x = bytearray(2_300_000_000)\n    x[::4096] = bytes(len(x[::4096]))\n    return 0\n"
        "cases = [os.abort, loop, lambda: 1 // 0, lambda: print('native: help') or 3, wrong, eat, lambda: 0,\n"
        "    lambda: print('rbfmuscle: a.toml: wrong', file=sys.stderr) or 3]\n"
        "for case in cases:\n"
        "    harness.SECONDS = 1 if case is loop else 120\n"
        "    print(harness.run_case(case, Path(sys.argv[1]) / 'case')[0])\n"
    )
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)]),
        "NUMBA_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], env=env, capture_output=True, text=True, check=True
    )
    from fuzz import harness

    assert done.stdout.split("\n")[:-1] == [
        harness.DEATH, harness.TIMEOUT, harness.BUG, harness.NOISE, harness.WRONG, harness.MEMORY, harness.FINE,
        harness.CLEAN,
    ]  # fmt: skip
