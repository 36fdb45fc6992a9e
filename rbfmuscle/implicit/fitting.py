"""Solving RBF systems: one Cholesky factorisation, and what to do and say when it fails.

A conditionally positive definite matrix A with polynomial block P (q rows, P w = 0 for the weights)
becomes definite as M = A + gamma P^T P for gamma large enough. Since P w = 0, the solution of the
augmented system

    [A  P^T] [w]   [y]
    [P   0 ] [b] = [0]

also solves M w + P^T b = y, hence b = (P M^-1 P^T)^-1 P M^-1 y and w = M^-1 (y - P^T b).
"""

import math
import warnings

import numpy as np
from scipy import linalg
from scipy.linalg import blas, lapack
from scipy.spatial import cKDTree

from rbfmuscle.implicit import assembly
from rbfmuscle.implicit.lapack import factor_cholesky, solve_cholesky
from rbfmuscle.validation import NumericalWarning

DOUBTFUL = 1e13
"""Condition above which a fit is reported as doubtful."""
_CUTOFF = 1e-14
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
    kind : str
        "value", "gradient" (values and all derivatives) or "normal" (values and normal derivatives).
    normals : (K, 3) ndarray, optional
        Unit normals, for kind "normal".
    """

    def __init__(self, points, kernel, epsilon, degree, *, kind="value", normals=None):
        self.points, self.kernel, self.epsilon = points, kernel, float(epsilon)
        self.kind, self.normals = kind, normals
        self.powers = assembly.exponents(degree)
        if kind == "gradient":
            block = assembly.hermite_polynomials(points, self.powers)
        elif kind == "normal":
            block = assembly.normal_polynomials(points, normals, self.powers)
        else:
            block = assembly.monomials(points, self.powers)
        self.polynomials = np.ascontiguousarray(block)
        self.size = self.polynomials.shape[1]

    @property
    def gamma(self):
        """Multiple of P^T P that is added: twice the largest entry of A, checked by Cholesky."""
        if not len(self.powers):
            return 0.0
        sizes = np.abs(self.kernel.phi([0.0, 2.0], self.epsilon))
        slope = abs(float(self.kernel.first(2.0, self.epsilon))) if self.kind != "value" else 0.0
        return 2.0 * max(sizes.max(), slope)

    def matrix(self, gamma):
        """A + gamma P^T P, lower triangle valid, Fortran order: (size, size)."""
        kernel = self.kernel
        out = np.empty((self.size, self.size))
        first = (np.ascontiguousarray(self.points.T),)
        if self.kind == "normal":
            first += (np.ascontiguousarray(self.normals.T),)
        loop = {
            "value": assembly._value_matrix_loop,
            "gradient": assembly._hermite_matrix_loop,
            "normal": assembly._normal_matrix_loop,
        }[self.kind]
        rest = (kernel.base, kernel.parameter, kernel.compact, kernel.table, gamma, self.polynomials, out)
        loop(*first, self.epsilon, *rest)
        return out.T

    def full_matrix(self, smoothing=0.0):
        """The augmented matrix [A P^T; P 0], both triangles: (size + q, size + q)."""
        size, q = self.size, len(self.powers)
        full = np.zeros((size + q, size + q))
        lower = np.tril(self.matrix(0.0))
        full[:size, :size] = lower + np.tril(lower, -1).T
        full[np.arange(size), np.arange(size)] += smoothing
        full[size:, :size], full[:size, size:] = self.polynomials, self.polynomials.T
        return full


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
        Of the matrix that was factored, 2-norm, by power iteration (a lower bound, usually within 10).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the system is singular; the message names the likely cause.

    Warns
    -----
    NumericalWarning
        Where the condition makes the result doubtful.
    """
    gamma = basis.gamma
    for attempt in range(2 if gamma else 1):
        matrix = basis.matrix(gamma * 30.0**attempt)
        if smoothing:
            matrix.ravel(order="K")[:: basis.size + 1] += smoothing
        norm = _largest(matrix)
        if factor_cholesky(matrix) == 0:
            solution = _schur(basis, matrix, right, norm)
            if solution is not None and solution[2] < DOUBTFUL:
                return solution
    raise_if_singular(basis)
    return _solve_truncated(basis, right, smoothing)


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
    solve_cholesky(factor, block)
    solved = block  # in place
    growth = np.sqrt((solved[:, 1 + q :] ** 2).sum(axis=0)).max()
    condition = norm * growth
    weights = solved[:, 0].copy()
    if not q:
        return weights, np.zeros(0), condition
    inner, info = lapack.dpotrf(polynomials @ solved[:, 1 : 1 + q], lower=1)
    pivots = np.diagonal(inner)
    if info or pivots.min() < 1e-7 * pivots.max():
        return None
    coefficients, _ = lapack.dpotrs(inner, polynomials @ weights, lower=1)
    weights -= solved[:, 1 : 1 + q] @ coefficients
    return weights, coefficients, condition


def _solve_truncated(basis, right, smoothing):
    """Least-squares solution of the augmented system without its smallest eigenvalues (rank 1e-14)."""
    full = basis.full_matrix(smoothing)
    values, vectors = linalg.eigh(full, overwrite_a=True, driver="evd")
    sizes = np.abs(values)
    keep = sizes > _CUTOFF * sizes.max()
    right = np.append(right, np.zeros(len(full) - basis.size))
    solution = vectors[:, keep] @ ((vectors[:, keep].T @ right) / values[keep])
    condition = sizes.max() / max(sizes.min(), np.finfo(float).tiny)
    dropped = len(keep) - int(keep.sum())
    if dropped or condition >= DOUBTFUL:
        _warn(basis, condition, dropped)
    return solution[: basis.size], solution[basis.size :], condition


def _warn(basis, condition, dropped):
    remedy = "spread the centres or add smoothing"
    if basis.kernel.has_epsilon:
        remedy = f"raise epsilon (it is {basis.epsilon:.2g} in units of the extent), {remedy}"
    close = _nearest_pair(basis.points)
    pair = f"; centres {close[0]} and {close[1]} are only {close[2]:.1e} of the extent apart"
    warnings.warn(
        f"fit with kernel '{basis.kernel.name}' has condition {condition:.1e}: its conditions are met to a "
        f"few digits only ({dropped} of {basis.size} directions left out)"
        f"{pair if close[2] < 1e-5 else ''}; {remedy}",
        NumericalWarning,
        stacklevel=5,
    )


def _nearest_pair(points):
    if len(points) < 2:
        return 0, 0, math.inf
    distance, other = cKDTree(points).query(points, k=2)
    nearest = int(np.argmin(distance[:, 1]))
    return *sorted((nearest, int(other[nearest][distance[nearest].argmax()]))), float(distance[nearest, 1])


def raise_if_singular(basis):
    """Raise LinAlgError if centres coincide or the polynomials are dependent on them."""
    points, q = basis.points, len(basis.powers)
    first, second, apart = _nearest_pair(points)
    if apart < 1e-15:
        same = np.flatnonzero((np.abs(points - points[first]) < 1e-15).all(axis=1))
        first, second = (same[0], same[1]) if len(same) > 1 else (first, second)
        raise np.linalg.LinAlgError(
            f"singular fit: centres {first} and {second} coincide; remove duplicates (or use smoothing)"
        )
    if q and np.linalg.matrix_rank(basis.polynomials, tol=1e-9 * math.sqrt(basis.size)) < q:
        degree = int(basis.powers.sum(axis=1).max())
        flat = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        shape = "special (they lie on one surface of that degree)"
        if flat[1] < 1e-9 * max(flat[0], 1e-300):
            shape = "collinear"
        elif flat[2] < 1e-9 * flat[0]:
            shape = "coplanar"
        raise np.linalg.LinAlgError(
            f"singular fit: the {len(points)} centres are {shape}, so a polynomial of degree {degree} "
            f"({q} terms) is not determined; degree too high: lower it or use a kernel of lower order"
        )


def solve_least_squares(matrix, right, *, smoothing=0.0, cutoff=_CUTOFF):
    """Truncated SVD solution of an over- or undetermined system, with optional Tikhonov term.

    Parameters
    ----------
    matrix : (n, m) ndarray
    right : (n,) ndarray
    smoothing : float
        Adds smoothing * |x|^2 to the squared residual.
    cutoff : float
        Singular values below cutoff times the largest are dropped.

    Returns
    -------
    solution : (m,) ndarray
    condition : float
        Ratio of the extreme singular values.
    rank : int
    """
    left, values, back = linalg.svd(matrix, full_matrices=False, check_finite=False)
    keep = values > cutoff * values[0]
    filtered = values[keep] / (values[keep] ** 2 + smoothing)
    solution = back[keep].T @ (filtered * (left[:, keep].T @ right))
    return solution, float(values[0] / max(values[-1], np.finfo(float).tiny)), int(keep.sum())
