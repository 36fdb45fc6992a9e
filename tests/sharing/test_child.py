"""Processes of ours beside this one: calls that are made in several."""

import operator
import os
import time

import pytest

from rbfmuscle import child
from rbfmuscle.validation import SolveError


@pytest.fixture
def children(monkeypatch):
    """The processes that a test starts."""
    started, start = [], child.start_child

    def noted(*arguments):
        started.append(start(*arguments))
        return started[-1]

    monkeypatch.setattr(child, "start_child", noted)
    return started


def test_results_come_in_the_order_of_the_calls(children):
    calls = [(range(10**7),), *((range(number),) for number in range(9))]  # the first is the slowest
    assert list(child.calls_apart(sum, calls, 2)) == [sum(*call) for call in calls]
    assert [one.poll() for one in children] == [0, 0]


def test_what_a_call_raises_is_raised_and_nothing_is_left(children):
    results = child.calls_apart(operator.truediv, [(1, 2), (1, 0), (1, 4)], 2)
    assert next(results) == 0.5
    with pytest.raises(ZeroDivisionError) as raised:
        next(results)
    assert "child.py" in "".join(raised.value.__notes__)  # where it was raised
    assert all(one.poll() is not None for one in children)


def test_an_ended_process_is_told_with_its_remedy(children):
    with pytest.raises(SolveError, match=r"exit code 3.*NUMBA_NUM_THREADS=1"):
        list(child.calls_apart(os._exit, [(3,), (3,)], 1))


class Broken:
    """What can be pickled and not unpickled."""

    def __reduce__(self):
        return int, ("no number",)


def test_a_call_that_cannot_be_understood_is_told_and_not_waited_for(children, capfd):
    with pytest.raises(SolveError, match="exit code 1"):
        list(child.calls_apart(len, [(Broken(),)], 1))
    assert "no number" in capfd.readouterr().err


def test_calls_that_nobody_waits_for_any_more_are_ended(children):
    results = child.calls_apart(time.sleep, [(0.0,), (600.0,), (600.0,)], 2)
    assert next(results) is None
    begun = time.monotonic()
    results.close()
    assert time.monotonic() - begun < 500.0  # nobody slept on
    assert [one.poll() is not None for one in children] == [True, True]
