"""Compiled loops on disk: loaded by a second process, never stale, whole or absent, and removed
when unused.
"""

import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from conftest import ROOT
from numba.core.runtime import _nrt_python, rtsys

from rbfmuscle.jit import compiled

# Slow: some forty processes, each of which compiles.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled"),
]
SOURCES = {
    "__init__": "",
    "constants": "SHIFT = 0.5\n",
    "fields": "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    a: float\n    "
    "b: float\n",
    "inner": """
from rbfmuscle.jit import compiled
from loops.constants import SHIFT

@compiled(inline="always")
def inner(x):
    return 2.0 * x + SHIFT

@compiled
def difference(pair):
    return pair.a - pair.b
""",
    "outer": """
from rbfmuscle.jit import compiled
from loops import inner as other
from loops import later

@compiled
def outer(x):
    return other.inner(x) + later.later(x)
""",
    "later": """
from rbfmuscle.jit import compiled

@compiled
def later(x):
    return 100.0 * x
""",
}
MAIN = """
from loops import fields, inner, outer
print(outer.outer(1.0), inner.difference(fields.Pair(a=3.0, b=2.0)))
"""
SAID = (
    "rbfmuscle: compiling loops for this processor, once; a first run takes a minute or two "
    "longer\n"
)


@pytest.fixture
def place(tmp_path):
    """A package whose loops call each other across files, and the name of a folder that is not
    there yet.
    """
    (tmp_path / "loops").mkdir()
    for name, text in SOURCES.items():
        (tmp_path / "loops" / f"{name}.py").write_text(text)
    return tmp_path


def start(place, cache="cache", main=MAIN, **settings):
    paths = os.pathsep.join([str(place), str(ROOT)])
    # Python takes sources of one size that change within a second for the same.
    own = {"PYTHONPATH": paths, "RBFMUSCLE_LOOPS": str(place / cache)}
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **own, **settings}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", main], env=env, cwd=place, **pipes)


def finish(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return [float(word) for word in out.split()], err


def run(place, **settings):
    return finish(start(place, **settings))


def files(place):
    return {path: path.stat().st_mtime_ns for path in (place / "cache").glob("*/*")}


def test_second_process_and_a_copy_of_the_sources_compile_nothing(place):
    assert run(place) == ([102.5, 1.0], SAID)
    kept = files(place)
    assert len(kept) == 3  # the inlined loop has no code of its own
    (place / "copy").mkdir()
    (place / "loops").rename(place / "copy" / "loops")
    assert run(place, PYTHONPATH=os.pathsep.join([str(place / "copy"), str(ROOT)])) == (
        [102.5, 1.0],
        "",
    )
    assert files(place) == kept


def test_loading_needs_nothing_that_numba_compiles_by(place):
    run(place)
    kept = files(place)
    main = MAIN + "import sys; print(float('numba.np.npyimpl' in sys.modules))"
    assert run(place, main=main) == ([102.5, 1.0, 0.0], "")
    assert files(place) == kept


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        ("inner", "2.0 * x", "3.0 * x", [103.5, 1.0]),
        ("constants", "0.5", "7.0", [109.0, 1.0]),
        ("later", "100.0", "200.0", [202.5, 1.0]),
        # Compiled anew, with a loop that is loaded.
        ("outer", "+ later", "- later", [-97.5, 1.0]),
        # The module of the loop does not import this class.
        ("fields", "    a: float\n    b: float", "    b: float\n    a: float", [102.5, 1.0]),
    ],
)
def test_edit_of_what_a_loop_uses_reaches_it(place, name, old, new, expected):
    run(place)
    assert old in SOURCES[name]
    (place / "loops" / f"{name}.py").write_text(SOURCES[name].replace(old, new))
    assert run(place)[0] == expected


@pytest.mark.parametrize("damage", [b"no such thing", None])
def test_damaged_file_is_compiled_again(place, damage):
    run(place)
    for path in files(place):
        path.write_bytes(path.read_bytes()[:-100] if damage is None else damage)
    assert run(place) == ([102.5, 1.0], SAID)
    assert run(place) == ([102.5, 1.0], "")


def test_folder_that_cannot_be_written_costs_one_line(place):
    (place / "file").write_text("not a folder")
    values, err = run(place, cache="file/cache")
    assert values == [102.5, 1.0]
    assert len(err.splitlines()) == 2
    assert f"cannot keep compiled loops in {place / 'file' / 'cache'} (" in err


def test_processes_that_compile_at_once_are_right(place):
    both = [start(place), start(place)]
    assert [finish(process)[0] for process in both] == 2 * [[102.5, 1.0]]
    assert run(place) == ([102.5, 1.0], "")


def test_folders_that_are_unused_are_removed(place):
    run(place)
    used = {path.parent for path in files(place)}
    names = {"loops.old-" + 24 * "0": 61, "loops.new-" + 24 * "1": 59, "foreign": 999}
    ages = {place / "cache" / name: days for name, days in names.items()} | dict.fromkeys(used, 2)
    for path, days in ages.items():
        path.mkdir(exist_ok=True)
        then = path.stat().st_mtime - days * 86400.0
        os.utime(path, (then, then))
    before = {path: path.stat().st_mtime for path in used}
    run(place)
    left = {path.name for path in (place / "cache").iterdir()}
    assert left == {path.name for path in used} | {"loops.new-" + 24 * "1", "foreign"}
    # Loops that only others call are in the code of these.
    called = [path for path in used if not path.name.startswith("loops.later")]
    assert all(path.stat().st_mtime > before[path] + 86400.0 for path in called)


def test_code_of_a_large_loop_is_not_copied_into_its_callers(place):
    """The caller is loaded with it, and compiled again where it is gone or another."""
    large = 60 * "    x = 0.5 * x + 50.0 * SHIFT\n"  # each halves the distance to 100 SHIFT
    text = SOURCES["later"] + "\nSHIFT = 1.0\n\n@compiled\ndef far(x):\n" + large + "    return x\n"
    (place / "loops" / "later.py").write_text(text)
    outer = SOURCES["outer"].replace("later.later(x)", "later.far(x)")
    (place / "loops" / "outer.py").write_text(outer)
    assert run(place) == ([102.5, 1.0], SAID)
    kept = files(place)
    (apart,) = [path for path in kept if path.name.startswith("far-")]
    (caller,) = [path for path in kept if path.name.startswith("outer-")]
    symbol = b"5later3far"
    assert caller.read_bytes().count(symbol) > 0
    assert run(place) == ([102.5, 1.0], "")
    apart.unlink()
    assert run(place) == ([102.5, 1.0], SAID)
    assert run(place) == ([102.5, 1.0], "")
    (place / "loops" / "later.py").write_text(text.replace("SHIFT = 1.0", "SHIFT = 2.0"))
    assert run(place)[0] == [202.5, 1.0]


def test_references_are_counted_where_arrays_are_made_or_handed_out():
    @compiled
    def handed(pair):
        return pair[0]

    @compiled
    def filled(x, out):
        for i in range(len(x)):
            out[i] = 2.0 * x[i]

    @compiled
    def summed(x):
        total = 0.0
        for _ in range(1000):
            out = np.empty(len(x))
            filled(x, out)
            last = handed((out, x))
            out = x
            other = np.full(len(x), -1.0)  # in the place of what was handed out, were that freed
            total += last[1] + other[1]
        return total

    @compiled
    def caller(x):
        made = np.ones(3)
        return summed(x), handed((made, x)), handed((x, made))

    x = np.arange(5.0)
    count = sys.getrefcount(x)
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    total, made, same = caller(x)
    assert total == 1000.0
    assert np.shares_memory(same, x)
    again = [np.full(3, -1.0) for _ in range(9)]
    assert (made == 1.0).all() and len(again) == 9
    del made, same
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert sys.getrefcount(x) == count
    assert after.alloc - before.alloc == after.free - before.free >= 2000


def test_nothing_is_compiled_where_numba_is_switched_off(place):
    assert run(place, NUMBA_DISABLE_JIT="1") == ([102.5, 1.0], "")
    assert not (place / "cache").exists()


def test_a_loop_is_compiled_once_for_all_constants_that_it_is_called_with():
    @compiled
    def chosen(x, flag, factor):
        return x + 1.0 if flag else factor * x

    @compiled
    def caller(x, flag):
        return chosen(x, True, 0) + chosen(x, False, 2) + chosen(x, flag, factor=3)

    assert caller(2.0, False) == 3.0 + 4.0 + 6.0
    types = (numba.float64, numba.boolean, numba.int64)
    chosen.get_call_template(types, {})  # which knows the one form that there is
    assert len(chosen.get_call_template(types, {})[0].cases) == 1
