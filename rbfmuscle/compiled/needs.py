"""The loops that tasks need, with the types of their arguments: recorded from runs, kept beside this file.

`benchmarks/loops.py --record` writes the table. A loop that it does not name is compiled at its first call, and a row
that no longer fits (renamed, other arguments) is left out, so a table that is behind costs time and nothing else.
"""

import importlib
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from rbfmuscle.compiled.store import has_entry
from rbfmuscle.compiled.types import read_type

# Ends the name of an entry that says: these types do not fit this loop, do not try again.
UNFIT = "-unfit"
TABLE = Path(__file__).with_name("needs.json")


class Need(NamedTuple):
    """A loop, its argument types, and the processor time that compiling it took where it was recorded [s]."""

    name: str
    loop: Any
    arguments: tuple
    cost: float

    @property
    def entry(self) -> str:
        """Name of its entry in the cache."""
        return self.loop.entry_name(self.arguments)


@cache
def _rows():
    return json.loads(TABLE.read_text(encoding="utf-8"))["loops"] if TABLE.exists() else []


def task_names() -> list[str]:
    """What needs were recorded for: models and commands."""
    return sorted({task for row in _rows() for task in row["tasks"]})


def loops_needed(tasks: Iterable[str]) -> list[Need]:
    """Loops that any of the tasks needs, the longest to compile first."""
    wanted = set(tasks)
    found = []
    for row in _rows():
        if wanted.isdisjoint(row["tasks"]):
            continue
        module, _, name = row["loop"].partition(":")
        try:
            loop = getattr(importlib.import_module(module), name)
            arguments = tuple(read_type(text) for text in row["types"])
        except (ImportError, AttributeError, ValueError, TypeError):
            continue
        if hasattr(loop, "entry_name"):  # with NUMBA_DISABLE_JIT it is a plain function
            found.append(Need(row["loop"], loop, arguments, row["cost"]))
    return sorted(found, key=lambda need: -need.cost)


def is_settled(need: Need) -> bool:
    """Whether a loop is on disk, or was found not to fit its row."""
    return has_entry(need.entry) or has_entry(need.entry + UNFIT)


def loops_missing(tasks: Iterable[str]) -> list[Need]:
    """Those of `loops_needed` that are neither in this process nor on disk."""
    return [
        need
        for need in loops_needed(tasks)
        if need.arguments not in need.loop.overloads and not is_settled(need)
    ]
