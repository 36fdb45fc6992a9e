"""A share of ``make fuzz`` that takes seconds: the same cases, by the same command."""

import os
import subprocess
import sys

from conftest import ROOT


def test_damaged_scenes_and_meshes_end_in_one_line_or_are_fine():
    words = [sys.executable, "-m", "fuzz", "--scene", "60", "--mesh", "40", "--frames", "6"]
    env = {**os.environ, "PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "106 cases" in done.stdout


def test_fuzzer_tells_what_is_not_clean(tmp_path):
    """Planted: a death, an endless loop, a bug, chatter, a wrong volume; each is counted as what it is."""
    code = (
        "import os, sys\n"
        "import numpy as np\n"
        "from pathlib import Path\n"
        "from fuzz import harness\n"
        "from fuzz.meshes import muscle_mesh\n"
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
    env = {**os.environ, "PYTHONPATH": f"{ROOT / 'tests'}:{ROOT}", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    from fuzz.harness import BUG, CLEAN, DEATH, FINE, MEMORY, NOISE, TIMEOUT, WRONG

    assert done.stdout.splitlines() == [DEATH, TIMEOUT, BUG, NOISE, WRONG, MEMORY, FINE, CLEAN]
