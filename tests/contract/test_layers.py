"""The import rules of ``pyproject.toml`` hold, each fails on a planted violation, no module imports
itself through others, and the package is quick to import.
"""

import os
import re
import shutil
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest
from conftest import ROOT

PACKAGES = ("rbfmuscle", "pbd_baseline")


def broken_rules(folder):
    """Names of the rules that the packages of a folder break, and what the linter says."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()"]
    done = subprocess.run(
        [*command, "--no-cache"],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(folder)},
        check=False,
    )
    broken = re.findall(r"^(.+) BROKEN\b", done.stdout, flags=re.M)
    assert done.returncode == bool(broken), done.stdout + done.stderr
    return broken, done.stdout


def test_imports_keep_the_rules():
    broken, said = broken_rules(ROOT)
    assert broken == [], said


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planted")
    shutil.copy(ROOT / "pyproject.toml", folder)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=lambda *_: ["__pycache__"])
    return folder


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("rbfmuscle/implicit/field.py", "from rbfmuscle.scene.scene import Scene"),
        ("rbfmuscle/bones/sdf.py", "def f():\n    import rbfmuscle.implicit.kernels.table"),
        (
            "rbfmuscle/simulation/frame_loop.py",
            "if TYPE_CHECKING:\n    import rbfmuscle.muscle.muscle",
        ),
        ("pbd_baseline/muscle.py", "from rbfmuscle.implicit.field import RBFField"),
        ("rbfmuscle/metrics/metrics.py", "import rbfmuscle.muscle.muscle"),
        ("rbfmuscle/report/report.py", "import pbd_baseline.muscle"),
        ("rbfmuscle/importers/__init__.py", "import rbfmuscle.simulation.frame"),
        ("rbfmuscle/validation.py", "from rbfmuscle.scene.scene import Scene"),
        ("rbfmuscle/new_package.py", ""),
    ],
)
def test_planted_wrong_import_is_found(copy, module, source):
    path = copy / module
    before = path.read_text(encoding="utf-8") if path.exists() else None
    path.write_text(f"{before or ''}\n{source}\n", encoding="utf-8")
    broken, said = broken_rules(copy)
    if before is None:
        path.unlink()
    else:
        path.write_text(before, encoding="utf-8")
    assert broken, said


def cycle(graph):
    """Modules that import each other in a ring, empty where none do."""
    arrows = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    packages = {name.rpartition(".")[0] for name in graph.modules}
    try:
        TopologicalSorter(
            {n: a - packages for n, a in arrows.items() if n not in packages}
        ).prepare()
    except CycleError as error:
        return sorted(set(error.args[1]))
    return []


def test_no_module_imports_itself_by_others():
    assert cycle(grimp.build_graph(*PACKAGES, cache_dir=None)) == []


def test_planted_cycle_is_found():
    graph = grimp.ImportGraph()
    for importer, imported in [("a.x", "a.y"), ("a.y", "a.z"), ("a.z", "a.x")]:
        graph.add_import(importer=importer, imported=imported)
    assert cycle(graph) == ["a.x", "a.y", "a.z"]


def test_import_loads_nothing_heavy():
    heavy = ["numba", "pyvista", "vtk", "trimesh", "skimage", "scipy", "pydantic", "matplotlib"]
    code = f"import sys, rbfmuscle; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
