"""Solving RBF systems: one Cholesky factorisation, and what to do and say when it fails.

A conditionally positive definite matrix A with polynomial block P (q rows) is definite on the weights with
P w = 0. With Q an orthonormal basis of the rows of P (P^T = Q R) the augmented system

    [A  P^T] [w]   [y]
    [P   0 ] [b] = [0]

has w = M^-1 (I - Q Q^T) y with M = (I - Q Q^T) A (I - Q Q^T) + gamma Q Q^T, definite for any gamma > 0, and
R b = Q^T (y - A w). The condition of M is that of A on those weights, as gamma is the mean of the other eigenvalues;
adding a multiple of P^T P to A instead costs two digits at 2,000 centres.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.linalg import blas
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.assembly import Basis
from rbfmuscle.implicit.fit.lapack import factor_cholesky
from rbfmuscle.validation import NumericalWarning

DOUBTFUL = 1e13
"""Condition above which a fit is reported as doubtful, and a ridge takes part."""
KEPT = 1e12
"""Condition that this ridge keeps: with a greater one Cholesky may still fail."""
_DEPENDENT = 1e-9


def solve(basis: Basis, right: Floats, *, smoothing: float = 0.0) -> tuple[Floats, Floats, float]:
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
        Of the matrix on the weights that annihilate polynomials, 2-norm, by power iteration (a lower bound, usually
        within 10). Where it is beyond `DOUBTFUL` that number, and a ridge keeps it at `KEPT`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the system is singular; the message names the likely cause.

    Warns
    -----
    NumericalWarning
        Where a ridge was needed.
    """
    factor = factorise(_smoothed(basis, smoothing), basis.polynomials)
    if factor is not None:
        solution = factor.solve(right)
        if solution[2] < DOUBTFUL:
            return solution
    raise_if_singular(basis)
    weights, coefficients, _ = solve_bounded(basis, right, KEPT, smoothing=smoothing)
    _warn(basis)
    return weights, coefficients, DOUBTFUL


def solve_bounded(
    basis: Basis, right: Floats, condition: float, *, smoothing: float = 0.0
) -> tuple[Floats, Floats, float]:
    """Weights, polynomial coefficients and an estimate of the condition, which a ridge keeps below the given one.

    The ridge is the largest eigenvalue over the bound, with derivatives in units of the centres' spacing.

    Parameters
    ----------
    basis : Basis
    right : (size,) ndarray
    condition : float
        Bound [1]; the conditions of the fit are met to about one part in so many.
    smoothing : float
        As in `solve`.

    Returns
    -------
    weights : (size,) ndarray
    coefficients : (q,) ndarray
    condition : float
        Of the matrix with its ridge, in units of the spacing, on the weights that annihilate polynomials.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the system is singular, or the bound is more than floating-point numbers hold.
    """
    factor, scale = _factorise_bounded(basis, condition, smoothing)
    weights, coefficients, found = factor.solve(scale * right)
    return scale * weights, coefficients, min(found, condition)


def bounding_ridge(basis: Basis, condition: float) -> Floats:
    """What `solve_bounded` adds to the diagonal (size,) for this bound."""
    factor, scale = _factorise_bounded(basis, condition, 0.0)
    return np.asarray(factor.norm / condition / scale**2)


def _factorise_bounded(basis: Basis, condition: float, smoothing: float) -> tuple[Factor, Floats]:
    """Factor with a ridge, and the units (size,) of its unknowns."""
    # about the spacing of so many centres in the unit ball; a factor of three either way changes little
    count, unit = len(basis.points), 1.0 / math.sqrt(len(basis.points))
    matrix = _smoothed(basis, smoothing)
    with np.errstate(all="ignore"):  # the upper triangle, which is never read, holds anything
        matrix[count:, :count] *= unit
        matrix[count:, count:] *= unit**2
    scale = np.ones(basis.size)
    scale[count:] = unit
    factor = factorise(matrix, np.ascontiguousarray(basis.polynomials * scale), condition=condition)
    if factor is None:
        raise_if_singular(basis)
        raise np.linalg.LinAlgError(
            f"no Cholesky factor with a condition of {condition:g}; lower the bound or raise epsilon"
        )
    return factor, scale


@dataclass(frozen=True)
class Factor:
    """A factored matrix; letters as in the head of this file.

    Attributes
    ----------
    lower : (size, size) ndarray, Fortran order
        Cholesky factor of M; the upper triangle holds anything.
    gamma : float
    directions : (size, q) ndarray
        Q.
    triangle : (q, q) ndarray
        R.
    products : (size, q) ndarray
        A Q.
    norm : float
        Estimate of the largest eigenvalue of A.
    """

    lower: np.ndarray
    gamma: float
    directions: np.ndarray
    triangle: np.ndarray
    products: np.ndarray
    norm: float

    def solve(self, right: Floats) -> tuple[Floats, Floats, float]:
        """Weights (size,), coefficients (q,) and condition |A| |M^-1| for the right side (size,)."""
        # one by one: dpotrs takes three times as long for the two columns there are
        solution, weakest = (
            blas.dtrsv(self.lower, blas.dtrsv(self.lower, column, lower=1), lower=1, trans=1)
            for column in (self._project(right), probe(np.diagonal(self.lower)))
        )
        condition = max(1.0, self.norm * math.sqrt(weakest @ weakest))
        weights = self._project(solution)
        if not self.directions.shape[1]:
            return weights, np.zeros(0), condition
        short = self.directions.T @ right - self.products.T @ weights
        return weights, linalg.solve_triangular(self.triangle, short, check_finite=False), condition

    def _project(self, vector: Floats) -> Floats:
        """Its part that annihilates polynomials."""
        if not self.directions.shape[1]:
            return vector.copy()
        return vector - self.directions @ (self.directions.T @ vector)


def _smoothed(basis: Basis, smoothing: float) -> Floats:
    """The matrix of a basis with the smoothing on its diagonal."""
    matrix = basis.matrix()
    if smoothing:
        matrix.ravel(order="K")[:: basis.size + 1] += smoothing
    return matrix


def factorise(matrix: Floats, polynomials: Floats, *, condition: float = math.inf) -> Factor | None:
    """Factor of A on the weights that annihilate polynomials.

    Parameters
    ----------
    matrix : (size, size) ndarray
        A: lower triangle valid, Fortran order; overwritten.
    polynomials : (q, size) ndarray
    condition : float
        Bound: the largest eigenvalue on these weights, over the bound, is added to the diagonal, and is ``norm``.

    Returns
    -------
    Factor or None
        None where the matrix is not definite in floating-point numbers, or the polynomials are dependent.
    """
    q, size = polynomials.shape
    norm = largest_eigenvalue(size, lambda vector: blas.dsymv(1.0, matrix, vector, lower=1))
    gamma = 0.0
    directions, triangle, products = np.empty((size, 0)), np.empty((0, 0)), np.empty((size, 0))
    if q:
        directions, triangle = linalg.qr(polynomials.T, mode="economic", check_finite=False)
        if size < q or np.abs(np.diagonal(triangle)).min() < _DEPENDENT * math.sqrt(size):
            return None
        directions = np.asfortranarray(directions)
        products = blas.dsymm(1.0, matrix, directions, lower=1)
        # through SciPy's BLAS, as NumPy's has threads of its own, which then wait on the same cores
        inner = blas.dgemm(1.0, directions, products, trans_a=1)
        if size > q:
            gamma = (np.trace(matrix) - np.trace(inner)) / (size - q)
        gamma = gamma if gamma > 0 else norm or 1.0
        half = blas.dgemm(-0.5, directions, inner + gamma * np.eye(q), beta=1.0, c=products)
        matrix = blas.dsyr2k(-1.0, directions, half, beta=1.0, c=matrix, lower=1, overwrite_c=1)
    if math.isfinite(condition):  # a constant vector is all but a polynomial, which M has no share of
        start = probe(np.ones(size))
        norm = largest_eigenvalue(
            size, lambda vector: blas.dsymv(1.0, matrix, vector, lower=1), steps=6, start=start
        )
        matrix.ravel(order="K")[:: size + 1] += norm / condition
    if factor_cholesky(matrix):
        return None
    return Factor(matrix, gamma, directions, triangle, products, norm)


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


def _warn(basis: Basis) -> None:
    remedy = "spread the centres or add smoothing"
    if basis.kernel.has_epsilon:
        remedy = f"raise epsilon (it is {basis.epsilon:.2g} in units of the extent), {remedy}"
    close = _nearest_pair(basis.points)
    pair = f"; centres {close[0]} and {close[1]} are only {close[2]:.1e} of the extent apart"
    warnings.warn(
        f"fit with kernel '{basis.kernel.name}' has a condition beyond {DOUBTFUL:g}: a ridge keeps it at {KEPT:g} and "
        f"its conditions are met to a few digits only{pair if close[2] < 1e-5 else ''}; {remedy}",
        NumericalWarning,
        stacklevel=4,
    )


def _nearest_pair(points: Floats) -> tuple[int, int, float]:
    if len(points) < 2:
        return 0, 0, math.inf
    distance, other = cKDTree(points).query(points, k=2)
    nearest = int(np.argmin(distance[:, 1]))
    first, second = sorted((nearest, int(other[nearest][distance[nearest].argmax()])))
    return first, second, float(distance[nearest, 1])


def raise_if_singular(basis: Basis) -> None:
    """Raise LinAlgError if centres coincide or the polynomials are dependent on them."""
    points, q = basis.points, len(basis.powers)
    first, second, apart = _nearest_pair(points)
    if apart < 1e-15:
        same = np.flatnonzero((np.abs(points - points[first]) < 1e-15).all(axis=1))
        first, second = (same[0], same[1]) if len(same) > 1 else (first, second)
        raise np.linalg.LinAlgError(
            f"singular fit: centres {first} and {second} coincide; remove duplicates (or use smoothing)"
        )
    if q and np.linalg.matrix_rank(basis.polynomials, tol=_DEPENDENT * math.sqrt(basis.size)) < q:
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
