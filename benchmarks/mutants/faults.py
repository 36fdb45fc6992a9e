"""Which faults there are to plant, and a seeded sample of them by room.

The operators are those of cosmic-ray; each place of the source (a line and a column) gets one fault at most in a
sample, so that an operator with many variants weighs no more than a sign.
"""

from __future__ import annotations

import ast
import random
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.provider import OperatorProvider

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("rbfmuscle", "pbd_baseline")

_TURNED = {
    "Lt": ("LtE", "GtE"), "LtE": ("Lt", "Gt"), "Gt": ("GtE", "LtE"), "GtE": ("Gt", "Lt"),
    "Eq": ("NotEq",), "NotEq": ("Eq",), "Is": ("IsNot",), "IsNot": ("Is",),
}  # fmt: skip
_EXCHANGED = {
    "Add": ("Sub",), "Sub": ("Add",), "Mul": ("Div", "Add"), "Div": ("Mul",), "FloorDiv": ("Mul",), "Mod": ("Mul",),
    "Pow": ("Mul",), "BitAnd": ("BitOr",), "BitOr": ("BitAnd",),
}  # fmt: skip
# A decorator removed leaves a loop as Python: slower, not wrong; an exception renamed is caught by no test on purpose.
OPERATORS = (
    *(f"ReplaceComparisonOperator_{a}_{b}" for a, others in _TURNED.items() for b in others),
    *(f"ReplaceBinaryOperator_{a}_{b}" for a, others in _EXCHANGED.items() for b in others),
    "ReplaceUnaryOperator_USub_UAdd", "ReplaceUnaryOperator_Delete_Not", "AddNot", "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd", "ReplaceBreakWithContinue",
    "ReplaceContinueWithBreak", "NumberReplacer", "ZeroIterationForLoop",
)  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One fault: the operator's occurrence in a file, and what it makes of a line.

    ``loop`` says that the place lies in a loop that is compiled; ``function`` is empty where it lies in none.
    """

    path: str
    operator: str
    occurrence: int
    line: int
    column: int
    function: str
    loop: bool

    @property
    def room(self) -> str:
        """The room it lies in: the first folder, or "top" for the modules above all rooms."""
        parts = self.path.split("/")
        return "pbd_baseline" if parts[0] == "pbd_baseline" else parts[1] if len(parts) > 2 else "top"

    @property
    def group(self) -> str:
        """The room, loops apart."""
        room = "top" if self.room == "commands" else self.room
        return f"{room}, loops" if self.loop else room

    def planted(self, source: str) -> str:
        """The file's text with the fault in it."""
        return mutate_code(source, OperatorProvider()[self.operator](), self.occurrence)


def faults_of(path: Path) -> list[Fault]:
    """Every fault of a file, but in annotations, decorators, and what only type checkers read."""
    source = path.read_text(encoding="utf-8")
    left_out, functions = _spans(ast.parse(source))
    provider = OperatorProvider()
    operators = {name: provider[name]() for name in OPERATORS}
    counts, found = dict.fromkeys(operators, 0), []
    for node in ast_nodes(get_ast(source)):
        for name, operator in operators.items():
            for start, _ in operator.mutation_positions(node):
                occurrence, counts[name] = counts[name], counts[name] + 1
                if any(a <= start < b for a, b in left_out):
                    continue
                inner = [f for f in functions if f[0] <= start < f[1]]
                name_of = inner[-1][2] if inner else ""
                found.append(
                    Fault(
                        str(path.relative_to(ROOT)),
                        name,
                        occurrence,
                        *start,
                        name_of,
                        any(f[3] for f in inner),
                    )
                )
    return found


def _spans(tree):
    """Spans of the source that get no fault, and of functions with their names and whether they are compiled."""
    left_out, functions = [], []

    def span(node):
        return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)

    def walk(node, prefix):
        for child in ast.iter_child_nodes(node):
            name = prefix
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{prefix}{child.name}."
                left_out.extend(span(d) for d in child.decorator_list)
            if isinstance(child, ast.FunctionDef):
                loop = any("compiled" in ast.unparse(d) for d in child.decorator_list)
                functions.append((*span(child), name.rstrip("."), loop))
                if child.returns is not None:
                    left_out.append(span(child.returns))
            if isinstance(child, ast.arg | ast.AnnAssign) and child.annotation is not None:
                left_out.append(span(child.annotation))
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                left_out.append(span(child))
            walk(child, name)

    walk(tree, "")
    return left_out, sorted(functions)


def sample(
    count: int, seed: int, *, rooms: list[str] | None = None, loops: bool | None = None
) -> list[Fault]:
    """A seeded sample, as many of each group as nearly as its size allows, in an order that serves all groups evenly.

    Parameters
    ----------
    count : int
        Over all groups; small rooms give what they have.
    seed : int
    rooms : list of str, optional
        Groups or rooms to take.
    loops : bool, optional
        Compiled loops only, or all but these.
    """
    groups: dict[str, dict[tuple, list[Fault]]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for fault in faults_of(path):
                if (loops is None or fault.loop == loops) and (
                    not rooms or fault.group.split(",")[0] in rooms
                ):
                    places = groups.setdefault(fault.group, {})
                    places.setdefault((fault.path, fault.line, fault.column), []).append(fault)
    chosen = []
    for name in sorted(groups):
        dice = random.Random(f"{seed} {name}")
        places = sorted(groups[name])
        dice.shuffle(places)
        chosen.append([dice.choice(groups[name][place]) for place in places])
    turns = (row[k] for k in range(max(map(len, chosen), default=0)) for row in chosen if k < len(row))
    return [fault for fault, _ in zip(turns, range(count))]
