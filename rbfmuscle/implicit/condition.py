"""Estimates of the extreme eigenvalues of a factored matrix, for a few products with vectors."""

import math

import numpy as np

PROBES = 2


def largest_eigenvalue(size, multiply):
    """Largest eigenvalue of a symmetric matrix by two steps of power iteration, a lower bound.

    Parameters
    ----------
    size : int
    multiply : callable
        Vector (size,) -> matrix times vector.

    Returns
    -------
    float
    """
    vector = np.full(size, 1.0)
    vector[1::2] -= 1e-3
    norm = 0.0
    for _ in range(2):
        vector /= math.sqrt(vector @ vector)
        vector = multiply(vector)
        norm = math.sqrt(vector @ vector)
        if norm == 0.0:  # one centre of a kernel that is 0 there
            break
    return norm


def probe_vectors(pivots):
    """Probes for the smallest eigenvector: the unit vector of the smallest pivot, and signs, (size, PROBES).

    Parameters
    ----------
    pivots : (size,) ndarray
        Diagonal of the Cholesky factor.

    Returns
    -------
    (size, PROBES) ndarray
        Of length one; the longest of the solutions for them is an estimate of 1 / (smallest eigenvalue).
    """
    size = len(pivots)
    probes = np.zeros((size, PROBES))
    probes[int(np.argmin(pivots)), 0] = 1.0
    probes[:, 1] = np.where((np.arange(size) * 0x9E3779B1) >> 7 & 1, 1.0, -1.0) / math.sqrt(size)
    return probes
