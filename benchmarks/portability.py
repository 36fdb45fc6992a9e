"""The tests as other machines would run them: other BLAS kernels, features, threads, versions, and
last digits.

    python benchmarks/portability.py [--only NAME ...] [--folder DIR] [TESTS ...]

Each configuration runs in one process; bone fields are not taken from the cache. ``oldest`` and
``newest`` have an environment of their own each (``.ci/oldest.txt``, ``.ci/newest.txt``), kept in
the folder. Exit code 1 where a test fails.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONFIGURATIONS = {
    "haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "zen": {"OPENBLAS_CORETYPE": "Zen"},
    "skylakex": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "numpy-without-avx512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL"},
    "numba-generic": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
    "one-thread": {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    "two-threads": {"OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
    "moved": {"RBFMUSCLE_MOVED_VERTICES": "1e-12"},
    "oldest": {},
    "newest": {},
}
# Enough of NumPy and SciPy to meet an instruction that a processor has not.
TRIAL = (
    "import numpy as np, scipy.linalg as s; a = np.eye(300) + np.random.rand(300, 300); "
    "s.cho_factor(a @ a.T)"
)


def interpreter(name: str, folder: Path) -> Path:
    """The Python of a configuration; an environment is made where it has versions of its own."""
    constraints = ROOT / ".ci" / f"{name}.txt"
    if not constraints.exists():
        return Path(sys.executable)
    python = folder / name / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", folder / name], check=True)
    pip = [python, "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--constraint", constraints, "--editable", f"{ROOT}[dev]"], check=True)
    return python


def run_tests(name: str, tests: list[str], folder: Path) -> tuple[str, int]:
    """What pytest counted in a configuration, and how many failed; all it printed is in the
    folder."""
    python, log = interpreter(name, folder), folder / f"{name}.log"
    with tempfile.TemporaryDirectory() as cache, log.open("w") as printed:
        environment = {**os.environ, **CONFIGURATIONS[name], "RBFMUSCLE_CACHE": cache}
        trial = subprocess.run(
            [python, "-c", TRIAL], env=environment, capture_output=True, check=False
        )
        if trial.returncode:
            return "not run: this processor has not the instructions", 0
        command = [
            python,
            "-m",
            "pytest",
            "-q",
            "-n",
            "0",
            "-p",
            "no:cacheprovider",
            "--tb=short",
            *tests,
        ]
        done = subprocess.run(command, cwd=ROOT, env=environment, stdout=printed, check=False)
    lines = log.read_text(encoding="utf-8").splitlines() or ["nothing"]
    for line in lines:
        if line.startswith(("FAILED", "ERROR")):
            print(f"    {line}", flush=True)
    failed = sum(int(count) for count in re.findall(r"(\d+) (?:failed|error)", lines[-1]))
    return lines[-1], failed or int(done.returncode != 0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tests", nargs="*", default=["tests"])
    parser.add_argument("--only", nargs="+", choices=CONFIGURATIONS, default=list(CONFIGURATIONS))
    parser.add_argument("--folder", type=Path, default=ROOT / "portability_output")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    wrong = 0
    for name in asked.only:
        print(f"{name}:", flush=True)
        last, failed = run_tests(name, asked.tests, asked.folder.resolve())
        print(f"    {last}", flush=True)
        wrong += failed
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
