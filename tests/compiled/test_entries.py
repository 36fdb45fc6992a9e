"""Entries on disk, digests of loops, and what watchers are told: in this process, with nothing compiled."""

import gc
import io
import os
import runpy
import stat
import time
import types as pytypes
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from rbfmuscle.compiled import progress, store, watch
from rbfmuscle.compiled.dispatch import _NoCollection
from rbfmuscle.compiled.fingerprint import loop_digest
from rbfmuscle.compiled.watch import (
    compiled_so_far,
    current_stage,
    tell_begin,
    tell_end,
    tell_needed,
    tell_stage,
)

DAY = 86400.0


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Two folders of entries: the first is written to, both are read."""
    found = (tmp_path / "first", tmp_path / "second")
    for path in found:
        path.mkdir()
    monkeypatch.setattr(store, "folders", lambda: found)
    return found


def age(path, days):
    then = time.time() - days * DAY
    os.utime(path, (then, then))


def test_nothing_is_compiled_before_the_first_loop():
    fresh = runpy.run_path(watch.__file__)
    assert fresh["compiled_so_far"]() == {"loops": 0, "seconds": 0.0}


class TestEntries:
    def test_what_is_written_is_read_and_lies_in_the_first_folder_alone(self, places):
        store.write_entry("a", b"loop")
        assert store.read_entry("a") == b"loop"
        assert store.has_entry("a") and not store.has_entry("b")
        assert store.read_entry("b") is None
        assert [path.name for path in places[0].iterdir()] == ["a.loop"]
        assert not list(places[1].iterdir())

    def test_the_first_folder_is_enough_to_write(self, places, caplog):
        places[1].rmdir()
        store.write_entry("a", b"loop")
        assert store.read_entry("a") == b"loop" and not caplog.records

    def test_second_folder_is_read_where_the_first_has_none(self, places):
        store.write_entry("a", b"of the first")
        (places[0] / "a.loop").rename(places[1] / "a.loop")
        assert store.has_entry("a")
        assert store.read_entry("a") == b"of the first"

    @pytest.mark.parametrize("place", [0, 31, 32, -1])
    def test_a_changed_byte_anywhere_takes_the_entry_away(self, places, place):
        store.write_entry("a", b"loop")
        data = bytearray((places[0] / "a.loop").read_bytes())
        data[place] ^= 1
        (places[0] / "a.loop").write_bytes(data)
        assert store.read_entry("a") is None
        assert not (places[0] / "a.loop").exists()

    def test_reading_renews_what_is_older_than_a_day(self, places):
        for name, days in (("old", 3.0), ("young", 0.5)):
            store.write_entry(name, b"loop")
            age(places[0] / f"{name}.loop", days)
        before = (places[0] / "young.loop").stat().st_mtime
        assert store.read_entry("old") == store.read_entry("young") == b"loop"
        assert time.time() - (places[0] / "old.loop").stat().st_mtime < DAY
        assert (places[0] / "young.loop").stat().st_mtime == before

    def test_clearing_counts_entries_and_all_bytes(self, places):
        store.write_entry("a", b"1234")
        store.write_entry("b", b"12")
        store.write_entry("c", b"")
        (places[0] / "c.loop").rename(places[1] / "c.loop")
        (places[0] / "half.part").write_bytes(b"12345")
        (places[1] / "d.lock").write_bytes(b"")
        (places[0] / "swept").write_bytes(b"")
        assert store.clear_entries() == (3, 3 * 32 + 6 + 5)
        assert [path.name for place in places for path in place.iterdir()] == ["swept"]

    def test_where_nothing_can_be_kept_all_goes_on(self, monkeypatch):
        monkeypatch.setattr(store, "folders", tuple)
        store.write_entry("a", b"loop")
        assert store.read_entry("a") is None and not store.has_entry("a")
        lock = store.EntryLock("a")
        assert lock.try_acquire()
        lock.release()
        assert store.clear_entries() == (0, 0)

    def test_one_holds_a_lock_and_leaves_no_file(self, places):
        first, second = store.EntryLock("a"), store.EntryLock("a")
        assert first.try_acquire() and not second.try_acquire()
        other = store.EntryLock("b")
        assert other.try_acquire()
        other.release()
        assert (places[0] / f"a{store.LOCK}").exists()
        first.release()
        assert not (places[0] / f"a{store.LOCK}").exists()
        assert second.try_acquire()
        second.release()
        second.release()


class TestFolders:
    @pytest.fixture(autouse=True)
    def anew(self):
        store.folders.cache_clear()
        yield
        store.folders.cache_clear()

    def test_wanted_one_is_made_with_those_above_it(self, tmp_path, monkeypatch):
        wanted = tmp_path / "above" / "loops"
        monkeypatch.setenv("RBFMUSCLE_LOOPS", str(wanted))
        assert store.folders() == (wanted,)
        assert wanted.is_dir()
        store.folders.cache_clear()
        assert store.folders() == (wanted,)

    def test_another_is_this_users_alone_and_is_told_once(self, tmp_path, monkeypatch, caplog):
        (tmp_path / "file").write_text("no folder")
        wanted = tmp_path / "file" / "loops"
        monkeypatch.setenv("RBFMUSCLE_LOOPS", str(wanted))
        monkeypatch.setattr(store.tempfile, "gettempdir", lambda: str(tmp_path))
        spare, *rest = store.folders()
        assert rest == [wanted]
        assert spare.parent == tmp_path and spare.name.startswith("rbfmuscle-loops-")
        assert stat.S_IMODE(spare.stat().st_mode) == 0o700
        assert len(caplog.records) == 1
        assert str(wanted) in caplog.text and f"{spare} is used" in caplog.text

    def test_sweep_keeps_what_is_used_and_the_newest_that_fit(self, tmp_path, monkeypatch):
        monkeypatch.setattr(store, "KEEP_BYTES", 250)
        for name, days, size in (("a", 1.0, 100), ("b", 2.0, 100), ("c", 3.0, 100), ("d", 400.0, 1)):
            (tmp_path / f"{name}.loop").write_bytes(b"x" * size)
            age(tmp_path / f"{name}.loop", days)
        for name, days in (("old.part", 2.0), ("new.part", 0.1), ("old.lock", 2.0), ("other.txt", 999.0)):
            (tmp_path / name).write_bytes(b"")
            age(tmp_path / name, days)
        (tmp_path / f"held{store.LOCK}").write_bytes(b"")
        store._sweep(tmp_path)
        left = {path.name for path in tmp_path.iterdir()}
        assert {"a.loop", "b.loop", "new.part", "other.txt", "swept"} <= left
        assert not {"c.loop", "d.loop", "old.part"} & left
        # Once a day.
        (tmp_path / "e.loop").write_bytes(b"")
        age(tmp_path / "e.loop", 999.0)
        store._sweep(tmp_path)
        assert (tmp_path / "e.loop").exists()
        age(tmp_path / "swept", 1.1)
        store._sweep(tmp_path)
        assert not (tmp_path / "e.loop").exists()


def test_garbage_is_held_back_until_the_last_is_out():
    held = _NoCollection()
    assert gc.isenabled()
    with held:
        assert not gc.isenabled()
        with held:
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with held:
            pass
        assert not gc.isenabled()  # it was off before
    finally:
        gc.enable()


class TestWatch:
    def loop(self, name, module="rbfmuscle.x"):
        return SimpleNamespace(py_func=SimpleNamespace(__qualname__=name, __module__=module))

    def test_totals_count_ours_and_time_the_outermost_once(self, monkeypatch):
        clock = iter([10.0, 11.0, 13.0, 17.0, 20.0, 21.0])
        monkeypatch.setattr(watch.time, "thread_time", lambda: next(clock))
        before, (outer, inner) = compiled_so_far(), (self.loop("outer"), self.loop("inner"))
        tell_begin(outer)
        tell_begin(inner)
        assert watch.loop_in_work() == "outer"
        tell_end(inner)
        tell_end(outer)
        tell_begin(self.loop("numbas", "numba.np"))
        tell_end(self.loop("numbas", "numba.np"))
        now = compiled_so_far()
        assert now["loops"] - before["loops"] == 2
        assert now["seconds"] - before["seconds"] == pytest.approx(7.0 + 1.0)
        assert watch.loop_in_work() is None

    def test_needs_of_a_loop_within_another_are_not_told(self):
        heard = []
        with watch.watched_by(SimpleNamespace(needed=lambda loop, _: heard.append(loop))) as watcher:
            assert callable(watcher.needed)
            tell_needed("first", ())
            tell_begin(self.loop("outer"))
            tell_needed("within", ())
            tell_end(self.loop("outer"))
            tell_needed("last", ())
        tell_needed("unheard", ())
        assert heard == ["first", "last"]

    def test_stages_lie_within_each_other(self):
        heard = []
        with watch.watched_by(SimpleNamespace(stage=heard.append)):
            with tell_stage("outer", "frame", 5) as outer:
                with tell_stage("inner") as inner:
                    assert current_stage() is inner
                    inner(1, 4)
                    inner(2)
                outer(3)
            assert current_stage() is None
        assert heard == [outer, inner, inner, inner, outer, outer, None]
        assert (inner.done, inner.total, outer.done, outer.total) == (2, 4, 3, 5)


class TestProgress:
    def test_words_of_a_stage(self, monkeypatch):
        stage = tell_stage("building", "field", 4)
        stage.done = 3
        assert progress.describe_stage(stage) == "building: field 3 of 4"
        assert progress.describe_stage(tell_stage("")) == "starting"
        monkeypatch.setattr(progress, "loop_in_work", lambda: "f")
        assert progress.describe_stage(stage) == "building, compiling f: field 3 of 4"
        assert progress.describe_stage(tell_stage("")) == "compiling f"
        assert progress.describe_stage(tell_stage("compiling, once")) == "compiling, once"

    @pytest.mark.parametrize(
        "done, total, said, failed, last",
        [
            (3, 3, 0, False, True),
            (2, 3, 0, False, False),
            (2, 3, 1, False, True),
            (3, 3, 1, True, False),
            (0, 0, 1, False, False),
        ],
    )
    def test_last_line_is_for_what_ended_well_and_was_begun(
        self, capsys, monkeypatch, done, total, said, failed, last
    ):
        monkeypatch.setattr(progress, "FIRST", 60.0)
        lines = progress._Lines()
        lines.start("hip")
        lines.said = said
        stage = tell_stage("", "frame", total)
        stage.done = done
        lines.stop(stage, failed=failed)
        assert capsys.readouterr().err == (f"hip: frame {done} of {total}\n" if last else "")
        assert not lines.thread.is_alive()

    def test_only_the_outermost_is_shown_and_a_failure_reaches_it(self, monkeypatch):
        calls = []

        class Shown:
            def start(self, title):
                calls.append(("start", title))

            def stop(self, stage, *, failed):
                calls.append(("stop", stage.done, failed))

        monkeypatch.setattr(progress, "_Lines", Shown)
        monkeypatch.setattr("sys.stderr", io.StringIO())
        with progress.Progress("outer") as outer, progress.Progress("inner") as inner:
            outer(1, 2)
            inner(5, 6)
        with pytest.raises(ValueError), progress.Progress("bad"):
            raise ValueError
        assert calls == [("start", "outer"), ("stop", 1, False), ("start", "bad"), ("stop", 0, True)]


class TestDigest:
    """Two loops have one digest if and only if compiled code of one serves for the other."""

    def digest(self, source, **globals_):
        space = {"numba": numba, "np": np, **globals_}
        exec("def f(x):\n    " + source, space)
        space["f"].__module__ = "somewhere"
        return loop_digest(numba.njit(space["f"]))

    def test_docstrings_do_not_count_and_constants_do(self):
        plain = self.digest("return x + 1.0")
        assert self.digest("return x + 1.0") == plain
        assert self.digest("'''Words.'''\n    return x + 1.0") == self.digest(
            "'''Others.'''\n    return x + 1.0"
        )
        assert self.digest("return x + 2.0") != plain
        assert self.digest("return x - 1.0") != plain

    def test_globals_count_where_they_are_read(self):
        assert self.digest("return x + K", K=1.0) != self.digest("return x + K", K=2.0)
        assert self.digest("return x + K", K=1.0, L=1) == self.digest("return x + K", K=1.0, L=2)
        assert self.digest("return x + K", K=1) != self.digest("return x + K", K=1.0)
        one, other = np.arange(3.0), np.array([0.0, 1.0, 2.5])
        assert self.digest("return x + K[0]", K=one) == self.digest("return x + K[0]", K=one.copy())
        assert self.digest("return x + K[0]", K=one) != self.digest("return x + K[0]", K=other)
        assert self.digest("return x + K[0]", K=(1, 2)) != self.digest("return x + K[0]", K=(1, 3))

    def test_constants_and_loops_of_a_module_count_where_they_are_read(self):
        def module(**members):
            found = pytypes.ModuleType("table")
            vars(found).update(members)
            return found

        wanted = self.digest("return x + table.K", table=module(K=1.0, L=5))
        assert self.digest("return x + table.K", table=module(K=1.0, L=6)) == wanted
        assert self.digest("return x + table.K", table=module(K=2.0, L=5)) != wanted

        def inner(source):
            space = {}
            exec("def g(x):\n    " + source, space)
            space["g"].__module__ = "elsewhere"
            return numba.njit(space["g"])

        one, same, other = (
            self.digest("return t.g(x)", t=module(g=inner(s))) for s in ("return x", "return x", "return -x")
        )
        assert one == same != other

    def test_what_has_no_digest_is_refused(self):
        with pytest.raises(TypeError, match="reads a global of type object"):
            self.digest("return x + K", K=object())

    def test_loops_that_call_each_other_end(self):
        space = {"numba": numba}
        exec(
            "@numba.njit\ndef f(x):\n    return g(x - 1) if x > 0 else 0\n"
            "@numba.njit\ndef g(x):\n    return f(x - 1) if x > 0 else 1\n",
            space,
        )
        for name in "fg":
            space[name].py_func.__module__ = "somewhere"
        assert loop_digest(space["f"]) != loop_digest(space["g"])
