"""The import rules between the packages, checked on the source."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter

import pytest
from conftest import ROOT

NAMES = (
    "cache",
    "child",
    "folders",
    "geometry",
    "interruption",
    "jit",
    "progress",
    "showing",
    "validation",
)
LEAVES = tuple(f"rbfmuscle.{name}" for name in NAMES)
CORE = (*LEAVES, "rbfmuscle.bones", "rbfmuscle.scene", "rbfmuscle.simulation")
MEASURED = (
    *CORE,
    "rbfmuscle.implicit",
    "rbfmuscle.metrics",
    "rbfmuscle.output",
    "rbfmuscle.experiments",
)
ABOVE = (*MEASURED, "rbfmuscle.fibres", "rbfmuscle.report", "rbfmuscle.__version__")
# Which of our own modules (by prefix) a package may import; the first matching package counts.
ALLOWED = {
    "rbfmuscle.validation": (),
    "rbfmuscle.jit": (),
    "rbfmuscle.progress": (),
    "rbfmuscle.showing": (),
    "rbfmuscle.cache": ("rbfmuscle.geometry",),
    "rbfmuscle.child": ("rbfmuscle.child", "rbfmuscle.validation"),
    "rbfmuscle.folders": ("rbfmuscle.validation",),
    "rbfmuscle.geometry": ("rbfmuscle.geometry", "rbfmuscle.jit"),
    "rbfmuscle.implicit": (*LEAVES, "rbfmuscle.implicit"),
    "rbfmuscle.bones": (*LEAVES, "rbfmuscle.bones"),
    "rbfmuscle.scene": (*LEAVES, "rbfmuscle.scene"),
    "rbfmuscle.simulation": CORE,
    "rbfmuscle.importers": (*LEAVES, "rbfmuscle.scene", "rbfmuscle.importers"),
    "rbfmuscle.muscle": (*CORE, "rbfmuscle.implicit", "rbfmuscle.muscle"),
    "pbd_baseline": (*CORE, "pbd_baseline"),
    "rbfmuscle.metrics": (*CORE, "rbfmuscle.metrics"),
    "rbfmuscle.fibres": (*CORE, "rbfmuscle.metrics", "rbfmuscle.fibres"),
    "rbfmuscle.output": (*CORE, "rbfmuscle.metrics", "rbfmuscle.output"),
    "rbfmuscle.experiments": MEASURED,
    "rbfmuscle.report": ABOVE,
    "rbfmuscle.viewer": (*ABOVE, "rbfmuscle.importers", "rbfmuscle.models", "rbfmuscle.viewer"),
    "rbfmuscle.recording": (*ABOVE, "rbfmuscle.importers", "rbfmuscle.models"),
    "rbfmuscle.run": (*ABOVE, "rbfmuscle.recording"),
    "rbfmuscle.compare": (*ABOVE, "rbfmuscle.models", "rbfmuscle.run"),
    "rbfmuscle.sweeping": (*ABOVE, "rbfmuscle.models", "rbfmuscle.run"),
    "rbfmuscle.paths": (*ABOVE, "rbfmuscle.importers", "rbfmuscle.models"),
    "rbfmuscle.cli": (
        *ABOVE,
        "rbfmuscle.importers",
        "rbfmuscle.models",
        "rbfmuscle.run",
        "rbfmuscle.compare",
        "rbfmuscle.paths",
        "rbfmuscle.sweeping",
        "rbfmuscle.viewer",
        "rbfmuscle.cli",
    ),
}
ALLOWED["rbfmuscle.__main__"] = ("rbfmuscle.cli",)


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
            if (
                text.startswith(("rbfmuscle.", "pbd_baseline."))
                and text.replace(".", "").isidentifier()
            ):
                found.add(text)
    return {name for name in found if name.split(".")[0] in ("rbfmuscle", "pbd_baseline")}


def starts_with(name, prefix):
    return name == prefix or name.startswith(prefix + ".")


def wrong_arrows(module, source, *, is_package=False):
    if module in ("rbfmuscle.models", "rbfmuscle"):
        return []
    package = next((package for package in ALLOWED if starts_with(module, package)), None)
    allowed = ALLOWED[package] if package else ()
    names = imported_modules(source, module, is_package=is_package)
    names = {
        name for name in names if name != "rbfmuscle"
    }  # `from rbfmuscle import x` names x itself too
    return sorted(
        name for name in names if not any(starts_with(name, prefix) for prefix in allowed)
    )


def sources(root):
    return sorted([*(root / "rbfmuscle").rglob("*.py"), *(root / "pbd_baseline").rglob("*.py")])


@pytest.mark.parametrize("path", sources(ROOT), ids=lambda path: module_name(path))
def test_imports_only_what_its_package_may(path):
    source = path.read_text(encoding="utf-8")
    assert wrong_arrows(module_name(path), source, is_package=path.name == "__init__.py") == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("rbfmuscle.implicit.field", "from rbfmuscle.scene.scene import Scene"),
        ("rbfmuscle.implicit.field", "from ..sim import scene"),
        ("rbfmuscle.bones.sdf", "def f():\n    import rbfmuscle.implicit.kernels.table"),
        (
            "rbfmuscle.simulation.frame_loop",
            "import importlib\nimportlib.import_module('rbfmuscle.muscle.muscle')",
        ),
        ("pbd_baseline.muscle", "from rbfmuscle.implicit.field import RBFField"),
        ("rbfmuscle.validation", "from rbfmuscle.scene.scene import Scene"),
    ],
)
def test_planted_wrong_arrow_is_found(module, source):
    assert wrong_arrows(module, source)
    assert wrong_arrows("rbfmuscle.report.report", "from rbfmuscle.scene.scene import Scene") == []


def cycle(arrows):
    """Modules that import each other in a ring, empty where none do."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return sorted(set(error.args[1]))
    return []


def all_arrows(root=ROOT):
    """What each module imports, in functions and under TYPE_CHECKING too."""
    arrows = {}
    for path in sources(root):
        if path.name != "__init__.py":
            module = module_name(path, root)
            arrows[module] = imported_modules(path.read_text(encoding="utf-8"), module) - {module}
    return arrows


def test_no_module_imports_itself_by_others():
    assert cycle(all_arrows()) == []


@pytest.mark.parametrize(
    "late",
    ["def f():\n    import rbfmuscle.b\n", "if TYPE_CHECKING:\n    from rbfmuscle.b import x\n"],
    ids=["in a function", "for types"],
)
def test_planted_cycle_is_found(tmp_path, late):
    for name, text in {
        "a": late,
        "b": "from rbfmuscle.c import y",
        "c": "from rbfmuscle import a",
    }.items():
        (tmp_path / "rbfmuscle").mkdir(exist_ok=True)
        (tmp_path / "rbfmuscle" / f"{name}.py").write_text(text)
    assert cycle(all_arrows(tmp_path)) == ["rbfmuscle.a", "rbfmuscle.b", "rbfmuscle.c"]


def test_import_loads_nothing_heavy():
    heavy = ["numba", "pyvista", "vtk", "trimesh", "skimage", "scipy", "pydantic", "matplotlib"]
    code = f"import sys, rbfmuscle; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
