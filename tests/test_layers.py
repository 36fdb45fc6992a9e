"""The import rules between the rooms, checked on the source."""

import ast
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Which of our own modules (by prefix) a room may import; the first matching room counts.
ALLOWED = {
    "rbfmuscle.validation": (),
    "rbfmuscle.implicit": ("rbfmuscle.implicit", "rbfmuscle.validation"),
    "rbfmuscle.sim": ("rbfmuscle.sim", "rbfmuscle.validation"),
    "rbfmuscle.study": ("rbfmuscle.study", "rbfmuscle.implicit", "rbfmuscle.sim", "rbfmuscle.validation"),
    "pbd_baseline": ("pbd_baseline", "rbfmuscle.sim", "rbfmuscle.validation"),
    "rbfmuscle.commands": (
        "rbfmuscle.commands",
        "rbfmuscle.compare",
        "rbfmuscle.models",
        "rbfmuscle.run",
        "rbfmuscle.implicit",
        "rbfmuscle.sim",
        "rbfmuscle.study",
        "rbfmuscle.validation",
        "rbfmuscle.__version__",
    ),
}
ALLOWED["rbfmuscle.cli"] = ALLOWED["rbfmuscle.commands"]
ALLOWED["rbfmuscle.run"] = ALLOWED["rbfmuscle.commands"]
ALLOWED["rbfmuscle.compare"] = ALLOWED["rbfmuscle.commands"]
# The model's own files at the top level: they join a field to the simulation.
MODEL_FILES = (
    "rbfmuscle.muscle",
    "rbfmuscle.constraints",
    "rbfmuscle.elasticity",
    "rbfmuscle.binding",
    "rbfmuscle.options",
    "rbfmuscle.implicit",
    "rbfmuscle.sim",
    "rbfmuscle.validation",
)
NAMES_BOTH = "rbfmuscle.models"


def module_name(path, root=ROOT):
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def imported_modules(source, module, *, is_package=False):
    """Every module of ours that a source imports, in functions too, and those named in strings."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                parts = parts[: len(parts) - node.level + is_package]
                base = ".".join([*parts, *([base] if base else [])])
            found.add(base)
            found.update(f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
            if text.startswith(("rbfmuscle.", "pbd_baseline.")) and text.replace(".", "").isidentifier():
                found.add(text)
    return {name for name in found if name.split(".")[0] in ("rbfmuscle", "pbd_baseline")}


def starts_with(name, prefix):
    return name == prefix or name.startswith(prefix + ".")


def wrong_arrows(module, source, *, is_package=False):
    if module in (NAMES_BOTH, "rbfmuscle"):
        return []
    room = next((room for room in ALLOWED if starts_with(module, room)), None)
    allowed = ALLOWED[room] if room else MODEL_FILES + ("rbfmuscle.__version__",)
    names = imported_modules(source, module, is_package=is_package)
    names = {name for name in names if name != "rbfmuscle"}  # `from rbfmuscle import x` names x itself too
    if room is None:
        allowed = (*allowed, module)
    return sorted(name for name in names if not any(starts_with(name, prefix) for prefix in allowed))


def sources(root):
    return sorted([*(root / "rbfmuscle").rglob("*.py"), *(root / "pbd_baseline").rglob("*.py")])


def wrong_arrows_of_file(path, root=ROOT):
    source = path.read_text(encoding="utf-8")
    return wrong_arrows(module_name(path, root), source, is_package=path.name == "__init__.py")


@pytest.mark.parametrize("path", sources(ROOT), ids=lambda path: module_name(path))
def test_imports_only_what_its_room_may(path):
    assert wrong_arrows_of_file(path) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("rbfmuscle.implicit.field", "from rbfmuscle.sim.scene import Scene"),
        ("rbfmuscle.implicit.field", "from ..sim import scene"),
        ("rbfmuscle.sim.sdf", "def f():\n    import rbfmuscle.implicit.kernels"),
        ("rbfmuscle.sim.simulate", "from rbfmuscle import models"),
        ("rbfmuscle.sim.simulate", "import importlib\nimportlib.import_module('rbfmuscle.muscle')"),
        ("rbfmuscle.study.metrics", "from rbfmuscle.muscle import RBFMuscle"),
        ("rbfmuscle.study.metrics", "import pbd_baseline.muscle"),
        ("rbfmuscle.study.metrics", "from rbfmuscle.run import simulate"),
        ("pbd_baseline.muscle", "from rbfmuscle.implicit.field import RBFField"),
        ("pbd_baseline.muscle", "from rbfmuscle.muscle import RBFMuscle"),
        ("rbfmuscle.muscle", "from pbd_baseline.muscle import PBDMuscle"),
        ("rbfmuscle.validation", "from rbfmuscle.sim.scene import Scene"),
        ("rbfmuscle.cli", "from rbfmuscle.muscle import RBFMuscle"),
        ("rbfmuscle.commands.run", "import pbd_baseline"),
    ],
)
def test_planted_wrong_arrow_is_found(module, source):
    assert wrong_arrows(module, source)


def test_wrong_arrow_planted_in_a_copy_of_the_tree_is_found(tmp_path):
    for package in ("rbfmuscle", "pbd_baseline"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    assert len(sources(tmp_path)) == len(sources(ROOT))
    planted = {
        "rbfmuscle/sim/simulate.py": "\n\ndef late():\n    from ..implicit.field import RBFField\n",
        "pbd_baseline/__init__.py": "\nimport rbfmuscle.muscle\n",
    }
    for name, text in planted.items():
        with (tmp_path / name).open("a", encoding="utf-8") as file:
            file.write(text)
    found = {path for path in sources(tmp_path) if wrong_arrows_of_file(path, tmp_path)}
    assert found == {tmp_path / name for name in planted}


def test_right_arrows_pass():
    assert wrong_arrows("rbfmuscle.study.report", "from rbfmuscle.sim.scene import Scene") == []
    assert wrong_arrows("rbfmuscle.muscle", "from rbfmuscle.implicit.field import RBFField") == []
    assert (
        wrong_arrows("rbfmuscle.sim.scene", "from . import motion\nfrom rbfmuscle.validation import x") == []
    )


def test_import_loads_nothing_heavy():
    import subprocess
    import sys

    code = (
        "import sys, rbfmuscle; print([m for m in ('numba', 'pyvista', 'vtk', 'trimesh', 'skimage', 'scipy', "
        "'pydantic', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
