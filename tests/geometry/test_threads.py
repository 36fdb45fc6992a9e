"""Work shared by a few threads."""

import subprocess
import sys
import threading

import pytest
from threadpoolctl import threadpool_info

from rbfmuscle.geometry.threads import (
    blas_limited,
    each,
    in_stages,
    thread_count,
    threads_limited,
)


@pytest.fixture(params=[1, 2])
def threads(request):
    if request.param > thread_count():
        pytest.skip("one processor")
    with threads_limited(request.param):
        yield request.param


def test_the_second_stage_of_an_item_follows_its_first(threads):
    begun = set()

    def second(item):
        assert item in begun
        return item * item

    groups = [[k] if k % 3 else [k, k + 40] for k in range(40)]

    def first(number):
        begun.update(groups[number])

    wanted = [[item * item for item in group] for group in groups]
    assert in_stages(first, second, groups, lambda item: (item % 3, item % 5)) == wanted


def test_what_has_most_left_to_do_goes_first():
    order = []
    with threads_limited(1):
        costs = {"a": (1.0, 2.0), "b": (5.0, 4.0), "c": (1.0, 4.5)}
        in_stages(
            lambda number: order.append((1, "abc"[number])),
            lambda item: order.append((2, item)),
            "abc",
            costs.get,
        )
    assert order == [(1, "b"), (1, "c"), (2, "c"), (2, "b"), (1, "a"), (2, "a")]


def test_two_threads_draw_one_item_while_another_is_solved():
    if thread_count() < 2:
        pytest.skip("one processor")
    solving, drawn = threading.Event(), threading.Event()

    def first(number):
        if number == 0:
            solving.set()
            assert drawn.wait(60.0)

    def second(item):
        if item == "quick":
            assert solving.wait(60.0)
            drawn.set()

    in_stages(first, second, [["slow"], ["quick"]], {"slow": (9, 1), "quick": (1, 1)}.get)


def test_items_of_a_group_that_ends_late_are_shared_by_the_threads():
    if thread_count() < 2:
        pytest.skip("one processor")
    drawn, both = threading.Event(), threading.Barrier(2, timeout=60.0)

    def first(number):
        if number == 0:
            assert drawn.wait(60.0)

    def second(item):
        if item == "quick":
            drawn.set()
        else:
            both.wait()

    in_stages(first, second, [["one", "other"], ["quick"]], lambda item: (1.0, 1.0))


def test_an_error_is_raised_when_nothing_is_being_worked_on(threads):
    def second(item):
        if item == 3:
            raise ValueError("third")

    with pytest.raises(ValueError, match="third"):
        in_stages(lambda number: None, second, [[k] for k in range(20)], lambda item: (1.0, 1.0))


def _blas_threads():
    import scipy.linalg  # noqa: F401 - has a BLAS of its own beside NumPy's

    return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]


def test_blas_has_its_threads_again_when_the_last_of_several_runs_ends():
    """Runs of several threads begin and end in any order; some builds of OpenBLAS let the main
    thread alone set the number, so it stands for all here.
    """
    before = _blas_threads()
    first, second = blas_limited(1), blas_limited(1)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    between = _blas_threads()
    second.__exit__(None, None, None)
    assert set(between) == {1} and _blas_threads() == before


def test_threads_are_limited_for_the_thread_that_asks_and_for_what_it_starts():
    with threads_limited(1):
        assert thread_count() == 1
        counts = []
        other = threading.Thread(target=lambda: counts.append(thread_count()))
        other.start()
        other.join()
    assert counts == [thread_count()]
    if thread_count() > 1:
        assert set(each(lambda item: thread_count(), range(8))) == {1}


def test_work_in_threads_starts_none_of_numbas_own():
    code = (
        "import threading, time\nfrom rbfmuscle.geometry.threads import each\n"
        "each(lambda item: time.sleep(0.1), range(2))\n"
        "import os\n"
        "from numba.np.ufunc import parallel\nprint(parallel._is_initialized)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
