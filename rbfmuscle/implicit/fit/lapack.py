"""Symmetric matrices and their Cholesky factors by SciPy's own BLAS and LAPACK, without the interpreter's lock.

SciPy's Python wrappers hold the lock while they work, so that muscles fitted side by side would wait for each other;
the same routines called by their published addresses do not.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from rbfmuscle.geometry.arrays import Floats


@lru_cache(maxsize=8)
def _routine(library: str, name: str, count: int) -> Callable[..., None]:
    from numba.extending import get_cython_function_address

    address = get_cython_function_address(f"scipy.linalg.cython_{library}", name)
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * count)(address)


def _call(library: str, name: str, *arguments: bytes | int | float | Floats) -> int:
    """Call a routine, whose arguments all go by reference; the last one as it is afterwards, where it is a number."""
    passed = [a if isinstance(a, np.ndarray) else _boxed(a) for a in arguments]
    places = [a.ctypes.data if isinstance(a, np.ndarray) else ctypes.byref(a) for a in passed]
    _routine(library, name, len(passed))(*places)
    return getattr(passed[-1], "value", 0)


def _boxed(value: bytes | int | float) -> ctypes.c_char | ctypes.c_int | ctypes.c_double:
    if isinstance(value, bytes):
        return ctypes.c_char(value)
    return ctypes.c_int(value) if isinstance(value, int) else ctypes.c_double(value)


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
    _check(matrix)
    size = len(matrix)
    return _call("lapack", "dpotrf", b"L", size, matrix, size, 0)


def solve_cholesky(factor: Floats, right: Floats) -> None:
    """Replace the few columns of ``right`` by the solutions of the factored system.

    Parameters
    ----------
    factor : (n, n) ndarray, Fortran order
        From `factor_cholesky`.
    right : (n, m) ndarray, Fortran order
        Changed in place.
    """
    _check(factor, right)
    size = len(factor)
    # column by column: dpotrs takes three times as long for the few columns there are
    for column in right.T:
        for turned in (b"N", b"T"):
            _call("blas", "dtrsv", b"L", turned, b"N", size, factor, size, column, 1)


def multiply_symmetric(matrix: Floats, right: Floats) -> Floats:
    """Product (n, m) of a symmetric matrix (n, n), of which the lower triangle is read, and columns (n, m).

    All are in Fortran order.
    """
    _check(matrix, right)
    out, (size, columns) = np.empty_like(right), right.shape
    _call("blas", "dsymm", b"L", b"L", size, columns, 1.0, matrix, size, right, size, 0.0, out, size)
    return out


def subtract_products(matrix: Floats, left: Floats, right: Floats) -> None:
    """Subtract ``left right^T + right left^T``, of (n, m) arrays, from the lower triangle of a matrix (n, n), in place.

    All are in Fortran order.
    """
    _check(matrix, left, right)
    size, columns = left.shape
    _call("blas", "dsyr2k", b"L", b"N", size, columns, -1.0, left, size, right, size, 1.0, matrix, size)


def _check(*arrays: Floats) -> None:
    for array in arrays:
        if array.dtype != np.float64 or not array.flags.f_contiguous or array.ndim != 2:
            raise ValueError("LAPACK needs a two-dimensional float64 array in Fortran order")
