"""Every public function says what it takes and gives, `Any` and constant numbers have a reason
beside them, and statements are laid out by the formatter, one assignment each.
"""

import ast

import pytest
from conftest import ROOT

MODULES = sorted([*(ROOT / "rbfmuscle").rglob("*.py"), *(ROOT / "pbd_baseline").rglob("*.py")])
# Loops that are compiled take plain arrays; their public half is annotated.
COMPILED = ("compiled", "njit", "vectorize")
FOLDERS = ("rbfmuscle", "pbd_baseline", "tests", "benchmarks", "docs", "examples")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
MOST_ANY = 15


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


def lacking(source):
    """Public functions without an annotation of everything."""
    found = []
    for name, node, public in functions(ast.parse(source).body):
        given = node.args
        named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        said = [x.annotation for x in named if x is not None and x.arg not in ("self", "cls")]
        found += [name] if public and None in [*said, node.returns] else []
    return found


def vague(source):
    """Whether each `Any` of annotations and aliases has a reason beside it, a comment on its line
    or the one above.
    """
    lines = ["", *source.splitlines()]
    return [
        "#" in lines[node.lineno] or lines[node.lineno - 1].lstrip().startswith("#")
        for node in ast.walk(ast.parse(source))
        if (isinstance(node, ast.Name) and node.id == "Any")
        or (isinstance(node, ast.Attribute) and node.attr == "Any")
    ]


def packed(source):
    """Lines that give values to more than two names at once, swaps and unpacking apart."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Assign) or not isinstance(node.value, (ast.Tuple, ast.List)):
            continue
        for target in node.targets:
            if isinstance(target, (ast.Tuple, ast.List)) and len(target.elts) > 2:
                names = sorted(map(ast.unparse, target.elts))
                swap = names == sorted(map(ast.unparse, node.value.elts))
                found += [] if swap else [node.lineno]
    return found


NUMBERS = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple)


def unexplained(source):
    """Constant numbers of a module without a comment on their lines, on one of the lines before
    them up to an empty one, or in a string below.
    """
    lines, found = ["", *source.splitlines()], []
    body = ast.parse(source).body
    for node, after in zip(body, [*body[1:], None]):
        if not isinstance(node, ast.Assign) or not isinstance(node.value, NUMBERS):
            continue
        names = [part.id for part in ast.walk(node.targets[0]) if isinstance(part, ast.Name)]
        values = [part.value for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
        numeric = values and all(type(value) in (int, float) for value in values)
        if not numeric or not all(name.isupper() for name in names):
            continue
        first = node.lineno
        while lines[first - 1].strip():
            first -= 1
        said = any("#" in line for line in lines[first : node.end_lineno + 1])
        below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        found += [] if said or below else names
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_constant_numbers_have_a_comment(path):
    assert unexplained(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_public_functions_are_annotated(path):
    assert lacking(path.read_text(encoding="utf-8")) == []


def test_any_is_rare_and_has_a_reason():
    found = {path: vague(path.read_text(encoding="utf-8")) for path in MODULES}
    assert [path for path, reasons in found.items() if not all(reasons)] == []
    assert sum(map(len, found.values())) <= MOST_ANY


def test_statements_assign_to_one_thing_and_are_laid_out_by_the_formatter():
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCES}
    assert {path: lines for path, text in texts.items() if (lines := packed(text))} == {}
    skip = "# fmt" + ": "
    assert [path for path, text in texts.items() if skip in text] == []


def test_planted_faults_are_found():
    source = "def given(a: int) -> int: ...\ndef lacks(a) -> int: ...\n"
    source += "class A:\n    def b(self): ...\n    def _c(self): ...\n"
    assert lacking(source) == ["lacks", "A.b"]
    source = "from typing import Any\n\na: Any = 1\n# why\nb: Any = 1\nc: list[Any] = []  # why\n"
    assert vague(source) == [False, True, True]
    source = "a, b = 1, 2\na, b, c = f()\na, b, c = b, c, a\na, b, c = 1, 2, 3\n(a, b, *c) = [1, 2]"
    assert packed(source) == [4, 5]
    source = 'A = 1  # mm\nB = 2.0\n\nC, D = 1, -2\n\nE = 3\n"""Of what."""\nF = \'x\'\n'
    assert unexplained(source) == ["C", "D"]
