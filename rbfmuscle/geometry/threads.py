"""Large loops over points, split over a few threads; the loops themselves are serial and release
the lock.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from heapq import heapify, heappop, heappush
from itertools import pairwise
from threading import Lock
from typing import TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")
# Fewer points than this a thread cost more to hand over than to do.
LEAST_SHARE = 1024


@lru_cache(maxsize=4)
def _pool(workers: int) -> ThreadPoolExecutor:
    # What runs in these threads has one of them: a loop inside that splits itself stays serial.
    return ThreadPoolExecutor(
        workers, thread_name_prefix="rbfmuscle", initializer=numba.set_num_threads, initargs=(1,)
    )


def each(act: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """``[act(item) for item in items]``, on at most ``numba.get_num_threads()`` threads.

    An error is raised once no item is being worked on any more.
    """
    workers = min(numba.get_num_threads(), len(items))
    if workers < 2:
        return [act(item) for item in items]
    futures = [_pool(workers).submit(act, item) for item in items]
    try:
        return [future.result() for future in futures]
    finally:
        for future in futures:
            future.cancel()
        wait(futures)


def in_stages(
    first: Callable[[Item], object],
    second: Callable[[Item], Result],
    items: Sequence[Item],
    costs: Sequence[tuple[float, float]],
) -> list[Result]:
    """``[second(item) for item in items]``, each after ``first(item)``, as `each` does it.

    ``costs`` says how long both will take of each item: what has the most left to do goes first,
    so that no thread waits long for the last of them.
    """
    ready = [(-sum(cost), number) for number, cost in enumerate(costs)]
    heapify(ready)
    begun: set[int] = set()
    results: dict[int, Result] = {}
    lock = Lock()

    def work(_: int) -> None:
        # A thread ends where nothing is ready: what becomes ready later, others go on with.
        while True:
            with lock:
                if not ready:
                    return
                _, number = heappop(ready)
            try:
                if number in begun:
                    results[number] = second(items[number])
                    continue
                first(items[number])
            except BaseException:
                with lock:
                    ready.clear()
                raise
            with lock:
                begun.add(number)
                heappush(ready, (-costs[number][1], number))

    each(work, range(min(numba.get_num_threads(), len(items))))
    return [results[number] for number in range(len(items))]


def in_chunks(count: int, work: Callable[[int, int], object], *, least: int = LEAST_SHARE) -> None:
    """Call ``work(start, stop)`` over the range of ``count``, on at most
    ``numba.get_num_threads()`` threads.

    The number of threads is the caller's own (numba keeps it for each thread), so what already runs
    in parallel sets it to one and stays serial here.
    """
    # Small questions are asked by the dozen in a frame, and asking for the number of threads takes
    # longer than they do.
    workers = min(numba.get_num_threads(), count // least) if count >= 2 * least else 1
    if workers < 2:
        work(0, count)
        return
    # Several pieces a thread, as pieces differ in cost.
    pieces = min(4 * workers, count // least)
    limits = [count * k // pieces for k in range(pieces + 1)]
    futures = [_pool(workers).submit(work, a, b) for a, b in pairwise(limits)]
    for future in futures:
        future.result()
