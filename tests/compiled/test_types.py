"""Types of arguments as text, and back."""

import json
import os
import time
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core import types

from rbfmuscle.compiled import store
from rbfmuscle.compiled.types import read_type, spell_type
from rbfmuscle.compiled.watch import _watchers, current_stage, tell_stage
from rbfmuscle.sim.distance.query import FieldData


class Even(NamedTuple):
    """All of one type."""

    a: float
    b: float


class Mixed(NamedTuple):
    """Of several."""

    a: float
    b: np.ndarray
    c: bool


def frozen():
    array = np.zeros((2, 3), dtype=np.float32)
    array.flags.writeable = False
    return array


VALUES = {
    "matrix": np.zeros((2, 3)), "turned": np.zeros((2, 3)).T, "cut": np.zeros((4, 4))[::2, ::2], "frozen": frozen(),
    "masks": np.zeros(3, dtype=bool), "short": np.zeros(3, dtype=np.int32), "real": 1.0, "whole": 3, "yes": True,
    "none": None, "pair": (1.0, np.zeros(2)), "even": Even(1.0, 2.0), "mixed": Mixed(1.0, np.zeros(2), True),
    "nested": (Even(1.0, 2.0), (True, 2)),
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_type_comes_back_through_a_file(name):
    kind = numba.typeof(VALUES[name])
    spelled = json.loads(json.dumps(spell_type(kind)))
    assert read_type(spelled) == kind
    if isinstance(kind, types.BaseNamedTuple):
        assert type(read_type(spelled)) is type(kind)


def test_type_of_a_field_comes_back():
    kind = types.NamedTuple([types.float64[:] for _ in FieldData._fields], FieldData)
    even = types.NamedUniTuple(types.float64[:], len(FieldData._fields), FieldData)
    assert read_type(spell_type(even)) == even and type(read_type(spell_type(kind))) is types.NamedUniTuple


def test_omitted_arguments_keep_their_value():
    for value in (3, 0.5, True, None):
        assert read_type(json.loads(json.dumps(spell_type(types.Omitted(value))))).value == value


def test_what_has_no_spelling_is_refused():
    with pytest.raises(ValueError, match="cannot be foretold"):
        spell_type(types.unicode_type)


def test_watchers_are_told_of_stages_in_turn_and_only_what_they_listen_to():
    class Stages:
        def __init__(self):
            self.told = []

        def stage(self, stage):
            self.told.append(stage.text if stage else None)

    watcher, deaf = Stages(), object()
    _watchers.extend([deaf, watcher])
    try:
        with tell_stage("outer"), tell_stage("inner") as inner:
            assert current_stage() is inner
    finally:
        _watchers.remove(watcher), _watchers.remove(deaf)
    assert watcher.told == ["outer", "inner", "outer", None]


@pytest.fixture
def loops(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "folders", lambda: (tmp_path,))
    return tmp_path


def test_sweeping_removes_what_is_old_or_beyond_the_size_once_a_day(loops, monkeypatch):
    monkeypatch.setattr(store, "KEEP_BYTES", 250)
    now, day = time.time(), 86400.0
    ages = {
        "new.loop": 1,
        "used.loop": 2,
        "beyond.loop": 3,
        "old.loop": 70,
        "left.part": 2,
        "going.part": 0,
        "held.lock": 2,
    }
    for name, age in ages.items():
        (loops / name).write_bytes(b"x" * 100)
        os.utime(loops / name, (now - age * day, now - age * day))
    store._sweep(loops)
    assert {path.name for path in loops.iterdir()} == {"new.loop", "used.loop", "going.part", "swept"}
    (loops / "late.part").write_bytes(b"x")
    os.utime(loops / "late.part", (now - 2 * day, now - 2 * day))
    store._sweep(loops)  # not again on the same day
    assert (loops / "late.part").exists()
    os.utime(loops / "swept", (now - 2 * day, now - 2 * day))
    store._sweep(loops)
    assert not (loops / "late.part").exists()
