"""``make mutants``: record which tests reach which lines, plant a seeded sample of faults, tell the table.

Usage: ``python -m mutants record [TESTS...]``, ``run [--count N] [--seed S] [--minutes M] [--rooms R,...] [--loops]``,
``again`` or ``table``.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = Path(os.environ.get("MUTANTS_FOLDER", ROOT / ".mutants"))
# With the compiler off a test that is worth running takes seconds; the whole suite would take days.
LIMIT, PATIENCE = 12.0, 3
UNCOMPILED = ("geometry", "implicit", "model", "pbd", "sim", "study")


def record(files: list[str]) -> None:
    """Run test files with and without compiler, in a worker for each core; those recorded already are left."""
    every = sorted(str(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("test_*.py"))
    for kind in ("plain", "compiled"):
        kept = WORK / kind
        todo = [
            file
            for file in files or every
            if (kind == "compiled" or file.split("/")[1] in UNCOMPILED)
            and (files or not (kept / (file.replace("/", "_") + ".json")).exists())
        ]
        if not todo:
            continue
        print(f"{kind}: {len(todo)} files", flush=True)
        extra = {"MUTANTS_RECORD": str(kept), "PYTHONPATH": str(HERE.parent)}
        if kind == "plain":
            extra |= {
                "NUMBA_DISABLE_JIT": "1",
                "MUTANTS_LIMIT": str(LIMIT),
                "MUTANTS_PATIENCE": str(PATIENCE),
            }
        command = [sys.executable, "-m", "pytest", "-q", "-p", "mutants.contexts", "-p", "no:cacheprovider"]
        workers = ["-n", os.environ.get("WORKERS", "auto"), "--dist", "loadfile"]
        subprocess.run([*command, *workers, *todo], cwd=ROOT, env={**os.environ, **extra}, check=False)


def run(count: int, seed: int, minutes: float, rooms: list[str], loops: bool | None) -> None:
    """Plant the sample one after another until the time is over; what has a result is not run again."""
    from mutants.reach import Reach
    from mutants.runner import copy_tree, preload

    preload()
    end = time.monotonic() + 60.0 * minutes
    reach = {kind: Reach.load(WORK / kind) for kind in ("plain", "compiled")}
    tree = WORK / f"tree{os.getpid()}"
    copy_tree(tree)
    sound = Sound(tree)
    for fault in kept_sample(count, seed, rooms, loops):
        if time.monotonic() > end:
            print("time is over; the same command goes on from here")
            break
        row = describe(fault, seed, tree)
        if row is None or not claimed(row["key"]):
            continue
        named = row["key"] in equivalent()
        row |= {"outcome": "equivalent", "by": "", "tests": 0} if named else judge(fault, tree, reach, sound)
        with (WORK / "results.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        (WORK / "doing" / row["key"]).unlink()
        print(f"{row['outcome']:9} {fault.path}:{fault.line} {row['after'].strip()[:90]}", flush=True)
    shutil.rmtree(tree, ignore_errors=True)


def kept_sample(count: int, seed: int, rooms: list[str], loops: bool | None) -> list:
    """The sample, kept on disk for as long as no source changes: to find every place takes ten seconds."""
    from mutants.faults import PACKAGES, Fault, sample

    sources = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
    text = "".join(p.read_text(encoding="utf-8") for p in sources) + repr((count, seed, rooms, loops))
    path = WORK / f"sample-{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"
    if not path.exists():
        found = [dataclasses.asdict(fault) for fault in sample(count, seed, rooms=rooms, loops=loops)]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found), encoding="utf-8")
    return [Fault(**row) for row in json.loads(path.read_text(encoding="utf-8"))]


def claimed(key: str) -> bool:
    """Take a fault, unless it has a result or another share, running beside this one, is at it."""
    path = WORK / "doing" / key
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not Path("/proc", path.read_text(encoding="utf-8")).exists():
        path.unlink()  # of a share that was broken off
    mine = WORK / "doing" / f".{os.getpid()}"
    mine.write_text(str(os.getpid()), encoding="utf-8")
    try:
        os.link(mine, path)
    except FileExistsError:
        return False
    if any(row["key"] == key for row in results()):
        path.unlink()
        return False
    return True


def describe(fault, seed: int, tree: Path) -> dict | None:
    """What identifies a fault however its file grows: function, line before and after; None where nothing changes."""
    source = (tree / fault.path).read_text(encoding="utf-8")
    planted = fault.planted(source)
    old, new = source.splitlines(), planted.splitlines()
    changed = [(a, b) for a, b in zip(old, new) if a != b]
    if not changed:
        return None
    before, after = changed[0]
    return {
        "key": key_of(fault.path, fault.function, before.strip(), after.strip()), "seed": seed,
        "group": fault.group, "path": fault.path, "line": fault.line, "function": fault.function,
        "before": before, "after": after,
    }  # fmt: skip


def key_of(*facts: str) -> str:
    """A short name for a path, a function, and a line before and after."""
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()[:16]


def judge(fault, tree: Path, reach: dict, sound: Sound) -> dict:
    """Try the fault on the tests that reach it: without compiler in a loop, or where none with it does."""
    from mutants.runner import run_tests

    path = tree / fault.path
    source = path.read_text(encoding="utf-8")
    outcome, first, tried = "unreached", "", 0
    for kind in ("plain",) if fault.loop else ("compiled", "plain"):
        tests = sound.kept(reach[kind].tests(fault.path, fault.line, outside=not fault.function), kind)
        while tests:
            seconds = 30.0 + 2.0 * sum(reach[kind].seconds[t] for t in tests)
            try:
                path.write_text(fault.planted(source), encoding="utf-8")
                outcome, first = run_tests(tree, tests, compiler=kind == "compiled", seconds=seconds)
            finally:
                path.write_text(source, encoding="utf-8")
            tried += len(tests)
            if outcome != "noticed" or sound.passes(first or tests[0], kind):
                break
            outcome, tests = "unreached", sound.kept(tests, kind)
        if outcome != "unreached":
            break
    return {"outcome": outcome, "by": first, "tests": tried}


class Sound:
    """Tests that pass without a fault, here: what fails anyway tells nothing. Each is asked once."""

    def __init__(self, tree: Path) -> None:
        self.tree, self.known = tree, {}

    def passes(self, test: str, kind: str) -> bool:
        """Whether a test passes on the sound tree."""
        from mutants.runner import run_tests

        if (test, kind) not in self.known:
            outcome, _ = run_tests(self.tree, [test], compiler=kind == "compiled", seconds=300.0)
            self.known[test, kind] = outcome == "unnoticed"
            if outcome != "unnoticed":
                print(f"left out, fails without a fault: {test}", flush=True)
        return self.known[test, kind]

    def kept(self, tests: list[str], kind: str) -> list[str]:
        """Those not known to fail."""
        return [t for t in tests if self.known.get((t, kind), True)]


def results() -> list[dict]:
    """All results, the last of each fault."""
    path = WORK / "results.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return list({row["key"]: row for row in map(json.loads, lines)}.values())


def equivalent() -> dict[str, str]:
    """Faults that change nothing that could be told, with the reason, by key."""
    named = tomllib.loads((HERE / "equivalent.toml").read_text(encoding="utf-8")).get("fault", [])
    return {key_of(f["path"], f["function"], f["before"], f["after"]): f["why"] for f in named}


def table(seed: int | None) -> str:
    """Planted, noticed, unnoticed and equivalent, by room."""
    reasons = equivalent()
    rows: dict[str, list[int]] = {}
    for row in results():
        if seed is not None and row["seed"] != seed:
            continue
        kind = 2 if row["key"] in reasons else 0 if row["outcome"] in ("noticed", "slow") else 1
        loops = "all loops" if row["group"].endswith("loops") else "all plain"
        for name in (row["group"], loops, "all"):
            rows.setdefault(name, [0, 0, 0])[kind] += 1
    lines = [
        "| room | planted | noticed | unnoticed | equivalent | noticed of the others |",
        "|---|---|---|---|---|---|",
    ]
    for name in sorted(rows, key=lambda n: (n.startswith("all"), n)):
        yes, no, same = rows[name]
        share = f"{100.0 * yes / (yes + no):.0f} %" if yes + no else "–"
        lines.append(f"| {name} | {yes + no + same} | {yes} | {no} | {same} | {share} |")
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="mutants", description=__doc__)
    parser.add_argument("what", choices=["record", "run", "again", "table"])
    parser.add_argument("files", nargs="*")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rooms", type=lambda text: text.split(","), default=[])
    parser.add_argument("--loops", action="store_true", default=None)
    given = parser.parse_args()
    if given.what == "record":
        record(given.files)
    elif given.what == "run":
        run(given.count, given.seed, given.minutes, given.rooms, given.loops)
    elif given.what == "again":
        forget_unnoticed()
    if given.what != "record":
        print(table(None if given.what == "again" else given.seed))


def forget_unnoticed() -> None:
    """Take back the results of what went unnoticed, so that the next run tries it on the tests of today."""
    reasons = equivalent()
    kept = [r for r in results() if r["outcome"] in ("noticed", "slow") or r["key"] in reasons]
    (WORK / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")


if __name__ == "__main__":
    main()
