"""`compiled`: the one way in which a loop of ours is declared."""

from collections.abc import Callable
from functools import cache
from typing import Any

# Loops let other threads run. No loop of ours is handed to another as an argument, so the wrapper that would allow it
# is left out, which saves a tenth of the compiling.
_OPTIONS = {"nopython": True, "nogil": True, "no_cfunc_wrapper": True}


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
        As for ``numba.njit``, ``error_model="numpy"`` for instance; ``nogil`` is set. ``nogil=False`` suits a loop of
        a few microseconds that is asked thousands of times a frame: with muscles on two threads each hand-over of
        the interpreter may take longer than the loop.

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
    from numba.core import config

    if config.DISABLE_JIT:
        return function
    return _kind()(py_func=function, targetoptions={**_OPTIONS, **options})


@cache
def _kind():
    from rbfmuscle.compiled.dispatch import Loop

    return Loop
