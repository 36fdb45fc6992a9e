"""Compiling ahead: what tasks need, in several processes, each loop once; and what is said meanwhile."""

import json
import os
import re
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
from numba.core import types

from rbfmuscle.compiled import needs, progress, store, watch
from rbfmuscle.compiled.loop import compiled
from rbfmuscle.compiled.progress import Progress
from rbfmuscle.compiled.types import read_type, spell_type
from rbfmuscle.compiled.warm import compile_ahead, warm_up
from rbfmuscle.compiled.watch import compiled_so_far, tell_stage, watched_by
from rbfmuscle.sim.distance.query import FieldData
from rbfmuscle.validation import UsageError

with_jit = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")


def array_of(kind, ndim, layout="C", **flags):
    return types.Array(kind, ndim, layout, **flags)


FIELD = FieldData(
    *[np.zeros((1,) * n, dtype) for n, dtype in zip((1, 3, 2, 1), "fiif")] * 2, *[np.zeros(1)] * 3
)


@pytest.mark.parametrize(
    "kind",
    [
        types.int64, types.float32, types.boolean, types.none, types.Omitted(3), types.Omitted(None),
        array_of(types.float64, 2), array_of(types.uint8, 1, "A"), array_of(types.boolean, 3),
        array_of(types.int32, 2, "F", readonly=True), array_of(types.float64, 1, aligned=False),
        types.UniTuple(types.int64, 2), types.Tuple((array_of(types.float64, 1), types.int32)), numba.typeof(FIELD),
    ],
    ids=str,
)  # fmt: skip
def test_types_come_back_from_their_spelling(kind):
    text = json.loads(json.dumps(spell_type(kind)))
    assert read_type(text) == kind


def test_type_without_a_spelling_is_refused():
    with pytest.raises(ValueError, match="foretold"):
        spell_type(types.unicode_type)


@with_jit
def test_the_table_is_not_far_behind_the_code():
    rows = needs._rows()
    tasks = set(needs.task_names())
    assert {"rbf", "pbd", "kernels", "check", "plan"} <= tasks
    found = needs.loops_needed(tasks)
    gone = {row["loop"] for row in rows} - {need.name for need in found}
    # A row behind costs time alone, so that a rename need not wait for the table; many rows say that it is time.
    assert len(found) >= 0.85 * len(rows), f"gone: {sorted(gone)}; python benchmarks/loops.py --record"


@with_jit
def test_an_entry_says_which_loop_it_is():
    for need in needs.loops_needed(["check"]):
        module, function = need.name.split(":")
        assert need.entry.startswith(f"{module.split('.')[-1]}.{function}-")


@with_jit
def test_a_task_needs_only_its_own():
    names = {need.name for need in needs.loops_needed(["check"])}
    assert names
    assert not any(name.startswith(("pbd_baseline", "rbfmuscle.model")) for name in names)
    assert needs.loops_needed(["no such task"]) == []


@with_jit
def test_rows_that_no_longer_fit_are_left_out(monkeypatch):
    good = needs._rows()[0]
    bad = [
        {**good, "loop": "rbfmuscle.nowhere:f"},
        {**good, "loop": good["loop"] + "x"},
        {**good, "types": ["what 1C"]},
    ]
    monkeypatch.setattr(needs, "_rows", lambda: [good, *bad])
    assert [need.name for need in needs.loops_needed(good["tasks"])] == [good["loop"]]


@with_jit
def test_row_of_other_types_is_tried_once(monkeypatch, tmp_path):
    monkeypatch.setattr(store, "folders", lambda: (tmp_path,))
    good = needs._rows()[0]
    monkeypatch.setattr(needs, "_rows", lambda: [{**good, "types": ["none"], "tasks": ["one"]}])
    assert compile_ahead(["one"], jobs=1) == 1
    assert compile_ahead(["one"], jobs=1) == 0


def test_unknown_task_is_told():
    with pytest.raises(UsageError, match="unknown task 'rbff'"):
        warm_up("rbff")


CODE = """
import json, sys
from numba.core import event
class Count(event.Listener):
    n = 0
    def on_start(self, e): Count.n += e.data['dispatcher'].py_func.__module__.startswith('rbfmuscle')
    def on_end(self, e): pass
event.register('numba:compile', Count())
from rbfmuscle.compiled.warm import compile_ahead
told = []
missing = compile_ahead(['plan'], progress=lambda done, total: told.append((done, total)))
print(json.dumps([missing, told[-1:], Count.n]))
"""


def start(cache):
    environment = {**os.environ, "RBFMUSCLE_LOOPS": str(cache)}
    return subprocess.Popen([sys.executable, "-c", CODE], env=environment, stdout=subprocess.PIPE, text=True)


def finish(process):
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0
    return json.loads(out)


@with_jit
def test_two_cold_processes_share_the_work_and_a_third_has_none(tmp_path):
    both = [start(tmp_path), start(tmp_path)]
    (first, told, own), (second, also, other) = (finish(process) for process in both)
    wanted = len(needs.loops_needed(["plan"]))
    assert wanted <= first + second <= 2 * wanted
    assert told == [[first, first]] * (first > 0) and also == [[second, second]] * (second > 0)
    entries = len(list(tmp_path.glob("*.loop")))
    assert wanted <= entries
    # Helpers did the rest; nobody did anything twice.
    assert own + other <= entries
    assert not list(tmp_path.glob("*.part"))
    assert finish(start(tmp_path)) == [0, [], 0]


@with_jit
def test_nothing_is_missing_the_second_time(monkeypatch):
    compile_ahead(["check"], jobs=1)
    assert compile_ahead(["check"], jobs=1) == 0


@with_jit
def test_numbers_written_out_in_a_call_make_no_version_of_their_own():
    @compiled
    def inner(x, k):
        return x * k

    @compiled
    def outer(x):
        return inner(x, 2) + inner(x, 3)

    inner._cache.disable()
    outer._cache.disable()
    assert outer(1.0) == 5.0
    assert len(inner.overloads) == 1


@with_jit
def test_watchers_and_totals_hear_of_compiling():
    heard = []

    class Watcher:
        def needed(self, loop, arguments):
            heard.append(("needed", loop.py_func.__name__))

        def begins(self, loop):
            assert watch.loop_in_work() is not None

        def ends(self, loop, seconds):
            heard.append(("ends", loop.py_func.__name__, seconds >= 0.0))

    @compiled
    def inside(x):
        return x - 0.125

    @compiled
    def alone(x):
        return inside(x)

    for loop in (inside, alone):
        loop._cache.disable()
    before = compiled_so_far()
    with watched_by(Watcher()):
        alone(1.0)
    alone(2)
    assert heard == [("needed", "alone"), ("ends", "inside", True), ("ends", "alone", True)]
    assert compiled_so_far()["loops"] - before["loops"] >= 2
    assert watch.loop_in_work() is None


@pytest.fixture
def said(monkeypatch, capsys):
    """What is written to stderr, a line every fifth of a second."""

    class Said:
        text = ""

        def getvalue(self):
            self.text += capsys.readouterr().err
            return self.text

    monkeypatch.setattr(progress, "FIRST", 0.2)
    monkeypatch.setattr(progress, "EVERY", 0.2)
    return Said()


def wait_for(stream, pattern):
    end = time.monotonic() + 60.0
    while not re.search(pattern, stream.getvalue()):
        assert time.monotonic() < end, stream.getvalue()
        time.sleep(0.02)


def test_stages_and_counts_are_said_while_they_last(said):
    with Progress("hip") as shown:
        wait_for(said, r"hip: starting \(\d+ s\)\n")
        with tell_stage("compiling, once for this machine", "loop", 58) as advance:
            advance(12)
            wait_for(said, r"hip: compiling, once for this machine: loop 12 of 58 ")
        with tell_stage("building"):
            wait_for(said, "hip: building ")
        shown(3, 46)
        wait_for(said, "hip: frame 3 of 46 ")
        with Progress("inside", what="fit") as other:
            other(1, 2)
            wait_for(said, "fit 1 of 2")
        shown(46, 46)
    assert said.getvalue().splitlines()[-1] == "hip: frame 46 of 46"
    assert not [t for t in threading.enumerate() if t.name == "rbfmuscle-progress"]


def test_what_is_quick_says_nothing(said):
    with Progress("check"):
        pass
    assert said.getvalue() == ""


def test_what_fails_does_not_claim_to_be_done(said):
    with pytest.raises(KeyError), Progress("hip") as shown:
        shown(3, 3)
        raise KeyError
    assert said.getvalue() == ""
