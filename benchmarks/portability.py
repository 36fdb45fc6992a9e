"""The numeric tests as other machines would run them: inputs moved in their last digits, other
processor features, threads and versions.

    python benchmarks/portability.py [--only NAME ...] [--jobs N] [--folder DIR] [TESTS ...]

Without ``--only``, all that combine several changes, as CI runs them. Cores that no other variant
takes are workers of a variant; bone fields are not taken from the cache. Those of the
oldest and the newest versions have an environment of their own each (``.ci/oldest.txt``,
``.ci/newest.txt``), kept in the folder. Names each variant in which a test fails; exit code 1
then.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
TWO_THREADS = {"OPENBLAS_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"}
MOVED = {f"moved-{seed}": {"RBFMUSCLE_MOVED_VERTICES": str(seed)} for seed in (1, 2, 3)}
# The longest first: those that compile anew. Each is two or three changes at once, for time; the
# variants of one change tell which of them makes a test fail.
USUAL = {
    "oldest-moved-1": MOVED["moved-1"],
    "generic-one-thread-moved-2": GENERIC | ONE_THREAD | MOVED["moved-2"],
    "two-threads-moved-3": TWO_THREADS | MOVED["moved-3"],
}
VARIANTS = {
    **USUAL,
    "oldest": {},
    "newest": {},
    "generic": GENERIC,
    "one-thread": ONE_THREAD,
    "two-threads": TWO_THREADS,
    **MOVED,
    "haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "zen": {"OPENBLAS_CORETYPE": "Zen"},
    "skylakex": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "numpy-without-avx512": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL"},
}
# Their machine code is kept apart: files of other versions or processors would replace each other.
COMPILED_ANEW = ("oldest", "newest", "generic")
# Enough of NumPy and SciPy to meet an instruction that a processor has not.
TRIAL = (
    "import numpy as np, scipy.linalg as s; a = np.eye(300) + np.random.rand(300, 300); "
    "s.cho_factor(a @ a.T)"
)
CHOSEN = "numeric and not slow and not benchmark"


def interpreter(name: str, folder: Path) -> Path:
    """The Python of a variant; an environment is made where it has versions of its own."""
    versions = name.split("-")[0]
    constraints = ROOT / ".ci" / f"{versions}.txt"
    if not constraints.exists():
        return Path(sys.executable)
    python = folder / versions / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", folder / versions], check=True)
    pip = [python, "-m", "pip", "install", "--quiet", "--constraint", constraints]
    subprocess.run([*pip, "--editable", f"{ROOT}[dev]"], check=True)
    return python


def run_variant(name: str, tests: list[str], folder: Path, workers: int) -> tuple[bool, list[str]]:
    """Whether the tests pass in a variant, and what to print; all that pytest printed is in the
    folder.
    """
    start, log = time.monotonic(), folder / f"{name}.log"
    try:
        python = interpreter(name, folder)
    except subprocess.CalledProcessError as error:
        return False, [f"no environment: {error}"]
    with tempfile.TemporaryDirectory() as cache, log.open("w") as printed:
        environment = {**os.environ, **VARIANTS[name], "RBFMUSCLE_CACHE": cache}
        if name.startswith(COMPILED_ANEW):
            environment["NUMBA_CACHE_DIR"] = str(folder / f"{name}-loops")
        trial = subprocess.run(
            [python, "-c", TRIAL], env=environment, capture_output=True, check=False
        )
        if trial.returncode:
            return name not in USUAL, ["not run: this processor has not the instructions"]
        command = [python, "-m", "pytest", "-q", "-n", str(workers), "-p", "no:cacheprovider"]
        command += ["--tb=short", "-m", CHOSEN, *tests]
        done = subprocess.run(command, cwd=ROOT, env=environment, stdout=printed, check=False)
    lines = log.read_text(encoding="utf-8").splitlines() or ["nothing printed"]
    wrong = [line for line in lines if re.match("FAILED|ERROR", line)]
    return done.returncode == 0, [*wrong, f"{lines[-1]} ({time.monotonic() - start:.0f} s in all)"]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tests", nargs="*", default=["tests"])
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(USUAL))
    parser.add_argument("--jobs", type=int, default=2, help="variants that run side by side")
    parser.add_argument("--folder", type=Path, default=ROOT / "portability_output")
    asked = parser.parse_args()
    folder = asked.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    failed = []
    cores = (os.cpu_count() or 1) // min(asked.jobs, len(asked.only))
    workers = cores if cores > 1 else 0
    with ThreadPoolExecutor(asked.jobs) as pool:
        runs = [
            (name, pool.submit(run_variant, name, asked.tests, folder, workers))
            for name in asked.only
        ]
        for name, run in runs:
            passed, lines = run.result()
            failed += [] if passed else [name]
            print("\n    ".join([f"{name}: {'passes' if passed else 'FAILS'}", *lines]), flush=True)
    if failed:
        print(f"tests fail under: {', '.join(failed)}")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
