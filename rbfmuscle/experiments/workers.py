"""What runs of an experiment are distributed to: threads, the workers of a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rbfmuscle.validation import MissingPartError, UsageError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_WITHIN = 20  # seconds for a scheduler and its first two workers


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


def connect_cluster(address: str) -> Client:
    """A client of a Dask scheduler, as soon as two workers are there: to one alone joblib sends nothing.

    MissingPartError if Dask is not installed, UsageError if no scheduler with two workers answers.
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
