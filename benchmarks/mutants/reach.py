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
BUDGET, MOST = 8.0, 60
# Where fewer reach a line, others of its module are tried too.
FEW = 15


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
                    for place in now.get(int(line), ()):
                        lines.setdefault(str(place), set()).update(tests)
        return found

    def tests(self, path: str, line: int, *, outside: bool) -> list[str]:
        """Tests that run a line, those most apt to tell first, within the budget, those of a file together.

        Parameters
        ----------
        path : str
        line : int
        outside : bool
            The line lies in no function: it runs when the module is imported, so any test of the module may tell.
        """
        lines = self.lines.get(path, {})
        wanted = [] if outside else self._in_turn(self._expanded(lines.get(str(line), ())), lines)
        if len(wanted) < FEW:
            # A default or a table runs when its module is imported, under the name of no test or of a chance one.
            every = {test for tests in lines.values() for test in tests}
            others = self._in_turn(self._expanded(every) - set(wanted), lines)
            wanted = [t for pair in itertools.zip_longest(wanted, others) for t in pair if t is not None]
        chosen, spent = [], 0.0
        for test in wanted:
            if len(chosen) < MOST and spent + self.seconds[test] <= BUDGET * (2.0 if outside else 1.0):
                chosen.append(test)
                spent += self.seconds[test]
        return self._by_file(chosen or wanted[:1])

    def _in_turn(self, tests, lines):
        """By the chance to tell, which is the share of this module among the lines that a test runs, for the time.

        One of each test function comes before the second of any: their parameters say much alike.
        """
        if not self.total:
            for kept in self.lines.values():
                for found in kept.values():
                    for test in found:
                        self.total[test] = self.total.get(test, 0) + 1
        here: dict[str, int] = {}
        for found in lines.values():
            for test in found:
                here[test] = here.get(test, 0) + 1

        def worth(test):
            both = test, test.split("::")[0]  # what its file's fixtures ran counts with what it ran itself
            share = sum(here.get(t, 0) for t in both) / max(1, sum(self.total.get(t, 0) for t in both))
            # Squared: a test of this very module, though slow, before many that only pass through it.
            return -(share**2) / (self.seconds[test] + 0.3)

        functions: dict[str, list[str]] = {}
        for test in sorted(tests, key=lambda t: (worth(t), t)):
            functions.setdefault(test.split("[")[0], []).append(test)
        rounds = itertools.zip_longest(*functions.values())
        return [test for row in rounds for test in row if test is not None]

    @staticmethod
    def _by_file(tests):
        """Files in turn: what a module's fixtures set up would be set up again whenever pytest came back to it."""
        files: dict[str, list[str]] = {}
        for test in tests:
            files.setdefault(test.split("::")[0], []).append(test)
        return [test for kept in files.values() for test in kept]

    def _expanded(self, contexts):
        """Tests of these contexts; what a fixture ran belongs to every test of its file."""
        found = {c for c in contexts if c in self.seconds}
        files = {c for c in contexts if "::" not in c}
        return found | {t for t in self.seconds if t.split("::")[0] in files}


@cache
def _lines_now(name, recorded):
    """Of each line that was recorded, those that take its tests now: itself, and what is new behind it."""
    path = ROOT / name
    new = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    old = recorded.read_text(encoding="utf-8").splitlines() if recorded.exists() else new
    if old == new:
        return {k: [k] for k in range(1, len(old) + 1)}
    matcher = difflib.SequenceMatcher(None, old, new, autojunk=False)
    found = {a + k + 1: [b + k + 1] for a, b, size in matcher.get_matching_blocks() for k in range(size)}
    owner = {now[0]: then for then, now in found.items()}
    for line in range(2, len(new) + 1):
        if line not in owner and line - 1 in owner:
            owner[line] = owner[line - 1]
            found[owner[line]].append(line)
    return found
