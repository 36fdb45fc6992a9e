"""Threads for muscles that run in parallel."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import numba


class Workers:
    """Runs functions in parallel, each with one thread.

    Parameters
    ----------
    muscles : int

    """

    def __init__(self, muscles: int) -> None:
        from threadpoolctl import ThreadpoolController

        self._blas = ThreadpoolController()
        threads = min(muscles, numba.get_num_threads())
        self._pool: ThreadPoolExecutor | None = None
        if threads > 1:
            self._pool = ThreadPoolExecutor(threads, initializer=numba.set_num_threads, initargs=(1,))

    @property
    def parallel(self) -> bool:
        """Whether there is more than one thread."""
        return self._pool is not None

    def one_thread_each(self) -> AbstractContextManager:
        """Context in which BLAS uses one thread.

        More would spin and take the cores from the loops, and results would depend on their number.
        """
        return self._blas.limit(limits=1, user_api="blas")

    def each(self, act: Callable[[Any], Any], items: Sequence[Any]) -> list:
        """``[act(item) for item in items]``, in parallel where that pays."""
        if self._pool is None or len(items) < 2:
            return [act(item) for item in items]
        return list(self._pool.map(act, items))

    def close(self) -> None:
        """End the threads; queued work is dropped."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
