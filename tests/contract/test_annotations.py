"""Every public function says what it takes and gives; those of the core do not say `Any`."""

import ast
import re

import pytest
from conftest import ROOT

MODULES = sorted([*(ROOT / "rbfmuscle").rglob("*.py"), *(ROOT / "pbd_baseline").rglob("*.py")])
# Loops that are compiled take plain arrays; their public half is annotated.
COMPILED = ("compiled", "inner", "njit", "vectorize")
CORE = ("implicit", "geometry", "muscle")


def functions(body, prefix="", hidden=False):
    """Functions and methods with their qualified names, and whether others may call them."""
    for node in body:
        name = getattr(node, "name", "")
        private = hidden or (name.startswith("_") and not name.endswith("__"))
        if isinstance(node, ast.ClassDef):
            yield from functions(node.body, f"{prefix}{name}.", private)
        elif isinstance(node, ast.FunctionDef):
            compiled = any(word in ast.unparse(d) for d in node.decorator_list for word in COMPILED)
            yield prefix + name, node, not (private or compiled)


def lacking(source, *, core=False):
    """Public functions without an annotation of everything, and any of the core that says `Any`."""
    found = []
    for name, node, public in functions(ast.parse(source).body):
        given = node.args
        named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        said = [x.annotation for x in named if x is not None and x.arg not in ("self", "cls")]
        said.append(node.returns)
        vague = core and any(
            "Any" in re.findall(r"\w+", ast.unparse(part)) for part in said if part
        )
        found += [name] if (public and None in said) or vague else []
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_public_functions_are_annotated(path):
    assert (
        lacking(path.read_text(encoding="utf-8"), core=path.relative_to(ROOT).parts[1] in CORE)
        == []
    )


def test_planted_faults_are_found():
    source = "def given(a: int) -> int: ...\ndef lacks(a) -> int: ...\n"
    source += "class A:\n    def b(self): ...\n    def _c(self): ...\n"
    assert lacking(source) == ["lacks", "A.b"]
    source = "def _a(x: int) -> dict[str, Any]: ...\ndef b(x: Any) -> int: ...\ndef _c(x: int): ..."
    assert lacking(source, core=True) == ["_a", "b"]
