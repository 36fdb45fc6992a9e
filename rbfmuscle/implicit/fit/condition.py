"""Estimates of the extreme eigenvalues of a factored matrix, for a few products with vectors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Floats


def largest_eigenvalue(
    size: int, multiply: Callable[[Floats], Floats], *, steps: int = 2, start: Floats | None = None
) -> float:
    """Largest eigenvalue of a symmetric matrix by a few steps of power iteration, a lower bound.

    Parameters
    ----------
    size : int
    multiply : callable
        Vector (size,) -> matrix times vector.
    steps : int
    start : (size,) ndarray, optional
        First vector; all but constant by default.

    Returns
    -------
    float
    """
    if start is None:
        vector = np.full(size, 1.0)
        vector[1::2] -= 1e-3
    else:
        vector = start.copy()
    norm = 0.0
    for _ in range(steps):
        vector /= math.sqrt(vector @ vector)
        vector = multiply(vector)
        norm = math.sqrt(vector @ vector)
        if norm == 0.0:  # one centre of a kernel that is 0 there
            break
    return norm


def probe(pivots: Floats) -> Floats:
    """Probe for the smallest eigenvector: random signs, and the unit vector of the smallest pivot.

    Parameters
    ----------
    pivots : (size,) ndarray
        Diagonal of the Cholesky factor.

    Returns
    -------
    (size,) ndarray
        Of length about one; the length of the solution for it is an estimate of 1 / (smallest eigenvalue).
    """
    size = len(pivots)
    signs = np.where((np.arange(size) * 0x9E3779B1) >> 7 & 1, 1.0, -1.0) / math.sqrt(2 * size)
    weakest = int(np.argmin(pivots))
    signs[weakest] += math.copysign(math.sqrt(0.5), signs[weakest])
    return signs
