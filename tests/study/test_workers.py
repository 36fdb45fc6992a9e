"""Calls that are spread over processes."""

import operator
import os
import time

import numpy as np
import pytest
import trimesh

import rbfmuscle as rm
from rbfmuscle.study.experiment import kernel_study, workers
from rbfmuscle.validation import SolveError


@pytest.fixture
def children(monkeypatch):
    """The processes that a test starts."""
    started, start = [], workers.start_child

    def noted(*arguments):
        started.append(start(*arguments))
        return started[-1]

    monkeypatch.setattr(workers, "start_child", noted)
    return started


def test_results_come_in_the_order_of_the_calls(children):
    calls = [(2, power) for power in range(9)]
    assert list(workers.side_by_side(pow, calls, 2)) == [2**power for power in range(9)]
    assert len(children) == 2 and all(child.poll() is not None for child in children)


def test_what_a_call_raises_is_raised_and_nothing_is_left(children):
    results = workers.side_by_side(operator.truediv, [(1, 2), (1, 0), (1, 4)], 2)
    assert next(results) == 0.5
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert all(child.poll() is not None for child in children)


def test_an_ended_process_is_told_with_its_remedy(children):
    with pytest.raises(SolveError, match="NUMBA_NUM_THREADS=1"):
        list(workers.side_by_side(os._exit, [(3,)], 1))


def test_calls_that_nobody_waits_for_any_more_are_ended(children):
    results = workers.side_by_side(time.sleep, [(0.0,), (3600.0,), (3600.0,)], 2)
    assert next(results) is None
    results.close()
    assert [child.poll() is not None for child in children] == [True, True]


def test_a_study_in_several_processes_is_that_of_one(children, monkeypatch):
    ball = trimesh.creation.icosphere(3, 10.0).apply_scale([2.0, 1.0, 1.0])
    asked = {"kernels": ["cubic", "quintic", "gaussian"], "centres": [30, 50], "resolution": 24}
    assert kernel_study.processes_for(kernel_study.MANY - 1) == 1
    monkeypatch.setattr(kernel_study, "processes_for", lambda rows: 2)
    several = rm.study_kernels(ball, **asked)
    assert len(children) == 2
    monkeypatch.setattr(kernel_study, "processes_for", lambda rows: 1)
    one = rm.study_kernels(ball, **asked)
    assert len(children) == 2
    order = {(row["kernel"], row["centres"]): row for row in one.rows}
    for row in several.rows:
        same = order[row["kernel"], row["centres"]]
        assert row["unfit"] == same["unfit"] and row["epsilon"] == pytest.approx(same["epsilon"], rel=1e-9)
        if not row["unfit"]:
            np.testing.assert_allclose(row["rms"], same["rms"], rtol=1e-6)
            assert row["fit_time"] > 0.0 and row["evaluation_time"] > 0.0
