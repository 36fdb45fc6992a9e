"""One-line faults planted in formulas, and how many the tests of their own package notice.

    python benchmarks/mutants.py [--packages NAME ...] [--count N] [--seed N] [-o FILE]

A fault is a sign, operator, comparison, constant, index or function (minimum for maximum, sine for
cosine) replaced in a copy of the sources. Loops run as Python (``NUMBA_DISABLE_JIT``). First the
package's tests run once, each at most ``LONGEST`` seconds, and note the lines that they run; then a
fault is shown to the tests that run its line, the fastest first, until one fails. A fault that no
test notices is a missing known answer, dead code, or no fault. Names the faults that stay
unnoticed.
"""

import argparse
import ast
import copy
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from pathlib import Path

import coverage
import pytest
from evidence import write_evidence

ROOT = Path(__file__).resolve().parent.parent
COPIED = ("rbfmuscle", "pbd_baseline", "tests", "benchmarks", "docs", "examples")
# Folders of a package's modules and of its tests.
PACKAGES = {
    name: (f"rbfmuscle/{name}", f"tests/{name}")
    for name in ("geometry", "metrics", "bones", "surface", "solid")
} | {"pbd_baseline": ("pbd_baseline", "tests/pbd")}
# In seconds of the processor, so that what else runs on the machine changes no answer.
LONGEST = 20.0  # of a test, coverage included: slower ones are left out
SHOWN = 30.0  # of the tests that a fault is shown to
HANGS = 5.0  # times as long as its tests take, and as many seconds more: it counts as noticed
WAITS = 10.0  # times that, on the clock
MEMORY = 4 << 30  # bytes of a process: a fault may ask for any number of them
TINY = 1e-6  # guards against zero and rounding: no known answer depends on them

# What is imported before processes are forked cannot be rewritten by pytest, and need not be.
PLAIN = ["-q", "-n0", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]

SWAPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
PAIRS = (
    ("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("sin", "cos"),
    ("floor", "ceil"), ("any", "all"),
)  # fmt: skip
OTHER = dict(PAIRS) | {b: a for a, b in PAIRS}
TEXT = (ast.JoinedStr, ast.List, ast.ListComp, ast.Tuple)


def changed(node):
    """The fault that takes an expression's place, None where it has none."""
    new = copy.deepcopy(node)
    match node:
        case ast.BinOp(left=left, right=right, op=op) if type(op) in SWAPPED:
            none = [isinstance(x, TEXT) or _is_string(x) or _is_tiny(x) for x in (left, right)]
            new.op = SWAPPED[type(op)]()
            return None if any(none) else new
        case ast.Compare(ops=[op]) if type(op) in SWAPPED:
            new.ops = [SWAPPED[type(op)]()]
            return None if _is_string(node.comparators[0]) else new
        case ast.BoolOp(op=op):
            new.op = SWAPPED[type(op)]()
            return new
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return copy.deepcopy(operand)
        case ast.Call(func=ast.Name(id=name)) if name in OTHER:
            new.func.id = OTHER[name]
            return new
        case ast.Call(func=ast.Attribute(attr=name)) if name in OTHER:
            new.func.attr = OTHER[name]
            return new
        case ast.Constant(value=bool() | str() | None):
            return None
        case ast.Constant(value=int(value)):
            new.value = value + 1
            return new
        case ast.Constant(value=float(value)) if not _is_tiny(node):
            new.value = 2.0 * value if value else 1.0
            return new
    return None


def _is_string(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_tiny(node):
    value = node.value if isinstance(node, ast.Constant) else None
    return isinstance(value, float) and 0.0 < abs(value) < TINY


def places(tree):
    """Expressions of formulas: what a function computes, without annotations, messages and
    defaults. Constants of a module are choices, of which there is no known answer.
    """
    skipped = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)

    def walk(node):
        if isinstance(node, skipped):
            return
        if isinstance(node, ast.expr):
            yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "args") and not isinstance(
                node, ast.Call
            ):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from walk(child)

    for node in tree.body:
        for part in node.body if isinstance(node, ast.ClassDef) else [node]:
            if isinstance(part, ast.FunctionDef):
                yield from walk(part)


def sites(path):
    """Numbers of the expressions of a module, among `places`, that a fault can take."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [number for number, node in enumerate(places(tree)) if changed(node) is not None]


def plant(path, number):
    """Line of a site, what stands there, the fault in its place, and the source with it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    node = next(node for k, node in enumerate(places(tree)) if k == number)
    new = changed(node)
    parent, field, at = _parent(tree, node)
    if at is None:
        setattr(parent, field, new)
    else:
        getattr(parent, field)[at] = new
    source = ast.unparse(ast.fix_missing_locations(tree))
    return node.lineno, ast.unparse(node), ast.unparse(new), source


def _parent(tree, wanted):
    for node in ast.walk(tree):
        for field, value in ast.iter_fields(node):
            if value is wanted:
                return node, field, None
            if isinstance(value, list):
                for at, child in enumerate(value):
                    if child is wanted:
                        return node, field, at
    raise LookupError("the node is not of this tree")


class Watch:
    """A plugin of pytest: notes how long tests take, and ends those that take too long."""

    def __init__(self):
        self.seconds, self.left_out = {}, []

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.left_out.append(report.nodeid)

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem):
        ended = False

        def late(*_):
            nonlocal ended
            ended = True
            raise TimeoutError

        signal.signal(signal.SIGPROF, late)
        start = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        try:
            found = yield
        except BaseException:
            if not ended:
                raise
            # Where a signal comes between two lines the traceback has an entry without a line
            # number, which pytest cannot show.
            raise pytest.fail.Exception(
                "left out: takes too long without compiler", pytrace=False
            ) from None
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        self.seconds[pyfuncitem.nodeid] = time.process_time() - start
        return found


def in_child(folder, act, limit):
    """Result of ``act`` in a forked process that works in a folder, None where it takes longer than
    the limit [s of the processor], waits too long or dies.
    """
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        os.setsid()
        os.chdir(folder)
        sys.path[:0] = [str(folder), str(folder / "tests"), str(folder / "benchmarks")]
        sink = os.open(folder / "printed.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 1))
        try:
            answer.write_text(json.dumps(act()), encoding="utf-8")
        except BaseException:
            traceback.print_exc()
            raise
        finally:
            sys.stderr.flush()
            os._exit(0)
    end = time.monotonic() + WAITS * limit
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.02)
    return json.loads(answer.read_text(encoding="utf-8")) if answer.exists() else None


def first_run(folder, package):
    """Seconds of the package's tests, those left out, and which run each line of its modules."""

    modules, tests = PACKAGES[package]

    def act():
        counted = coverage.Coverage(data_file=None, source=[modules], config_file=False)

        users = defaultdict(list)  # tests of each fixture that several share

        class Contexts:
            def pytest_runtest_setup(self, item):
                self.test = item.nodeid
                counted.switch_context(self.test)
                for name in item.fixturenames:
                    users[name].append(self.test)

            @pytest.hookimpl(wrapper=True)
            def pytest_fixture_setup(self, fixturedef):
                if fixturedef.scope == "function":
                    return (yield)
                counted.switch_context(fixturedef.argname)
                made = yield
                counted.switch_context(self.test)
                return made

        watch = Watch()
        counted.start()
        ended = pytest.main([*PLAIN, tests], [watch, Contexts()])
        if ended not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            raise RuntimeError(f"pytest ended with {ended!r}")
        counted.stop()
        data = counted.get_data()
        lines = {
            str(Path(file).relative_to(folder)): {
                line: [test for name in names for test in users.get(name, [name])]
                for line, names in data.contexts_by_lineno(file).items()
            }
            for file in data.measured_files()
        }
        return watch.seconds, watch.left_out, lines

    return in_child(folder, act, 3600.0)


def noticed(folder, tests, limit):
    """Whether one of the tests fails."""

    def act():
        return int(pytest.main([*PLAIN, "-x", *tests]))

    return in_child(folder, act, limit) != 0


def spans(path):
    """First and last line of the innermost statement of each line of a module."""
    found = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt):
            last = node.body[0].lineno - 1 if hasattr(node, "body") else node.end_lineno
            for line in range(node.lineno, max(last, node.lineno) + 1):
                if line not in found or node.lineno >= found[line][0]:
                    found[line] = (node.lineno, last)
    return found


def measure(folder, package, asked):
    """Plant faults in a package; how many, how many were noticed, and those that were not."""
    found = first_run(folder, package)
    if found is None:
        said = (folder / "printed.txt").read_text(encoding="utf-8")
        raise SystemExit(f"{said[-4000:]}\nthe tests of {package} do not run")
    seconds, left_out, lines = found
    print(f"{package}: {len(seconds)} tests, {sum(seconds.values()):.0f} s", flush=True)
    print("".join(f"    left out: {name}\n" for name in left_out), end="", flush=True)
    if not seconds or noticed(folder, list(seconds), 3600.0):
        said = (folder / "printed.txt").read_text(encoding="utf-8")
        raise SystemExit(f"{said[-4000:]}\nthe tests of {package} fail without a fault")
    planted = [
        (path.relative_to(folder), number)
        for path in sorted((folder / PACKAGES[package][0]).rglob("*.py"))
        if not asked.files or path.name in asked.files
        for number in sites(path)
    ]
    every = len(planted)
    random.Random(asked.seed).shuffle(planted)
    survivors, planted = [], planted[: asked.count]
    for path, number in planted:
        file = folder / path
        line, old, new, source = plant(file, number)
        first, last = spans(file)[line]
        contexts = lines.get(str(path), {})
        running = {name for k in range(first, last + 1) for name in contexts.get(str(k), ())}
        tests, spent = [], 0.0
        # What runs when a module is imported runs for each of its tests.
        for name in sorted(running & set(seconds) or set(seconds), key=seconds.get):
            if spent + seconds[name] > SHOWN:
                break
            tests.append(name)
            spent += seconds[name]
        before = file.read_text(encoding="utf-8")
        file.write_text(source, encoding="utf-8")
        seen = bool(tests) and noticed(folder, tests, HANGS * (spent + 1.0))
        file.write_text(before, encoding="utf-8")
        if not seen:
            survivors.append(f"{path}:{line}: {old} -> {new}")
            print(f"    {survivors[-1]}", flush=True)
    found = len(planted) - len(survivors)
    print(f"{package}: {found} of {len(planted)} faults noticed, of {every}", flush=True)
    return [f"`{package}`", every, len(planted), found], survivors


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--packages", nargs="+", choices=PACKAGES, default=list(PACKAGES))
    parser.add_argument("--files", nargs="*", help="names of modules, otherwise all")
    parser.add_argument("--count", type=int, default=60, help="faults of each package, at random")
    parser.add_argument("--seed", type=int, default=67)
    parser.add_argument(
        "-o", "--output", type=Path, help="file of evidence; rows of other packages stay in it"
    )
    asked = parser.parse_args()
    os.environ |= {"NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    sys.dont_write_bytecode = True
    # Once, before processes are forked.
    import numba  # noqa: F401
    import scipy.spatial  # noqa: F401
    import trimesh  # noqa: F401

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place).resolve()
        for name in COPIED:
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, folder / name, ignore=ignored)
        shutil.copy(ROOT / "pyproject.toml", folder)
        measured = [measure(folder, package, asked) for package in asked.packages]
    if asked.output:
        heads = ["package", "formulas that can take a fault", "planted at random", "noticed"]
        rows, missed = _measured_before(asked.output, asked.packages)
        rows += [row for row, _ in measured]
        missed += [line for _, survivors in measured for line in survivors]
        command = ["benchmarks/mutants.py", "--count", str(asked.count), "--seed", str(asked.seed)]
        write_evidence(asked.output, command, rows, heads, survivors=missed)


def _measured_before(path, packages):
    """Rows and survivors of the other packages in a file of evidence."""
    if not path.exists():
        return [], []
    kept = json.loads(path.read_text(encoding="utf-8"))
    rows = [row for row in kept["rows"] if row[0].strip("`") not in packages]
    left_out = tuple(f"{PACKAGES[name][0]}/" for name in packages)
    return rows, [line for line in kept["survivors"] if not line.startswith(left_out)]


if __name__ == "__main__":
    main()
