"""Solving RBF systems: one Cholesky factorisation, and what to do and say when it fails.

A conditionally positive definite matrix A with polynomial block P (q rows, P w = 0 for the weights) becomes definite
as M = A + gamma P^T P for gamma large enough. Since P w = 0, the solution of the augmented system

    [A  P^T] [w]   [y]
    [P   0 ] [b] = [0]

also solves M w + P^T b = y, hence b = (P M^-1 P^T)^-1 P M^-1 y and w = M^-1 (y - P^T b).
"""

import math

import numpy as np
from scipy import linalg
from scipy.linalg import blas, lapack
from scipy.spatial import cKDTree

from rbfmuscle.implicit import assembly

_PROBES = 2


class Basis:
    """Scaled centres, kernel and polynomial part of one fit.

    Parameters
    ----------
    points : (K, 3) ndarray
        Centres, scaled to order one.
    kernel : Kernel
    epsilon : float
        In scaled coordinates.
    degree : int
    hermite : bool
    """

    def __init__(self, points, kernel, epsilon, degree, hermite):
        self.points, self.kernel, self.epsilon = points, kernel, float(epsilon)
        self.hermite = hermite
        self.powers = assembly.exponents(degree)
        block = assembly.hermite_polynomials if hermite else assembly.monomials
        self.polynomials = np.ascontiguousarray(block(points, self.powers))
        self.size = len(points) * (4 if hermite else 1)

    @property
    def gamma(self):
        """Multiple of P^T P that is added: the largest entry of A is a safe measure, checked by Cholesky."""
        if not len(self.powers):
            return 0.0
        ends = np.array([0.0, 2.0])
        sizes = [np.abs(self.kernel.phi(ends, self.epsilon)).max()]
        if self.hermite:
            sizes.append(abs(float(self.kernel.first(2.0, self.epsilon))))
        return 2.0 * max(sizes)

    def matrix(self, gamma):
        """A + gamma P^T P, lower triangle valid, Fortran order: (size, size)."""
        kernel = self.kernel
        out = np.empty((self.size, self.size))
        loop = assembly._hermite_matrix_loop if self.hermite else assembly._value_matrix_loop
        loop(
            np.ascontiguousarray(self.points.T), self.epsilon, kernel.base, kernel.parameter, kernel.compact,
            kernel.table, gamma, self.polynomials, out,
        )  # fmt: skip
        return out.T


def solve(basis, right, *, smoothing=0.0):
    """Weights, polynomial coefficients and an estimate of the condition.

    Parameters
    ----------
    basis : Basis
    right : (size,) ndarray
    smoothing : float
        Added to the diagonal (scaled coordinates).

    Returns
    -------
    weights : (size,) ndarray
    coefficients : (q,) ndarray
    condition : float
        Of the matrix that was factored, 2-norm, from a power iteration.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the system is singular; the message names the likely cause.
    """
    gamma = basis.gamma
    for attempt in range(3 if gamma else 1):
        matrix = basis.matrix(gamma * 30.0**attempt)
        if smoothing:
            matrix.ravel(order="K")[:: basis.size + 1] += smoothing
        norm = _largest(matrix)
        factor, info = lapack.dpotrf(matrix, lower=1, overwrite_a=1, clean=0)
        if info == 0:
            return _schur(basis, factor, right, norm)
    return _solve_indefinite(basis, right, smoothing)


def _largest(matrix):
    """Largest eigenvalue of a symmetric matrix (lower triangle) by two steps of power iteration."""
    vector = np.full(len(matrix), 1.0)
    vector[1::2] -= 1e-3
    norm = 0.0
    for _ in range(2):
        vector /= math.sqrt(vector @ vector)
        vector = blas.dsymv(1.0, matrix, vector, lower=1)
        norm = math.sqrt(vector @ vector)
    return norm


def _probe_vectors(factor):
    """Two probes for the smallest eigenvector: the unit vector of the smallest pivot, and signs."""
    count = len(factor)
    pivots = np.diagonal(factor)
    probes = np.zeros((count, _PROBES), order="F")
    probes[int(np.argmin(pivots)), 0] = 1.0
    probes[:, 1] = np.where((np.arange(count) * 0x9E3779B1) >> 7 & 1, 1.0, -1.0) / math.sqrt(count)
    return probes


def _schur(basis, factor, right, norm):
    """Solution from the Cholesky factor of M, by the Schur complement of the polynomial block."""
    polynomials = basis.polynomials
    q = len(polynomials)
    block = np.empty((basis.size, 1 + q + _PROBES), order="F")
    block[:, 0], block[:, 1 : 1 + q], block[:, 1 + q :] = right, polynomials.T, _probe_vectors(factor)
    solved, _ = lapack.dpotrs(factor, block, lower=1, overwrite_b=1)
    growth = np.sqrt((solved[:, 1 + q :] ** 2).sum(axis=0)).max()
    condition = norm * growth
    weights = solved[:, 0].copy()
    if not q:
        return weights, np.zeros(0), condition
    coefficients = linalg.solve(polynomials @ solved[:, 1 : 1 + q], polynomials @ weights, assume_a="pos")
    weights -= solved[:, 1 : 1 + q] @ coefficients
    return weights, coefficients, condition


def _solve_indefinite(basis, right, smoothing):
    """Augmented system by a symmetric indefinite factorisation."""
    size, q = basis.size, len(basis.powers)
    full = np.zeros((size + q, size + q))
    lower = np.tril(basis.matrix(0.0))
    full[:size, :size] = lower + np.tril(lower, -1).T + smoothing * np.eye(size)
    full[size:, :size], full[:size, size:] = basis.polynomials, basis.polynomials.T
    norm = np.abs(full).sum(axis=0).max()
    factor, pivots, info = lapack.dsytrf(full, lower=1)
    reciprocal = 0.0
    if info == 0:
        reciprocal, _ = lapack.dsycon(factor, pivots, norm, lower=1)
    if reciprocal < 1e-17:
        raise np.linalg.LinAlgError(diagnose(basis))
    solution, _ = lapack.dsytrs(factor, pivots, np.append(right, np.zeros(q)), lower=1)
    return solution[:size].ravel(), solution[size:].ravel(), 1.0 / reciprocal


def diagnose(basis):
    """Likely cause of a singular system, as one line."""
    points, q = basis.points, len(basis.powers)
    distance, other = cKDTree(points).query(points, k=min(2, len(points)))
    if len(points) > 1:
        nearest = int(np.argmin(distance[:, 1]))
        if distance[nearest, 1] < 1e-9:
            return (
                f"singular fit: centres {min(nearest, other[nearest, 1])} and {max(nearest, other[nearest, 1])} "
                f"coincide ({distance[nearest, 1]:.1e} of the extent apart); remove duplicates"
            )
    if q and np.linalg.matrix_rank(basis.polynomials, tol=1e-10) < q:
        degree = int(basis.powers.sum(axis=1).max())
        flat = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        shape = (
            "coplanar" if len(points) < 3 or flat[-1] < 1e-10 * max(flat[0], 1e-300) else "too few or special"
        )
        return (
            f"singular fit: the {len(points)} centres are {shape} for polynomials of degree {degree} "
            f"({q} terms); lower the degree or use a kernel of lower order"
        )
    return (
        f"singular fit: kernel '{basis.kernel.name}' with epsilon {basis.epsilon:.3g} (in units of the extent) is too "
        "flat for these centres; raise epsilon, add smoothing or use a kernel of finite smoothness"
    )
