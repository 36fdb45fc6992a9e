"""`compiled`: the one way in which a loop of ours is declared."""

from collections.abc import Callable
from typing import Any

# What every loop is: it lets other threads run, and raises nothing by itself.
_DEFAULTS = {"nogil": True}


def compiled(function: Callable | None = None, **options: Any) -> Callable:
    """Declare a loop: compiled at its first call, kept on disk under the name of its content.

    A loop kept on disk is found again by any environment and any checkout that holds the same text of it,
    of the loops it calls and of the constants it reads; an edit to any of these gives it another name
    (`rbfmuscle.compiled.fingerprint`), so nothing old ever runs and nothing else is compiled again.

    Parameters
    ----------
    function : callable
        A function of arrays, numbers and NamedTuples of these.
    **options
        As for ``numba.njit``, ``error_model="numpy"`` for instance; ``nogil`` is set.

    Returns
    -------
    callable
        The loop; the function itself where ``NUMBA_DISABLE_JIT`` is set.

    Examples
    --------
    >>> @compiled(error_model="numpy")
    ... def _sum_loop(values):
    ...     total = 0.0
    ...     for value in values:
    ...         total += value
    ...     return total
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    import numba

    loop = numba.njit(**{**_DEFAULTS, **options})(function)
    if loop is not function:
        from rbfmuscle.compiled.cache import LoopCache

        loop._cache = LoopCache(loop)
    return loop
