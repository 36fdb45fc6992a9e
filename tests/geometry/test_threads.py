"""Work shared by a few threads."""

import threading

import numba
import pytest

from rbfmuscle.geometry.threads import in_stages


@pytest.fixture(params=[1, 2])
def threads(request):
    before = numba.get_num_threads()
    if request.param > before:
        pytest.skip("one processor")
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


def test_the_second_stage_of_an_item_follows_its_first(threads):
    begun = set()

    def second(item):
        assert item in begun
        return item * item

    costs = [(float(k % 3), float(k % 5)) for k in range(40)]
    assert in_stages(begun.add, second, range(40), costs) == [k * k for k in range(40)]


def test_what_has_most_left_to_do_goes_first():
    order = []
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        in_stages(
            lambda item: order.append((1, item)),
            lambda item: order.append((2, item)),
            "abc",
            [(1.0, 2.0), (5.0, 4.0), (1.0, 4.5)],
        )
    finally:
        numba.set_num_threads(before)
    assert order == [(1, "b"), (1, "c"), (2, "c"), (2, "b"), (1, "a"), (2, "a")]


def test_two_threads_draw_one_item_while_another_is_solved():
    if numba.get_num_threads() < 2:
        pytest.skip("one processor")
    solving, drawn = threading.Event(), threading.Event()

    def first(item):
        if item == "slow":
            solving.set()
            assert drawn.wait(60.0)

    def second(item):
        if item == "quick":
            assert solving.wait(60.0)
            drawn.set()

    in_stages(first, second, ["slow", "quick"], [(9.0, 1.0), (1.0, 1.0)])


def test_an_error_is_raised_when_nothing_is_being_worked_on(threads):
    def second(item):
        if item == 3:
            raise ValueError("third")

    with pytest.raises(ValueError, match="third"):
        in_stages(lambda item: None, second, range(20), [(1.0, 1.0)] * 20)
