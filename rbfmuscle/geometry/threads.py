"""Large loops over points, split over a few threads; the loops themselves are serial and release
the lock.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise
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
