"""Large loops over points, split over a few threads; the loops themselves are serial and release
the lock.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import lru_cache
from heapq import heapify, heappop, heappush
from itertools import pairwise
from threading import Lock, local
from typing import TypeVar, cast

from numba import config
from threadpoolctl import LibController, ThreadpoolController

from rbfmuscle.validation import UsageError

Item = TypeVar("Item")
Result = TypeVar("Result")
# Fewer points than this a thread cost more to hand over than to do.
LEAST_SHARE = 1024
_own = local()  # of each thread: how many it may split its work over
_blas_lock = Lock()
_blas_limits: list[int] = []  # of all that are inside `blas_limited` now, in any thread
_blas_before: list[int] = []  # threads of each library outside


def thread_count() -> int:
    """Threads that the calling thread may split its work over: as many as cores, or as
    NUMBA_NUM_THREADS says, unless inside `threads_limited`.
    """
    return getattr(_own, "count", config.NUMBA_NUM_THREADS)


@contextmanager
def threads_limited(count: int) -> Iterator[None]:
    """Context in which work of the calling thread, and BLAS, use at most so many threads."""
    before = thread_count()
    _own.count = max(1, min(count, config.NUMBA_NUM_THREADS))
    try:
        with blas_limited(count):
            yield
    finally:
        _own.count = before


def cores_limited(jobs: int | None) -> AbstractContextManager[None]:
    """Context in which work of the calling thread uses so many cores; all for None."""
    if jobs is None:
        return nullcontext()
    if jobs < 1:
        raise UsageError(f"jobs must be 1 or more, got {jobs}")
    return threads_limited(jobs)


@contextmanager
def blas_limited(count: int) -> Iterator[None]:
    """Context in which BLAS uses at most so many threads.

    Its number belongs to the whole process: of several threads inside, the least counts, and the
    last that leaves restores the number of before.
    """
    with _blas_lock:
        if not _blas_limits:
            _blas_before[:] = [library.num_threads for library in _blas()]
        _blas_limits.append(count)
        _limit_blas()
    try:
        yield
    finally:
        with _blas_lock:
            _blas_limits.remove(count)
            _limit_blas()


def _limit_blas() -> None:
    for library, before in zip(_blas(), _blas_before):
        library.set_num_threads(min([before, *_blas_limits]))


@lru_cache(maxsize=1)
def _blas() -> list[LibController]:
    import scipy.linalg  # noqa: F401 - SciPy brings a BLAS of its own, found once it is loaded

    return ThreadpoolController().select(user_api="blas").lib_controllers


@lru_cache(maxsize=4)
def _pool(workers: int) -> ThreadPoolExecutor:
    # What runs in these threads has one of them: a loop inside that splits itself stays serial.
    return ThreadPoolExecutor(
        workers, thread_name_prefix="rbfmuscle", initializer=setattr, initargs=(_own, "count", 1)
    )


def each(act: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """``[act(item) for item in items]``, on at most `thread_count` threads.

    An error is raised once no item is being worked on any more.
    """
    workers = min(thread_count(), len(items))
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
    first: Callable[[int], object],
    second: Callable[[Item], Result],
    groups: Sequence[Sequence[Item]],
    cost: Callable[[Item], tuple[float, float]],
) -> list[list[Result]]:
    """``[[second(item) for item in group] for group in groups]``, each group after ``first`` of its
    number, as `each` does it.

    ``cost`` says how long an item takes in both stages: what has the most left to do goes first, so
    that no thread waits long for the last of them.
    """
    if len(groups) == 1:  # it has all threads to itself
        first(0)
        return [each(second, groups[0])]
    workers = thread_count()
    ready = [(-sum(sum(cost(item)) for item in group), k, -1) for k, group in enumerate(groups)]
    heapify(ready)
    results: dict[tuple[int, int], object] = {}
    running: dict[Future[object], tuple[int, int]] = {}  # group, and item of its second stage or -1
    try:
        while ready or running:
            while ready and len(running) < workers:
                _, number, part = heappop(ready)
                pool = _pool(workers)
                if part < 0:
                    running[pool.submit(first, number)] = number, part
                else:
                    running[pool.submit(second, groups[number][part])] = number, part
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number, part = running.pop(future)
                found = future.result()
                if part >= 0:
                    results[number, part] = found
                    continue
                for part, item in enumerate(groups[number]):
                    heappush(ready, (-cost(item)[1], number, part))
    finally:
        wait(running)
    return [
        [cast(Result, results[k, part]) for part in range(len(group))]
        for k, group in enumerate(groups)
    ]


def in_chunks(count: int, work: Callable[[int, int], object], *, least: int = LEAST_SHARE) -> None:
    """Call ``work(start, stop)`` over the range of ``count``, on at most `thread_count` threads.

    The number of threads is the caller's own, so what already runs in parallel stays serial here.
    """
    workers = min(thread_count(), count // least)
    if workers < 2:
        work(0, count)
        return
    # Several pieces a thread, as pieces differ in cost.
    pieces = min(4 * workers, count // least)
    limits = [count * k // pieces for k in range(pieces + 1)]
    each(lambda piece: work(*piece), list(pairwise(limits)))
