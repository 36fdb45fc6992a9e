"""The one way in which a numerical loop is declared."""

from collections.abc import Callable

import numba


def loop(function: Callable | None = None, **options: object) -> Callable:
    """Compile a function of plain arrays and numbers with numba when it is first called.

    The machine code is kept in numba's cache beside the source (or where ``NUMBA_CACHE_DIR``
    says), and the interpreter's lock is released while it runs. Where nothing can be written, each
    process compiles anew. Further ``options`` are those of ``numba.njit``.

    Every loop is called with arguments of one set of types: more would be compiled one by one, and
    processes that write the cache side by side could mix them up.

    Examples
    --------
    >>> @loop
    ... def add(a, b):
    ...     return a + b
    >>> add(1.0, 2.0)
    3.0
    """
    if function is None:
        return lambda inner: loop(inner, **options)
    settings: dict[str, object] = {"nogil": True, "error_model": "numpy", **options}
    try:
        return numba.njit(cache=True, **settings)(function)
    except RuntimeError:  # numba finds no folder for its cache
        return numba.njit(**settings)(function)
