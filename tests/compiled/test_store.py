"""Compiled loops on disk: never stale, shared by copies, whole or absent, and no more compiled than must be."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")

INNER = '''
"""Called from another file."""
from rbfmuscle.compiled.loop import compiled
from constants import SHIFT

@compiled
def inner(x):
    """What it does."""
    return 2.0 * x + SHIFT

@compiled
def apart(x):
    return x - 1.0
'''
OUTER = """
import inner
from rbfmuscle.compiled.loop import compiled

@compiled
def outer(x):
    return inner.inner(x) + later(x)

@compiled
def later(x):
    return 100.0 * x
"""
MAIN = "import inner, outer; print(outer.outer(1.0), inner.apart(1.0))"


@pytest.fixture
def folder(tmp_path):
    """Three files with loops that call each other, and an empty cache beside them."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "constants.py").write_text("SHIFT = 0.5\n")
    (source / "inner.py").write_text(INNER)
    (source / "outer.py").write_text(OUTER)
    return source


def start(source, cache, code=MAIN):
    places = os.pathsep.join([str(source), str(ROOT)])
    environment = {
        **os.environ,
        "PYTHONPATH": places,
        "RBFMUSCLE_LOOPS": str(cache),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], env=environment, cwd=source.parent, **pipes)


def finish(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return [float(word) for word in out.split()], err


def run(source, cache, code=MAIN):
    return finish(start(source, cache, code))


def entries(cache):
    return {path.name for path in cache.glob("*.loop")}


def loops(names):
    return sorted(name.rsplit("-", 1)[0] for name in names)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_edit_in_a_called_loop_reaches_the_cached_caller(folder, tmp_path):
    cache = tmp_path / "cache"
    assert run(folder, cache)[0] == [102.5, 0.0]
    before = entries(cache)
    assert loops(before) == ["inner.apart", "inner.inner", "outer.later", "outer.outer"]
    # Same length, and the caller's file untouched.
    edit(folder / "inner.py", "2.0 * x", "3.0 * x")
    assert run(folder, cache)[0] == [103.5, 0.0]
    assert loops(entries(cache) - before) == ["inner.inner", "outer.outer"]


def test_edit_of_a_constant_in_a_third_file_reaches_the_caller(folder, tmp_path):
    run(folder, tmp_path / "cache")
    before = entries(tmp_path / "cache")
    (folder / "constants.py").write_text("SHIFT = 7.0\n")
    assert run(folder, tmp_path / "cache")[0] == [109.0, 0.0]
    assert loops(entries(tmp_path / "cache") - before) == ["inner.inner", "outer.outer"]


def test_loop_defined_after_its_caller_counts(folder, tmp_path):
    run(folder, tmp_path / "cache")
    edit(folder / "outer.py", "100.0", "200.0")
    assert run(folder, tmp_path / "cache")[0] == [202.5, 0.0]


def test_options_of_the_declaration_count(folder, tmp_path):
    run(folder, tmp_path / "cache")
    before = entries(tmp_path / "cache")
    edit(folder / "inner.py", "@compiled\ndef apart", "@compiled(fastmath={'contract'})\ndef apart")
    run(folder, tmp_path / "cache")
    assert loops(entries(tmp_path / "cache") - before) == ["inner.apart"]


def test_comments_lines_and_docstrings_compile_nothing(folder, tmp_path):
    run(folder, tmp_path / "cache")
    before = entries(tmp_path / "cache")
    edit(folder / "inner.py", '"""What it does."""', '"""Twice x, and the shift."""\n    # A remark.')
    edit(folder / "outer.py", "import inner\n", "\n\nimport inner\n")
    assert run(folder, tmp_path / "cache")[0] == [102.5, 0.0]
    assert entries(tmp_path / "cache") == before


def test_copy_of_the_sources_compiles_nothing(folder, tmp_path):
    run(folder, tmp_path / "cache")
    before = entries(tmp_path / "cache")
    copy = tmp_path / "elsewhere" / "copy"
    copy.mkdir(parents=True)
    for path in folder.glob("*.py"):
        (copy / path.name).write_text(path.read_text())
    (tmp_path / "cache").rename(tmp_path / "moved")
    assert run(copy, tmp_path / "moved")[0] == [102.5, 0.0]
    assert entries(tmp_path / "moved") == before


@pytest.mark.parametrize("damage", [b"", b"no such thing", None])
def test_damaged_entry_is_compiled_again(folder, tmp_path, damage):
    cache = tmp_path / "cache"
    run(folder, cache)
    before = entries(cache)
    for path in cache.glob("*.loop"):
        path.write_bytes(path.read_bytes()[:-100] if damage is None else damage)
    values, err = run(folder, cache)
    assert values == [102.5, 0.0]
    assert "damaged" in err
    assert entries(cache) == before
    assert run(folder, cache) == ([102.5, 0.0], "")


def test_folder_that_cannot_be_made_gives_one_line_and_another_folder(folder, tmp_path, monkeypatch):
    spare = tmp_path / "tmp"
    spare.mkdir()
    monkeypatch.setenv("TMPDIR", str(spare))
    (tmp_path / "file").write_text("not a folder")
    values, err = run(folder, tmp_path / "file" / "cache")
    assert values == [102.5, 0.0]
    assert len(err.splitlines()) == 1
    assert str(spare) in err
    assert len(list(spare.rglob("*.loop"))) == 4


def test_nothing_is_executed_from_a_folder_that_others_may_write_to(folder, tmp_path, monkeypatch):
    if not hasattr(os, "getuid"):
        pytest.skip("no users here")
    spare = tmp_path / "tmp"
    open_to_all = spare / f"rbfmuscle-loops-{os.getuid()}"
    open_to_all.mkdir(parents=True)
    open_to_all.chmod(0o777)
    monkeypatch.setenv("TMPDIR", str(spare))
    (tmp_path / "file").write_text("not a folder")
    values, err = run(folder, tmp_path / "file" / "cache")
    assert values == [102.5, 0.0]
    assert "none are kept" in err
    assert list(open_to_all.iterdir()) == []


def test_two_cold_processes_at_once_are_both_right_and_compile_each_loop_once(folder, tmp_path):
    cache = tmp_path / "cache"
    count = f"""
from numba.core import event
class Count(event.Listener):
    n = 0
    def on_start(self, e): Count.n += e.data['dispatcher'].py_func.__module__ in ('inner', 'outer')
    def on_end(self, e): pass
event.register('numba:compile', Count())
{MAIN}
print(Count.n)
"""
    both = [start(folder, cache, count), start(folder, cache, count)]
    (first, _), (second, _) = (finish(process) for process in both)
    assert first[:2] == second[:2] == [102.5, 0.0]
    assert first[2] + second[2] == 4
    assert len(entries(cache)) == 4
    assert {path.suffix for path in cache.iterdir()} == {".loop", ""}


def test_old_entries_are_removed_in_time(folder, tmp_path):
    cache = tmp_path / "cache"
    run(folder, cache)
    kept, *old = sorted(cache.glob("*.loop"))
    for path in old:
        os.utime(path, (1e9, 1e9))
    os.utime(cache / "swept", (1e9, 1e9))
    (cache / "half.part").write_bytes(b"half")
    os.utime(cache / "half.part", (1e9, 1e9))
    run(folder, cache, "from rbfmuscle.compiled.store import folders; folders()")
    assert list(cache.glob("*.loop")) == [kept]
    assert not (cache / "half.part").exists()


def test_a_loop_that_cannot_be_compiled_leaves_no_lock_behind():
    """The same process would otherwise wait for itself."""
    from numba.core.errors import NumbaError

    from rbfmuscle.compiled.loop import compiled

    @compiled
    def _wrong_loop(x):
        return x.nothing_of_that_name

    with pytest.raises(NumbaError):
        _wrong_loop(np.zeros(3))
    assert not _wrong_loop._cache.held
