"""Numbers that no reader of a scene can set: each has its unit and its reason beside it."""

import ast
import re

import pytest
from conftest import ROOT

PACKAGES = ("bones", "implicit", "muscle", "simulation")
SOURCES = sorted(
    path
    for folder in [*(ROOT / "rbfmuscle" / name for name in PACKAGES), ROOT / "pbd_baseline"]
    for path in folder.rglob("*.py")
)


def numbers_without_reason(text):
    """Names of a module's numeric constants without a comment behind them or further up in the
    block of lines that they stand in, or a docstring below.
    """
    lines = text.splitlines()
    body = ast.parse(text).body
    found = []
    for node, after in zip(body, [*body[1:], None]):
        if not isinstance(node, ast.Assign) or not _is_number(node.value):
            continue
        names = re.findall(r"\b_?[A-Z][A-Z0-9_]+\b", lines[node.lineno - 1].split("=")[0])
        said = "#" in lines[node.end_lineno - 1] or (
            isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        )
        above = node.lineno - 2
        while not said and above >= 0 and lines[above].strip():
            said = "#" in lines[above]
            above -= 1
        found += [] if said else names
    return found


def _is_number(value):
    """Whether an expression is a number, or some, and no more."""
    kinds = (ast.Constant, ast.Tuple, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop, ast.Load)
    parts = list(ast.walk(value))
    return all(isinstance(part, kinds) for part in parts) and all(
        isinstance(part.value, int | float) for part in parts if isinstance(part, ast.Constant)
    )


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_numbers_have_a_reason(path):
    assert numbers_without_reason(path.read_text(encoding="utf-8")) == []


def test_a_number_without_a_reason_is_found():
    assert numbers_without_reason("# Depth [mm].\nDEPTH = 0.1\nFAR = 2.0\n\nMOST = 3\n") == ["MOST"]
