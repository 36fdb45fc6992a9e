"""A wheel and an sdist, each installed in a clean environment, and the phantom hip run there.

    python benchmarks/distributions.py

Needs the package registry; some ten minutes, most of them for compiling. Exit code 1 at the first
step that fails.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(*command, cwd):
    """Run a command without what this clone puts on Python's path; what it printed."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=clean, text=True, stdout=subprocess.PIPE
    )
    if done.returncode != 0:
        raise SystemExit(f"failed: {' '.join(str(word) for word in command)}\n{done.stdout}")
    return done.stdout


def check_distribution(kind, folder):
    """Build, install and run one kind of distribution."""
    run(sys.executable, "-m", "build", f"--{kind}", "--outdir", folder / "dist", ROOT, cwd=folder)
    (file,) = (folder / "dist").iterdir()
    run(sys.executable, "-m", "venv", folder / "env", cwd=folder)
    binary = folder / "env" / "bin"
    run(binary / "python", "-m", "pip", "install", "--quiet", file, cwd=folder)
    place = run(binary / "python", "-c", "import rbfmuscle; print(rbfmuscle.__file__)", cwd=folder)
    if not Path(place).is_relative_to(folder):
        raise SystemExit(f"the {kind} was not installed: imported from {place}")
    out = folder / "out"
    run(binary / "rbfmuscle", "demo", "--model", "pbd", "-o", out, cwd=folder)
    if not (out / "report.html").exists() or not (out / "metrics.csv").stat().st_size:
        raise SystemExit(f"the {kind} wrote no report or no metrics")
    print(f"{file.name}: builds, installs and runs", flush=True)


if __name__ == "__main__":
    for kind in ("wheel", "sdist"):
        with tempfile.TemporaryDirectory() as folder:
            check_distribution(kind, Path(folder).resolve())
