"""What runs of an experiment are spread over: threads, cores, the workers of a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

from rbfmuscle.validation import MissingPartError, UsageError

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

    def __exit__(self, *error: Any) -> None:
        import numba

        self.limits.restore_original_limits()
        numba.set_num_threads(self.before)


def connect_cluster(scheduler: str, least: int) -> Any:
    """A client of a Dask scheduler, as soon as so many workers are there.

    Raises
    ------
    MissingPartError
        If Dask is not installed.
    UsageError
        If no scheduler with workers answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingPartError(
            "Dask is not installed, which --scheduler needs: pip install -e '.[cluster]' in rbfmuscle's folder"
        ) from error
    try:
        client = Client(scheduler, timeout=CONNECT_WITHIN)
        client.wait_for_workers(least, timeout=CONNECT_WITHIN)
    except (OSError, ValueError) as error:
        many = "two workers" if least == 2 else "a worker"
        raise UsageError(f"no Dask scheduler with {many} answers at {scheduler!r} ({error})") from None
    return client


def delayed_calls(function: Callable[..., Any], calls: Iterator[Any], **options: Any) -> Iterator[Any]:
    """joblib's tasks for calls with these positional arguments."""
    from joblib import delayed

    return (delayed(function)(*arguments, **options) for arguments in calls)
