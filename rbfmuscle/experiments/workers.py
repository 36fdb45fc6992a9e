"""What runs of an experiment are spread over: threads, cores, the workers of a cluster."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from rbfmuscle.validation import MissingPartError, UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_WITHIN = 20  # seconds for a scheduler and its first two workers


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class threads_limited:
    """Context in which loops and BLAS use so many threads."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __enter__(self) -> None:
        import numba
        from threadpoolctl import threadpool_limits

        self.before = numba.get_num_threads()
        numba.set_num_threads(max(1, min(self.count, numba.config.NUMBA_NUM_THREADS)))
        self.limits = threadpool_limits(self.count)

    def __exit__(self, *error: object) -> None:
        import numba

        self.limits.restore_original_limits()
        numba.set_num_threads(self.before)


def connect_cluster(address: str) -> Client:
    """A client of a Dask scheduler, as soon as two workers are there: to one alone joblib sends nothing.

    Raises
    ------
    MissingPartError
        If Dask is not installed.
    UsageError
        If no scheduler with two workers answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingPartError(
            "Dask is not installed, which --cluster needs: pip install 'rbfmuscle[cluster]'"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_WITHIN)
        client.wait_for_workers(2, timeout=CONNECT_WITHIN)
    except (OSError, ValueError) as error:
        raise UsageError(f"no Dask scheduler with two workers answers at {address!r} ({error})") from None
    return client
