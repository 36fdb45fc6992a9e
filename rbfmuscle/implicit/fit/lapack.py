"""The Cholesky factor by SciPy's own LAPACK, without the interpreter's lock.

SciPy's Python wrapper holds the lock while it works, so that muscles fitted side by side would wait for each other;
the same routine called by its published address does not.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import numpy as np

from rbfmuscle.geometry.arrays import Floats


@cache
def _dpotrf() -> Callable[..., None]:
    from numba.extending import get_cython_function_address

    address = get_cython_function_address("scipy.linalg.cython_lapack", "dpotrf")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5)(address)


def factor_cholesky(matrix: Floats) -> int:
    """Replace the lower triangle of a symmetric matrix by its Cholesky factor.

    Parameters
    ----------
    matrix : (n, n) ndarray, Fortran order
        Changed in place; the upper triangle is neither read nor written.

    Returns
    -------
    int
        0, or the order of the first leading minor that is not positive.
    """
    if matrix.dtype != np.float64 or not matrix.flags.f_contiguous or matrix.ndim != 2:
        raise ValueError("LAPACK needs a two-dimensional float64 array in Fortran order")
    lower, size, failed = ctypes.c_char(b"L"), ctypes.c_int(len(matrix)), ctypes.c_int(0)
    order = ctypes.byref(size)
    _dpotrf()(ctypes.byref(lower), order, matrix.ctypes.data, order, ctypes.byref(failed))
    return failed.value
