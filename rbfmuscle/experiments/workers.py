"""Threads that a run of an experiment may use."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def threads_limited(count: int) -> Iterator[None]:
    """Context in which loops and BLAS use so many threads."""
    import numba
    from threadpoolctl import threadpool_limits

    before = numba.get_num_threads()
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))
    try:
        with threadpool_limits(count):
            yield
    finally:
        numba.set_num_threads(before)
