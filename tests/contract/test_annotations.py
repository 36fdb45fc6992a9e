"""Every public function says what it takes and gives."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted([*(ROOT / "rbfmuscle").rglob("*.py"), *(ROOT / "pbd_baseline").rglob("*.py")])
# Loops that are compiled take plain arrays; their public half is annotated.
COMPILED = ("compiled", "njit", "vectorize")


def is_compiled(function):
    return any(name in ast.unparse(d) for d in function.decorator_list for name in COMPILED)


def public_functions(body, prefix=""):
    """Functions and methods that others may call, with their qualified names."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            special = node.name.startswith("__") and node.name.endswith("__")
            if (special or not node.name.startswith("_")) and not is_compiled(node):
                yield prefix + node.name, node


def parameters(function):
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return [x for x in [*named, given.vararg, given.kwarg] if x is not None and x.arg not in ("self", "cls")]


def lacking(source):
    """Public functions of a source without an annotation of every parameter and of what they return."""
    return [
        name
        for name, node in public_functions(ast.parse(source).body)
        if node.returns is None or any(x.annotation is None for x in parameters(node))
    ]


def test_public_functions_are_annotated():
    found = {str(p.relative_to(ROOT)): lacking(p.read_text(encoding="utf-8")) for p in MODULES}
    assert {path: names for path, names in found.items() if names} == {}


def vague(source):
    """Functions whose signature says `Any`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            said = [x.annotation for x in parameters(node)] + [node.returns]
            names = {n.id for part in said if part for n in ast.walk(part) if isinstance(n, ast.Name)}
            found += [node.name] if "Any" in names else []
    return found


@pytest.mark.parametrize("package", ["implicit", "geometry", "muscle"])
def test_signatures_of_the_core_name_every_type(package):
    """Fields, geometry and the RBF model: no parameter or result is `Any`."""
    paths = sorted((ROOT / "rbfmuscle" / package).rglob("*.py"))
    found = {path.name: vague(path.read_text(encoding="utf-8")) for path in paths}
    assert {path: names for path, names in found.items() if names} == {}


def test_planted_faults_are_found():
    source = "def given(a: int) -> int: ...\ndef lacks(a) -> int: ...\n"
    source += "class A:\n    def b(self): ...\n    def _c(self): ...\n"
    assert lacking(source) == ["lacks", "A.b"]
    source = "def a(x: int) -> dict[str, Any]: ...\ndef b(x: Any) -> int: ...\ndef c(x: int): ..."
    assert vague(source) == ["a", "b"]
