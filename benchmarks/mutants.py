"""Planted faults: a seeded sample over all packages, each against the tests that reach its line.

    python benchmarks/mutants.py record [TESTS...]              which tests run which lines, with
    and without compiler python benchmarks/mutants.py run [--count N] [--seed S] [--minutes M]
    python benchmarks/mutants.py table [--seed S]

A fault changes one expression: a comparison, an operator, a sign, a constant, a truth value. It
lies in a copy of the checkout, never in the checkout. It is tried on quick tests of different files
first, and what these let pass on more, each time first on some that compare with kept numbers.
Faults in compiled loops are tried without compiler, then with it, all others with it. What went
unnoticed is listed; what changes nothing that could be told is named in
``.mutants/equivalent.json`` by its key, with the reason, and counted apart. The same command goes
on where it ended.
"""

import argparse
import ast
import compileall
import copy
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
WORK = Path(os.environ.get("MUTANTS_FOLDER", ROOT / ".mutants"))
PACKAGES = ("rbfmuscle", "pbd_baseline")
# A fault is tried on so many tests at most, of so many seconds together as recorded: quick ones,
# then others.
STEPS = ((30, 25.0), (60, 90.0))
# seconds of compiling at most, beside three times those of the tests: more is an endless loop
LIMIT = 180
PYTEST = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
COLD = ("bones", "geometry", "implicit", "muscle")  # what they compute is cached, right or wrong
KEPT, FIRST = "what_is_kept", 6  # tests that compare many numbers, and how many of them come first
WORD = re.compile(r"\w+")
LEFT_OUT = (
    ".git",
    ".venv",
    ".mutants",
    "__pycache__",
    "*.egg-info",
    ".hypothesis",
    "demo_output",
    "images",
)
COMPARE = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
ARITHMETIC |= {ast.FloorDiv: ast.Mult}
TOGETHER = {ast.And: ast.Or, ast.Or: ast.And}


@dataclass(frozen=True)
class Fault:
    """One expression of a file and what stands in its place.

    ``path`` is relative to the checkout; the expression goes from byte ``start`` to ``end``,
    ``text`` is in its place; ``loop`` says whether it is in a compiled loop. ``first`` and ``last``
    are the lines of its statement, of a default value those of the function. ``name`` is of what
    holds it, where its line runs within no test: the compiled loop, or what is assigned at import.
    """

    path: str
    line: int
    start: int
    end: int
    text: str
    loop: bool
    first: int
    last: int
    name: str

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


def is_loop(node: ast.FunctionDef) -> bool:
    """Whether a function is compiled."""
    return any(word in ast.unparse(d) for d in node.decorator_list for word in ("compiled", "njit"))


def assigned(node: ast.stmt) -> str:
    """The name that a statement gives a value, empty of others."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    names = (
        [part.id for part in ast.walk(targets[0]) if isinstance(part, ast.Name)]
        if targets[0]
        else []
    )
    return names[0] if names else ""


def faults_of(path: Path) -> list[Fault]:
    """All faults of a file, but in annotations, decorators, f-strings and what is for type
    checkers.
    """
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Fault] = []

    def walk(node, at):
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    visit(child, at)

    def visit(node, at):
        if isinstance(node, ast.JoinedStr) or (
            isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        ):
            return
        loop, inside, name, span = at
        if isinstance(node, ast.FunctionDef):
            loop = loop or is_loop(node)
            inside, name = True, name if at[0] else node.name if loop else ""
        if isinstance(node, ast.stmt):
            body = hasattr(node, "body") and not isinstance(node, ast.FunctionDef)
            span = node.lineno, node.lineno if body else node.end_lineno
            name = name if inside else assigned(node)
        new = changed(node)
        if new is not None:
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            relative = str(path.relative_to(ROOT))
            found.append(
                Fault(relative, node.lineno, start, end, ast.unparse(new), loop, *span, name)
            )
        walk(node, (loop, inside, name, span))

    walk(ast.parse(source), (False, False, "", (1, 1)))
    return found


def group_of(path: str) -> str:
    """The package that a file counts to."""
    parts = path.split("/")
    return parts[1] if parts[0] == "rbfmuscle" and len(parts) > 2 else parts[0]


def sample(count: int, seed: int) -> list[Fault]:
    """A seeded sample in which each package has its turn; a change of the source changes little of
    it.
    """
    groups = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for fault in faults_of(path):
                groups[group_of(fault.path)].append(fault)
    for faults in groups.values():
        faults.sort(key=lambda fault: hashlib.sha256(f"{seed} {fault}".encode()).digest())
    turns = (
        groups[name][k] for k in range(count) for name in sorted(groups) if k < len(groups[name])
    )
    return [fault for fault, _ in zip(turns, range(count))]


def record(tests: list[str]) -> None:
    """Run tests with compiler, and those of ``tests/nojit.txt`` without, and keep which lines each
    runs.
    """
    import coverage

    text = (ROOT / "tests/nojit.txt").read_text(encoding="utf-8")
    listed = re.findall(r"^[^#\n].*", text, re.MULTILINE)
    WORK.mkdir(exist_ok=True)
    for kind, files in (("plain", tests or listed), ("compiled", tests or ["tests"])):
        data, times = WORK / f"{kind}.coverage", WORK / f"{kind}.xml"
        more = {"COVERAGE_FILE": str(data), "RBFMUSCLE_CACHE": str(WORK / "cache")}
        more |= {"NUMBA_DISABLE_JIT": "1"} if kind == "plain" else {}
        workers = os.environ.get("WORKERS", "auto")
        options = f"-q -n {workers} --cov --cov-context=test --cov-report=".split()
        command = [*PYTEST, *options, f"--junitxml={times}", *files]
        subprocess.run(command, cwd=ROOT, env={**os.environ, **more}, check=False)
        kept, lines = coverage.CoverageData(str(data)), {}
        kept.read()
        for file in [
            file for file in kept.measured_files() if file.endswith(".py")
        ]:  # not templates
            contexts = kept.set_query_contexts(None) or kept.contexts_by_lineno(file)
            relative = os.path.relpath(file, ROOT)
            lines[relative] = {
                n: [c.rpartition("|")[0] for c in cs if c] for n, cs in contexts.items()
            }
        seconds = {}
        for case in ElementTree.parse(times).iter("testcase"):
            file, _, group = case.get("classname", "").replace(".", "/").partition("/Test")
            parts = [f"{file}.py", *[f"Test{group}"][: bool(group)], case.get("name", "")]
            seconds["::".join(parts)] = float(case.get("time", 0.0))
        (WORK / f"{kind}.json").write_text(json.dumps({"lines": lines, "seconds": seconds}))


class Reach:
    """Which tests reach a line, by a recording."""

    def __init__(self, kind: str) -> None:
        path = WORK / f"{kind}.json"
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        self.kind = kind
        self.lines = found.get("lines", {})
        self.seconds = found.get("seconds", {})
        self.run = Counter(
            t for lines in self.lines.values() for found in lines.values() for t in found
        )
        self.tests = set(self.seconds)
        files = {test.partition("::")[0] for test in self.tests}
        self.named = {
            file: set(WORD.findall((ROOT / file).read_text(encoding="utf-8"))) for file in files
        }
        self.words: dict[tuple[str, str], set[str]] = {}
        self.made: list[tuple[str, set[str]]] = []
        for file, lines in self.lines.items():
            text = (ROOT / file).read_text(encoding="utf-8")
            split = dict(enumerate(text.splitlines(), 1))
            self.words |= {(file, n): set(WORD.findall(split.get(int(n), ""))) for n in lines}
            for node in ast.parse(text).body:
                loop = isinstance(node, ast.FunctionDef) and is_loop(node)
                name = node.name if loop else assigned(node)
                if name:
                    self.made.append((name, set(WORD.findall(ast.unparse(node)))))

    def steps(self, fault: Fault) -> list[list[str]]:
        """Tests that run a fault's line, by step: of its own file, then in turn of all, quick ones
        of each first.
        """
        lines, span = self.lines.get(fault.path, {}), range(fault.first, fault.last + 1)
        found = set(lines.get(str(fault.line), ())) or {
            t for n in span for t in lines.get(str(n), ())
        }
        if fault.name and not (fault.loop and self.kind == "plain"):
            found = self._naming(fault.name)
        if not found and not fault.loop:
            found = {test for tests in lines.values() for test in tests}
        own, folder = f"/test_{Path(fault.path).stem}.py", f"/{group_of(fault.path)}/"
        # Tests with processes of their own run lines that are not recorded as theirs.
        apart = {
            t
            for t in self.tests
            if folder in t and "subprocess" in self.named[t.partition("::")[0]]
        }
        # So do fixtures of a whole file, which count to its first test.
        files, direct = {test.partition("::")[0] for test in found}, found
        kept = {test for test in self.tests if KEPT in test and test.partition("::")[0] in files}
        found = found | apart | kept | {test for test in self.tests if own in test}
        order, seen = {}, defaultdict(int)
        for test in sorted(found, key=lambda t: (self.time(t), t)):
            file, case = test.partition("::")[0], test.partition("[")[0]
            turn = -1 if own in file else seen[file] // (6 if folder in file else 1)
            # One case of each test that has several comes first, of quick ones of the own file
            # eight.
            again = seen[case] // (8 if own in file and self.time(test) < 0.1 else 1)
            order[test] = 3 * again + turn, self.time(test), test
            seen[file] += seen[case] == 0
            seen[case] += 1
        ordered, steps = self._kept_first(sorted(found, key=order.__getitem__), direct), []
        for most, budget in STEPS:
            chosen, spent = [], 0.0
            for test in ordered:
                spent += self.time(test)
                if len(chosen) == most or (chosen and spent > budget):
                    break
                chosen.append(test)
            steps.append(chosen)
            ordered = self._kept_first(ordered[len(chosen) :], direct)
        return [step for step in steps if step]

    def _kept_first(self, tests, direct):
        kept = sorted(
            (t for t in tests if KEPT in t), key=lambda t: (t not in direct, self.run[t])
        )[:FIRST]
        return kept + [test for test in tests if test not in kept]

    def _naming(self, name):
        """Tests that say a name or run a line with it, or with that of a loop or constant that is
        made with it.
        """
        names: set[str] = set()
        more = {name}
        while more:
            names |= more
            more = {made for made, words in self.made if words & names} - names
        found = [self.lines[file][n] for (file, n), words in self.words.items() if words & names]
        found.append([test for test in self.tests if self.named[test.partition("::")[0]] & names])
        return {test for tests in found for test in tests}

    def time(self, test: str) -> float:
        """Seconds that a test took."""
        return float(self.seconds.get(test, 1.0))


def passes(tree: Path, tests: list[str], kind: str, *, seconds: float) -> tuple[bool, str]:
    """Whether tests pass in a copy of the checkout, and the first that fails; too much time counts
    as failing.
    """
    limit = int(LIMIT + 3.0 * seconds)
    paths = os.pathsep.join(str(tree / part) for part in ("", "benchmarks", "tests"))
    more = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}
    more |= {"RBFMUSCLE_LOOPS": str(WORK / "loops"), "RBFMUSCLE_CACHE": str(tree / "cache")}
    more |= {"NUMBA_DISABLE_JIT": "1"} if kind == "plain" else {}
    with tempfile.TemporaryFile("w+") as out:
        process = subprocess.Popen(
            [*PYTEST, "-xq", "-n0", "--tb=no", "-rf", *tests],
            cwd=tree,
            env={**os.environ, **more},
            stdout=out,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1)),
        )
        try:
            code = process.wait(3 * limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            code = process.wait()
        if code == 4:
            raise SystemExit("a test that was recorded is not here any more: record again")
        out.seek(0)
        failed = [
            line[7:].partition(" - ")[0].strip() for line in out if line.startswith("FAILED ")
        ]
    return code in (0, 5), failed[0] if failed else ""


def run(count: int, seed: int, minutes: float) -> None:
    """Plant the sample until the time is over: all on quick tests, then what these let pass on
    others.
    """
    end, tree = time.monotonic() + 60.0 * minutes, WORK / f"tree{os.getpid()}"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
    for part in (*PACKAGES, "tests", "benchmarks"):
        compileall.compile_dir(tree / part, quiet=2)
    reach, sound = {kind: Reach(kind) for kind in ("plain", "compiled")}, {}
    done = {row["key"]: row for row in results()}
    for step, fault in ((k, fault) for k in range(len(STEPS)) for fault in sample(count, seed)):
        path = tree / fault.path
        source = path.read_bytes()
        key = fault.key(source)
        before = done.get(key, {"outcome": "unreached", "step": -1})
        if before["outcome"] == "noticed" or before["step"] >= step:
            continue
        if time.monotonic() > end:
            print("time is over; the same command goes on from here")
            break
        if group_of(fault.path) not in COLD and (WORK / "cache").exists():
            shutil.copytree(WORK / "cache", tree / "cache", copy_function=os.link)
        outcome, by = before["outcome"], ""
        for kind in ("plain", "compiled") if fault.loop else ("compiled", "plain"):
            steps = reach[kind].steps(fault)[step : step + 1]
            tests = [test for chosen in steps for test in chosen if sound.get((kind, test), True)]
            while tests and outcome != "noticed":
                path.write_bytes(fault.planted(source))
                seconds = sum(map(reach[kind].time, tests))
                good, by = passes(tree, tests, kind, seconds=seconds)
                path.write_bytes(source)
                if not good and by in tests:  # a test that fails anyway tells nothing
                    sound.setdefault((kind, by), passes(tree, [by], kind, seconds=seconds)[0])
                    if not sound[kind, by]:
                        tests.remove(by)
                        continue
                outcome = "unnoticed" if good else "noticed"
                break
            if outcome == "noticed" or (outcome == "unnoticed" and not fault.loop):
                break
        shutil.rmtree(tree / "cache", ignore_errors=True)
        text = source[fault.start : fault.end].decode()
        row = {
            "key": key,
            "seed": seed,
            "outcome": outcome,
            "step": step,
            "by": by,
            "path": fault.path,
        }
        row |= {"line": fault.line, "loop": fault.loop, "before": text, "after": fault.text}
        done[key] = row
        with (WORK / "results.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(f"{outcome:9} {key} {fault.path}:{fault.line} {text!r} -> {fault.text!r}", flush=True)
    shutil.rmtree(tree, ignore_errors=True)


def results() -> list[dict]:
    """The last result of each fault so far."""
    path = WORK / "results.jsonl"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return list({row["key"]: row for row in map(json.loads, text.splitlines())}.values())


def table(seed: int) -> str:
    """Planted, noticed, unnoticed and equivalent faults, by package."""
    named = WORK / "equivalent.json"
    equivalent = json.loads(named.read_text(encoding="utf-8")) if named.exists() else {}
    rows: dict[str, list[int]] = {}
    for row in results():
        if row["seed"] == seed:
            kind = 0 if row["outcome"] == "noticed" else 2 if row["key"] in equivalent else 1
            for name in (group_of(row["path"]), "all"):
                rows.setdefault(name, [0, 0, 0])[kind] += 1
    heads = ("package", "planted", "noticed", "unnoticed", "equivalent", "noticed of the others")
    lines = [f"| {' | '.join(heads)} |", "|" + len(heads) * "---|"]
    for name in sorted(rows, key=lambda name: (name == "all", name)):
        yes, no, same = rows[name]
        share = f"{100 * yes / (yes + no):.0f} %" if yes + no else "–"
        lines.append(f"| {name} | {yes + no + same} | {yes} | {no} | {same} | {share} |")
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["record", "run", "table"])
    parser.add_argument("tests", nargs="*")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=10.0)
    given = parser.parse_args()
    if given.what == "record":
        return record(given.tests)
    if given.what == "run":
        run(given.count, given.seed, given.minutes)
    return print(table(given.seed))


if __name__ == "__main__":
    main()
