"""Which tests reach a line: the recordings of :mod:`mutants.contexts`, brought up to the present text."""

from __future__ import annotations

import difflib
import itertools
import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# A fault is tried on tests of so many seconds together at most, and so many of them.
BUDGET, MOST = 8.0, 250


@dataclass
class Reach:
    """Tests by line, and their times, from all recordings of one kind (compiled or not)."""

    seconds: dict[str, float] = field(default_factory=dict)
    lines: dict[str, dict[str, set[str]]] = field(default_factory=dict)
    total: dict[str, int] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> Reach:
        """All recordings of a folder."""
        found = cls()
        for path in sorted(folder.glob("*.json")):
            record = json.loads(path.read_text(encoding="utf-8"))
            found.seconds.update(record["tests"])
            for name, kept in record["files"].items():
                lines = found.lines.setdefault(name, {})
                now = _lines_now(name, folder / "sources" / kept["digest"])
                for line, tests in kept["lines"].items():
                    if int(line) in now:
                        lines.setdefault(str(now[int(line)]), set()).update(tests)
        return found

    def tests(self, path: str, line: int, *, outside: bool) -> list[str]:
        """Tests that run a line, quick ones first, within the budget.

        Parameters
        ----------
        path : str
        line : int
        outside : bool
            The line lies in no function: it runs when the module is imported, so any test of the module may tell.
        """
        lines = self.lines.get(path, {})
        if outside:
            contexts = {test for tests in lines.values() for test in tests}
        else:
            contexts = lines.get(str(line), ())
        chosen, spent = [], 0.0
        tests = self._expanded(contexts)
        wanted = self._by_share(tests, lines) if outside else self._in_turn(tests)
        for test in wanted:
            if len(chosen) < MOST and spent + self.seconds[test] <= BUDGET * (2.0 if outside else 1.0):
                chosen.append(test)
                spent += self.seconds[test]
        return chosen or wanted[:1]

    def _by_share(self, tests, lines):
        """First those of whose lines the most lie in this module: a table's constants are told by who asks for them."""
        if not self.total:
            for kept in self.lines.values():
                for found in kept.values():
                    for test in found:
                        self.total[test] = self.total.get(test, 0) + 1
        here: dict[str, int] = {}
        for found in lines.values():
            for test in found:
                here[test] = here.get(test, 0) + 1
        return sorted(tests, key=lambda t: (-here.get(t, 0) / self.total.get(t, 1), self.seconds[t]))

    def _in_turn(self, tests):
        """Quick ones first, one of each test function before the second of any: their parameters say much alike."""
        functions: dict[str, list[str]] = {}
        for test in sorted(tests, key=lambda t: self.seconds[t]):
            functions.setdefault(test.split("[")[0], []).append(test)
        rounds = itertools.zip_longest(*functions.values())
        return [test for row in rounds for test in row if test is not None]

    def _expanded(self, contexts):
        """Tests of these contexts; what a fixture ran belongs to every test of its file."""
        found = {c for c in contexts if c in self.seconds}
        files = {c for c in contexts if "::" not in c}
        return found | {t for t in self.seconds if t.split("::")[0] in files}


@cache
def _lines_now(name, recorded):
    """Numbers of lines in the text that was recorded, with those of the same lines in the present one."""
    path = ROOT / name
    new = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    old = recorded.read_text(encoding="utf-8").splitlines() if recorded.exists() else new
    if old == new:
        return {k: k for k in range(1, len(old) + 1)}
    matcher = difflib.SequenceMatcher(None, old, new, autojunk=False)
    return {a + k + 1: b + k + 1 for a, b, size in matcher.get_matching_blocks() for k in range(size)}
