"""What a command shows while it works: lines where stderr is no terminal."""

import pytest

from rbfmuscle import progress
from rbfmuscle.progress import Progress, stage


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is set."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_counts_are_shown_after_two_seconds_then_every_ten_and_at_the_end(clock, capsys):
    with Progress("hip") as shown:
        for done, seconds in enumerate((1.0, 2.5, 8.0, 12.4, 12.6, 13.0), 1):
            clock[0] = 100.0 + seconds
            shown(done, 6)
    assert (
        capsys.readouterr().err
        == "hip: frame 2 of 6 (2 s)\nhip: frame 5 of 6 (13 s)\nhip: frame 6 of 6 (13 s)\n"
    )


def test_stages_and_what_is_inside_are_shown_under_the_outermost_title(clock, capsys):
    with pytest.raises(ValueError), Progress("sweep", what="point"), stage("building"):
        with Progress("hip") as inner:
            inner(3, 3)
        raise ValueError
    with stage("alone"):
        pass
    with Progress("next") as following:
        following(1, 2)
    assert capsys.readouterr().err == "sweep: building (0 s)\nsweep: frame 3 of 3 (0 s)\n"


def test_terminal_gets_a_bar(monkeypatch, capsys):
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    with Progress("hip") as shown, stage("building"):
        shown(1, 4)
        (task,) = shown.bar.tasks
        assert (task.description, task.completed, task.total) == ("hip: frame 1 of 4", 1, 4)
    assert Progress.shown is None
