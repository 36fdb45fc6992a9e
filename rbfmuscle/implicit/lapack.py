"""Cholesky factors by SciPy's own LAPACK, without the interpreter's lock.

SciPy's Python wrappers of LAPACK hold the lock while they work, so that muscles fitted side by side would wait
for each other; the same routines called through their published addresses (`scipy.linalg.cython_lapack`) do not.
"""

import ctypes
from functools import lru_cache

import numpy as np

_INT = ctypes.POINTER(ctypes.c_int)
_CHAR, _ARRAY = ctypes.c_char_p, ctypes.c_void_p


@lru_cache(maxsize=8)
def _routine(name, *types):
    from scipy.linalg import cython_lapack

    capsule = cython_lapack.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *types)(address)


def factor_cholesky(matrix):
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


def solve_cholesky(factor, right):
    """Replace the columns of ``right`` by the solutions of the factored system.

    Parameters
    ----------
    factor : (n, n) ndarray, Fortran order
        From `factor_cholesky`.
    right : (n, m) ndarray, Fortran order
        Changed in place.
    """
    _check(factor)
    _check(right)
    size, columns, info = ctypes.c_int(len(factor)), ctypes.c_int(right.shape[1]), ctypes.c_int(0)
    routine = _routine("dpotrs", _CHAR, _INT, _INT, _ARRAY, _INT, _ARRAY, _INT, _INT)
    routine(
        b"L", size, columns, factor.ctypes.data, size, right.ctypes.data, size, info
    )  # fmt: skip


def _check(array):
    if array.dtype != np.float64 or not array.flags.f_contiguous or array.ndim != 2:
        raise ValueError("LAPACK needs a two-dimensional float64 array in Fortran order")
