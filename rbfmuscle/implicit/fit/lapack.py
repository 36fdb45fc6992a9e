"""Symmetric matrices and their Cholesky factors by SciPy's own BLAS and LAPACK, without the interpreter's lock.

SciPy's Python wrappers hold the lock while they work, so that muscles fitted side by side would wait for each other;
the same routines called through their published addresses (`scipy.linalg.cython_lapack`) do not.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from rbfmuscle.geometry.arrays import Floats

_INT = ctypes.POINTER(ctypes.c_int)
_REAL = ctypes.POINTER(ctypes.c_double)
_CHAR, _ARRAY = ctypes.c_char_p, ctypes.c_void_p


@lru_cache(maxsize=8)
def _routine(name: str, *types: type) -> Callable[..., None]:
    from scipy.linalg import cython_blas, cython_lapack

    published = {**cython_blas.__pyx_capi__, **cython_lapack.__pyx_capi__}
    capsule = published[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *types)(address)


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
    size, info = ctypes.c_int(len(matrix)), ctypes.c_int(0)
    routine = _routine("dpotrf", _CHAR, _INT, _ARRAY, _INT, _INT)
    routine(b"L", size, matrix.ctypes.data, size, info)
    return info.value


def solve_cholesky(factor: Floats, right: Floats) -> None:
    """Replace the few columns of ``right`` by the solutions of the factored system.

    Parameters
    ----------
    factor : (n, n) ndarray, Fortran order
        From `factor_cholesky`.
    right : (n, m) ndarray, Fortran order
        Changed in place.
    """
    _check(factor)
    _check(right)
    # column by column: dpotrs takes three times as long for the few columns there are
    size, one = ctypes.c_int(len(factor)), ctypes.c_int(1)
    routine = _routine("dtrsv", _CHAR, _CHAR, _CHAR, _INT, _ARRAY, _INT, _ARRAY, _INT)
    for column in right.T:
        for turned in (b"N", b"T"):
            routine(b"L", turned, b"N", size, factor.ctypes.data, size, column.ctypes.data, one)


def multiply_symmetric(matrix: Floats, right: Floats) -> Floats:
    """Product of a symmetric matrix (lower triangle) and a few columns.

    Parameters
    ----------
    matrix : (n, n) ndarray, Fortran order
    right : (n, m) ndarray, Fortran order

    Returns
    -------
    (n, m) ndarray, Fortran order
    """
    _check(matrix)
    _check(right)
    out = np.empty_like(right)
    size, columns = ctypes.c_int(len(matrix)), ctypes.c_int(right.shape[1])
    one, zero = ctypes.c_double(1.0), ctypes.c_double(0.0)
    kinds = (_CHAR, _CHAR, _INT, _INT, _REAL, _ARRAY, _INT, _ARRAY, _INT, _REAL, _ARRAY, _INT)
    routine = _routine("dsymm", *kinds)
    routine(
        b"L", b"L", size, columns, one, matrix.ctypes.data, size, right.ctypes.data, size, zero, out.ctypes.data, size
    )  # fmt: skip
    return out


def subtract_products(matrix: Floats, left: Floats, right: Floats) -> None:
    """Subtract ``left right^T + right left^T`` from the lower triangle of a symmetric matrix, in place.

    Parameters
    ----------
    matrix : (n, n) ndarray, Fortran order
    left, right : (n, m) ndarray, Fortran order
    """
    for array in (matrix, left, right):
        _check(array)
    size, columns = ctypes.c_int(len(matrix)), ctypes.c_int(left.shape[1])
    minus, one = ctypes.c_double(-1.0), ctypes.c_double(1.0)
    kinds = (_CHAR, _CHAR, _INT, _INT, _REAL, _ARRAY, _INT, _ARRAY, _INT, _REAL, _ARRAY, _INT)
    routine = _routine("dsyr2k", *kinds)
    routine(
        b"L", b"N", size, columns, minus, left.ctypes.data, size, right.ctypes.data, size, one, matrix.ctypes.data, size
    )  # fmt: skip


def _check(array: Floats) -> None:
    if array.dtype != np.float64 or not array.flags.f_contiguous or array.ndim != 2:
        raise ValueError("LAPACK needs a two-dimensional float64 array in Fortran order")
