"""Progress of a command: lines for a log, at most one in ten seconds, and a bar on a terminal."""

from types import SimpleNamespace

import pytest

from rbfmuscle import interruption, progress
from rbfmuscle.progress import Progress, stage


def test_a_log_has_each_stage_the_last_count_and_others_ten_seconds_apart(monkeypatch, capsys):
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(progress, "time", clock)
    with Progress("arm") as shown:
        for done, clock.now in enumerate((1.9, 2.2, 3.0, 12.1, 12.6, 13.0), 1):
            shown(done, 6)
        with Progress("inner", "muscle") as inner:
            inner(1, 1)
        with stage("report"):
            pass
    with stage("nobody looks"):
        pass
    told = [
        "frame 2 of 6 (2 s)",
        "frame 5 of 6 (13 s)",
        "frame 6 of 6 (13 s)",
        "muscle 1 of 1 (13 s)",
    ]
    assert capsys.readouterr().err.splitlines() == [
        f"arm: {text}" for text in [*told, "report (13 s)"]
    ]


def test_a_terminal_has_a_bar_that_goes_when_it_is_done(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Progress("arm") as shown:
        shown(1, 6)
    out, err = capsys.readouterr()
    assert out == "" and "arm: frame 1 of 6" in err and err.endswith("\x1b[2K")


def test_the_time_that_is_left_is_shown_where_it_is_asked_for(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    for estimate in (False, True):
        with Progress("arm", estimate=estimate) as shown:
            shown(1, 6)
        assert (" to go " in capsys.readouterr().err) == estimate


def test_an_interrupt_that_was_lost_is_raised_at_the_next_count(monkeypatch):
    with Progress("arm") as shown:
        shown(1, 6)
        monkeypatch.setattr(interruption._State, "asked", True)
        with pytest.raises(KeyboardInterrupt):
            shown(2, 6)
    assert shown.done == 2
