"""What a release consists of: one version everywhere, every package found, a distribution that
installs and runs.
"""

import os
import re
import subprocess
import sys
import tomllib

import pytest
from conftest import ROOT

import rbfmuscle

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_one_version_everywhere():
    version = PROJECT["project"]["version"]
    assert rbfmuscle.__version__ == version
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.+)$", citation, re.M).group(1) == version
    changes = (ROOT / "docs" / "changes.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M).group(1) == version


def test_every_folder_with_modules_is_a_package():
    for top in ("rbfmuscle", "pbd_baseline"):
        assert (ROOT / top / "py.typed").exists()
        for folder in {path.parent for path in (ROOT / top).rglob("*.py")}:
            assert (folder / "__init__.py").exists(), folder


def test_typed_marker_templates_and_scripts_travel_with_the_packages():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for top in ("rbfmuscle", "pbd_baseline"):
        packed = {path for pattern in data[top] for path in (ROOT / top).glob(pattern)}
        files = {path for path in (ROOT / top).rglob("*") if path.is_file()}
        assert packed == {path for path in files if path.suffix not in (".py", ".pyc")}


def test_ci_runs_what_a_user_runs():
    """System packages, then the two commands of the README and of CONTRIBUTING."""
    lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    made = [line for line in lines if not line.startswith("#")]
    assert not any(re.search(r"\bpip\b|\.venv", line) for line in made)
    assert re.findall(r"\bmake (?!\|)([\w-]+)", "\n".join(made)) == ["test", "check"]


def test_what_tests_import_is_installed_for_them():
    """No extra besides ``dev`` is needed for ``make test``; ``view`` and ``new`` need none."""
    project = PROJECT["project"]
    found = {
        name: {re.split(r"[^\w-]", text)[0] for text in rows}
        for name, rows in project["optional-dependencies"].items()
    }
    ordinary = {re.split(r"[^\w-]", text)[0] for text in project["dependencies"]}
    assert {"viser", "nibabel", "pynrrd"} <= ordinary
    assert found["usd"] | found["cluster"] | {"scikit-fem"} <= found["dev"]
    for path in (ROOT / "tests").rglob("*.py"):
        skipped = re.findall(r'importorskip\("(\w+)', path.read_text(encoding="utf-8"))
        assert set(skipped) <= {"opensim"}, path


def run(*command, **options):
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=1800, env=clean, **options
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_distribution_installs_in_a_clean_environment_and_runs(kind, tmp_path):
    """Needs the package registry; ten minutes with compiling."""
    run(sys.executable, "-m", "build", f"--{kind}", "--outdir", str(tmp_path / "dist"), str(ROOT))
    (file,) = (tmp_path / "dist").iterdir()
    run(sys.executable, "-m", "venv", str(tmp_path / "env"))
    binary = tmp_path / "env" / "bin"
    run(str(binary / "python"), "-m", "pip", "install", "--quiet", str(file))
    version = PROJECT["project"]["version"]
    assert version in run(str(binary / "rbfmuscle"), "--version", cwd=tmp_path)
    where = run(
        str(binary / "python"), "-c", "import rbfmuscle; print(rbfmuscle.__file__)", cwd=tmp_path
    )
    assert str(tmp_path / "env") in where
    out = tmp_path / "out"
    run(str(binary / "rbfmuscle"), "demo", "--model", "pbd", "-o", str(out), cwd=tmp_path)
    assert (out / "report.html").exists()
    assert (out / "metrics.csv").stat().st_size > 0
