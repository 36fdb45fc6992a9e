"""Planted faults: a seeded sample over all packages, each against the tests that reach its line.

    python benchmarks/mutants.py record [TESTS...]              which tests run which lines, with and without compiler
    python benchmarks/mutants.py run [--count N] [--seed S] [--minutes M]
    python benchmarks/mutants.py table [--seed S]

A fault changes one expression: a comparison, an operator, a sign, a constant, a truth value. It lies in a copy of the
checkout, never in the checkout. Faults in compiled loops are tried without compiler, all others with it. What went
unnoticed is listed; what changes nothing that could be told is named in ``.mutants/equivalent.json`` by its key, with
the reason, and counted apart. The same command goes on where it ended.
"""

import argparse
import ast
import compileall
import copy
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
WORK = Path(os.environ.get("MUTANTS_FOLDER", ROOT / ".mutants"))
PACKAGES = ("rbfmuscle", "pbd_baseline")
# A fault is tried on so many tests at most, of so many seconds together as recorded; then on the processor's time.
MOST, BUDGET, LIMIT = 20, 20.0, 180
LEFT_OUT = (".git", ".venv", ".mutants", "__pycache__", "*.egg-info", ".hypothesis", "demo_output", "images")
COMPARE = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
}
TOGETHER = {ast.And: ast.Or, ast.Or: ast.And}


@dataclass(frozen=True)
class Fault:
    """One expression of a file and what stands in its place.

    Attributes
    ----------
    path : str
        Relative to the checkout.
    line : int
    start, end : int
        Of the expression in the file [byte].
    text : str
        In its place.
    loop : bool
        Whether it lies in a compiled loop.
    inside : bool
        Whether it lies in a function: other lines run when the module is imported.
    """

    path: str
    line: int
    start: int
    end: int
    text: str
    loop: bool
    inside: bool

    def planted(self, source: bytes) -> bytes:
        """The file with the fault."""
        return source[: self.start] + f"({self.text})".encode() + source[self.end :]

    def key(self, source: bytes) -> str:
        """A name that stays while the expression and its place in the file stay."""
        before = source[self.start : self.end].decode()
        words = f"{self.path}\n{self.line}\n{before}\n{self.text}"
        return hashlib.sha256(words.encode()).hexdigest()[:12]


def changed(node: ast.AST) -> ast.AST | None:
    """A faulty copy of an expression, None where there is none."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.Compare) and type(new.ops[0]) in COMPARE:
        new.ops[0] = COMPARE[type(new.ops[0])]()
    elif isinstance(new, ast.BinOp) and type(new.op) in ARITHMETIC:
        new.op = ARITHMETIC[type(new.op)]()
    elif isinstance(new, ast.BoolOp):
        new.op = TOGETHER[type(new.op)]()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.USub | ast.Not):
        return new.operand
    elif isinstance(new, ast.Constant) and isinstance(new.value, bool):
        new.value = not new.value
    elif isinstance(new, ast.Constant) and isinstance(new.value, int | float):
        new.value = new.value + 1 if isinstance(new.value, int) else 1.25 * new.value or 1.0
    else:
        return None
    return new


def faults_of(path: Path) -> list[Fault]:
    """All faults of a file, but in annotations, decorators, f-strings and what is for type checkers."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Fault] = []

    def walk(node, loop, inside):
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    visit(child, loop, inside)

    def visit(node, loop, inside):
        if isinstance(node, ast.JoinedStr) or (
            isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        ):
            return
        if isinstance(node, ast.FunctionDef):
            inside = True
            loop = loop or any(
                word in ast.unparse(d) for d in node.decorator_list for word in ("compiled", "njit")
            )
        new = changed(node)
        if new is not None:
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            relative = str(path.relative_to(ROOT))
            found.append(Fault(relative, node.lineno, start, end, ast.unparse(new), loop, inside))
        walk(node, loop, inside)

    walk(ast.parse(source), False, False)
    return found


def group_of(path: str) -> str:
    """The package that a file counts to."""
    parts = path.split("/")
    return parts[1] if parts[0] == "rbfmuscle" and len(parts) > 2 else parts[0]


def sample(count: int, seed: int) -> list[Fault]:
    """A seeded sample in which each package has its turn."""
    groups = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for fault in faults_of(path):
                groups[group_of(fault.path)].append(fault)
    dice = random.Random(seed)
    for faults in groups.values():
        dice.shuffle(faults)
    turns = (groups[name][k] for k in range(count) for name in sorted(groups) if k < len(groups[name]))
    return [fault for fault, _ in zip(turns, range(count))]


def record(tests: list[str]) -> None:
    """Run tests with compiler, and those of ``tests/nojit.txt`` without, and keep which lines each runs."""
    import coverage

    listed = [
        line
        for line in (ROOT / "tests/nojit.txt").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    ]
    WORK.mkdir(exist_ok=True)
    for kind, files in (("plain", tests or listed), ("compiled", tests or ["tests"])):
        data, times = WORK / f"{kind}.coverage", WORK / f"{kind}.xml"
        more = {"COVERAGE_FILE": str(data)} | ({"NUMBA_DISABLE_JIT": "1"} if kind == "plain" else {})
        command = [sys.executable, "-m", "pytest", "-q", "-n", os.environ.get("WORKERS", "auto"), *files]
        options = [
            "--cov",
            "--cov-context=test",
            "--cov-report=",
            f"--junitxml={times}",
            "-p",
            "no:cacheprovider",
        ]
        subprocess.run([*command, *options], cwd=ROOT, env={**os.environ, **more}, check=False)
        kept = coverage.CoverageData(str(data))
        kept.read()
        lines = {}
        for file in kept.measured_files():
            contexts = kept.set_query_contexts(None) or kept.contexts_by_lineno(file)
            relative = os.path.relpath(file, ROOT)
            lines[relative] = {n: [c.rpartition("|")[0] for c in cs if c] for n, cs in contexts.items()}
        seconds = {
            f"{case.get('classname', '').replace('.', '/')}/{case.get('name')}": float(case.get("time", 0.0))
            for case in ElementTree.parse(times).iter("testcase")
        }
        (WORK / f"{kind}.json").write_text(json.dumps({"lines": lines, "seconds": seconds}))


class Reach:
    """Which tests reach a line, by a recording."""

    def __init__(self, kind: str) -> None:
        path = WORK / f"{kind}.json"
        found = (
            json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"lines": {}, "seconds": {}}
        )
        self.lines, self.seconds = found["lines"], found["seconds"]

    def tests(self, fault: Fault) -> list[str]:
        """Tests that run a fault's line, quick ones first; of what runs at import, tests that run its module."""
        lines = self.lines.get(fault.path, {})
        found = set(lines.get(str(fault.line), ())) if fault.inside else set()
        found = found or {test for tests in lines.values() for test in tests}
        chosen, spent = [], 0.0
        for test in sorted(found, key=lambda t: (self._time(t), t)):
            spent += self._time(test)
            if len(chosen) == MOST or (chosen and spent > BUDGET):
                break
            chosen.append(test)
        return chosen

    def _time(self, test):
        file, _, rest = test.partition("::")
        return self.seconds.get(f"{file.removesuffix('.py')}/{rest}".replace("::", "/"), 1.0)


def passes(tree: Path, tests: list[str], kind: str) -> tuple[bool, str]:
    """Whether tests pass in a copy of the checkout, and the first that fails; too much time counts as failing."""
    paths = os.pathsep.join(str(tree / part) for part in ("", "benchmarks", "tests"))
    more = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}
    more |= {"NUMBA_DISABLE_JIT": "1"} if kind == "plain" else {}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-n",
        "0",
        "--tb=no",
        "-rf",
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run(
        [*command, *tests], cwd=tree, env={**os.environ, **more}, capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 1)),
    )  # fmt: skip
    failed = [
        line.removeprefix("FAILED ").partition(" - ")[0]
        for line in done.stdout.splitlines()
        if line.startswith("FAILED ")
    ]
    return done.returncode in (0, 5), failed[0] if failed else ""


def run(count: int, seed: int, minutes: float) -> None:
    """Plant the sample one after the other until the time is over; what has a result is not run again."""
    end, tree = time.monotonic() + 60.0 * minutes, WORK / f"tree{os.getpid()}"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
    for part in (*PACKAGES, "tests", "benchmarks"):
        compileall.compile_dir(tree / part, quiet=2)
    reach, sound = {kind: Reach(kind) for kind in ("plain", "compiled")}, {}
    done = {row["key"] for row in results()}
    for fault in sample(count, seed):
        path = tree / fault.path
        source = path.read_bytes()
        key = fault.key(source)
        if key in done:
            continue
        if time.monotonic() > end:
            print("time is over; the same command goes on from here")
            break
        outcome, by = "unreached", ""
        for kind in ("plain",) if fault.loop else ("compiled", "plain"):
            tests = [test for test in reach[kind].tests(fault) if sound.get((kind, test), True)]
            while tests and outcome != "noticed":
                path.write_bytes(fault.planted(source))
                good, by = passes(tree, tests, kind)
                path.write_bytes(source)
                outcome = "unnoticed" if good else "noticed"
                if outcome == "noticed" and by in tests:  # a test that fails anyway tells nothing
                    sound.setdefault((kind, by), passes(tree, [by], kind)[0])
                    if not sound[kind, by]:
                        outcome, tests = "unreached", [test for test in tests if test != by]
                        continue
                break
            if outcome != "unreached":
                break
        before = source[fault.start : fault.end].decode()
        row = {"key": key, "seed": seed, "outcome": outcome, "by": by, "path": fault.path, "line": fault.line}
        with (WORK / "results.jsonl").open("a") as file:
            file.write(json.dumps({**row, "loop": fault.loop, "before": before, "after": fault.text}) + "\n")
        print(f"{outcome:9} {key} {fault.path}:{fault.line} {before!r} -> {fault.text!r}", flush=True)
    shutil.rmtree(tree, ignore_errors=True)


def results() -> list[dict]:
    """All results so far."""
    path = WORK / "results.jsonl"
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    )


def table(seed: int) -> str:
    """Planted, noticed, unnoticed and equivalent faults, by package."""
    named = WORK / "equivalent.json"
    equivalent = json.loads(named.read_text(encoding="utf-8")) if named.exists() else {}
    rows: dict[str, list[int]] = {}
    for row in results():
        if row["seed"] == seed:
            kind = 2 if row["key"] in equivalent else 0 if row["outcome"] == "noticed" else 1
            for name in (group_of(row["path"]), "all"):
                rows.setdefault(name, [0, 0, 0])[kind] += 1
    lines = [
        "| package | planted | noticed | unnoticed | equivalent | noticed of the others |",
        "|---|---|---|---|---|---|",
    ]
    for name in sorted(rows, key=lambda name: (name == "all", name)):
        yes, no, same = rows[name]
        share = f"{100 * yes / (yes + no):.0f} %" if yes + no else "–"
        lines.append(f"| {name} | {yes + no + same} | {yes} | {no} | {same} | {share} |")
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["record", "run", "table"])
    parser.add_argument("tests", nargs="*")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=10.0)
    given = parser.parse_args()
    if given.what == "record":
        record(given.tests)
        return
    if given.what == "run":
        run(given.count, given.seed, given.minutes)
    print(table(given.seed))


if __name__ == "__main__":
    main()
