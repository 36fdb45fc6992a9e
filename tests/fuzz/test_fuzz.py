"""A share of ``make fuzz`` that takes seconds: the same cases, by the same command."""

import os
import subprocess
import sys

import pytest
from conftest import ROOT


@pytest.mark.slow  # 106 cases, each a process of its own
def test_damaged_scenes_and_meshes_end_in_one_line_or_are_fine():
    words = [sys.executable, "-m", "fuzz", "--scene", "60", "--mesh", "40", "--frames", "6"]
    env = {**os.environ, "PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "106 cases" in done.stdout


def test_fuzzer_tells_what_is_not_clean(tmp_path):
    """Planted: a death, a bug, chatter; each is counted as what it is."""
    code = """
import os, sys
from pathlib import Path
from fuzz import harness
clean = "rbfmuscle: a.toml: wrong"
for case in (
    os.abort,
    lambda: 1 // 0,
    lambda: print("native: help") or 3,
    lambda: 0,
    lambda: print(clean) or 3,
):
    print(harness.run_case(case, Path(sys.argv[1]) / "case")[0])
"""
    env = {**os.environ, "PYTHONPATH": f"{ROOT / 'tests'}:{ROOT}", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    from fuzz.harness import BUG, CLEAN, DEATH, FINE, NOISE

    assert done.stdout.splitlines() == [DEATH, BUG, NOISE, FINE, CLEAN]
