"""Solving RBF systems: one Cholesky factorisation, and what to do and say when it fails.

A conditionally positive definite matrix A with polynomial block P (q rows) is definite on the weights with
P w = 0. With Q an orthonormal basis of the rows of P (P^T = Q R) the augmented system

    [A  P^T] [w]   [y]
    [P   0 ] [b] = [0]

has w = M^-1 (I - Q Q^T) y with M = (I - Q Q^T) A (I - Q Q^T) + gamma Q Q^T, definite for any gamma > 0, and
R b = Q^T (y - A w). The condition of M is that of A on those weights, as gamma is the mean of the other eigenvalues;
adding a multiple of P^T P to A instead costs two digits at 2,000 centres.
"""

import ctypes
import math
import warnings
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.linalg import blas
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.assembly import Basis
from rbfmuscle.validation import NumericalWarning

DOUBTFUL = 1e13
"""Condition above which a fit is reported as doubtful, and a ridge takes part."""
KEPT = 1e12
"""Condition that this ridge keeps: with a greater one Cholesky may still fail."""
_DEPENDENT = 1e-9


def solve(
    basis: Basis, right: Floats, *, smoothing: float = 0.0, condition: float = math.inf
) -> tuple[Floats, Floats, float]:
    """Weights (size,), polynomial coefficients (q,) and an estimate of the condition, for a right side (size,).

    ``smoothing`` is added to the diagonal (scaled coordinates). ``condition`` is a bound [1]: a ridge of the largest
    eigenvalue over it, with derivatives in units of the centres' spacing, keeps it; the conditions of the fit are then
    met to about one part in so many.

    The estimate is that of the matrix on the weights that annihilate polynomials, 2-norm, by power iteration (a lower
    bound, usually within 10). With a bound, of the matrix with its ridge in units of the spacing. Without one, where it
    is beyond `DOUBTFUL` that number, and a ridge keeps it at `KEPT`, with a NumericalWarning. LinAlgError if the system
    is singular (the message names the likely cause), or the bound is more than floating-point numbers hold.
    """
    bound = condition
    if math.isinf(bound):
        factor = _factorise(_smoothed(basis, smoothing), basis.polynomials)
        solution = None if factor is None else factor.solve(right)
        if solution is not None and solution[2] < DOUBTFUL:
            return solution
        _raise_if_singular(basis)
        bound = KEPT
    factor, scale = _factorise_bounded(basis, bound, smoothing)
    weights, coefficients, found = factor.solve(scale * right)
    if math.isinf(condition):
        _warn(basis)
        return scale * weights, coefficients, DOUBTFUL
    return scale * weights, coefficients, min(found, condition)


def bounding_ridge(basis: Basis, condition: float) -> Floats:
    """What `solve` adds to the diagonal (size,) for this bound of the condition."""
    factor, scale = _factorise_bounded(basis, condition, 0.0)
    return np.asarray(factor.norm / condition / scale**2)


def _factorise_bounded(basis: Basis, condition: float, smoothing: float) -> "tuple[Factor, Floats]":
    """Factor with a ridge, and the units (size,) of its unknowns."""
    # about the spacing of so many centres in the unit ball; a factor of three either way changes little
    count, unit = len(basis.points), 1.0 / math.sqrt(len(basis.points))
    matrix = _smoothed(basis, smoothing)
    with np.errstate(all="ignore"):  # the upper triangle, which is never read, holds anything
        matrix[count:, :count] *= unit
        matrix[count:, count:] *= unit**2
    scale = np.ones(basis.size)
    scale[count:] = unit
    factor = _factorise(matrix, np.ascontiguousarray(basis.polynomials * scale), condition)
    if factor is None:
        _raise_if_singular(basis)
        message = f"no Cholesky factor with a condition of {condition:g}; lower the bound or raise epsilon"
        raise np.linalg.LinAlgError(message)
    return factor, scale


class Factor(NamedTuple):
    """A factored matrix; letters as in the head of this file.

    ``lower`` is the Cholesky factor of M (size, size), its upper triangle anything; ``directions`` Q (size, q),
    ``triangle`` R (q, q), ``products`` A Q (size, q), ``norm`` an estimate of the largest eigenvalue of A.
    """

    lower: Floats
    directions: Floats
    triangle: Floats
    products: Floats
    norm: float

    def solve(self, right: Floats) -> tuple[Floats, Floats, float]:
        """Weights (size,), coefficients (q,) and condition |A| |M^-1| for the right side (size,)."""
        # one by one: dpotrs takes three times as long for the two columns there are
        solution, weakest = (
            blas.dtrsv(self.lower, blas.dtrsv(self.lower, column, lower=1), lower=1, trans=1)
            for column in (self._project(right), _probe(np.diagonal(self.lower)))
        )
        condition = max(1.0, self.norm * math.sqrt(weakest @ weakest))
        weights = self._project(solution)
        if not self.directions.shape[1]:
            return weights, np.zeros(0), condition
        short = self.directions.T @ right - self.products.T @ weights
        return weights, blas.dtrsv(self.triangle, short), condition

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


def _factorise(matrix: Floats, polynomials: Floats, condition: float = math.inf) -> "Factor | None":
    """Factor of A (size, size), lower triangle valid, Fortran order, overwritten; polynomials (q, size).

    The largest eigenvalue, ``norm``, over the bound of the condition is added to the diagonal. None where the matrix is
    not definite in floating-point numbers, or the polynomials are dependent.
    """
    q, size = polynomials.shape
    start = np.ones(size)
    start[1::2] -= 1e-3
    norm = _largest_eigenvalue(matrix, start, 2)
    directions, triangle, products = np.empty((size, 0)), np.empty((0, 0)), np.empty((size, 0))
    if q:
        directions, triangle = linalg.qr(polynomials.T, mode="economic", check_finite=False)
        if size < q or np.abs(np.diagonal(triangle)).min() < _DEPENDENT * math.sqrt(size):
            return None
        directions = np.asfortranarray(directions)
        # column by column: dsymm takes twice as long for so few
        products = np.array([blas.dsymv(1.0, matrix, column, lower=1) for column in directions.T]).T
        # through SciPy's BLAS, as NumPy's has threads of its own, which then wait on the same cores
        inner = blas.dgemm(1.0, directions, products, trans_a=1)
        gamma = (np.trace(matrix) - np.trace(inner)) / (size - q) if size > q else 0.0
        gamma = gamma if gamma > 0 else norm or 1.0
        half = blas.dgemm(-0.5, directions, inner + gamma * np.eye(q), beta=1.0, c=products)
        matrix = blas.dsyr2k(-1.0, directions, half, beta=1.0, c=matrix, lower=1, overwrite_c=1)
    if math.isfinite(condition):  # a constant vector is all but a polynomial, which M has no share of
        norm = _largest_eigenvalue(matrix, _probe(np.ones(size)), 6)
        matrix.ravel(order="K")[:: size + 1] += norm / condition
    if factor_cholesky(matrix):
        return None
    return Factor(matrix, directions, triangle, products, norm)


def _largest_eigenvalue(matrix: Floats, vector: Floats, steps: int) -> float:
    """Largest eigenvalue of a symmetric matrix by power iteration from a vector (size,), a lower bound."""
    norm = 0.0
    for _ in range(steps):
        vector = blas.dsymv(1.0, matrix, vector / math.sqrt(vector @ vector), lower=1)
        norm = math.sqrt(vector @ vector)
        if norm == 0.0:  # one centre of a kernel that is 0 there
            break
    return norm


def _probe(pivots: Floats) -> Floats:
    """Vector (size,) of random signs and the smallest pivot's unit vector: it holds some of the weakest eigenvector."""
    size = len(pivots)
    signs = np.where((np.arange(size) * 0x9E3779B1) >> 7 & 1, 1.0, -1.0) / math.sqrt(2 * size)
    weakest = int(np.argmin(pivots))
    signs[weakest] += math.copysign(math.sqrt(0.5), signs[weakest])
    return signs


def _warn(basis: Basis) -> None:
    remedy = "spread the centres or add smoothing"
    if basis.kernel.has_epsilon:
        remedy = f"raise epsilon (it is {basis.epsilon:.2g} in units of the extent), {remedy}"
    first, second, apart = _nearest_pair(basis.points)
    pair = f"; centres {first} and {second} are only {apart:.1e} of the extent apart"
    warnings.warn(
        f"fit with kernel '{basis.kernel.name}' has a condition beyond {DOUBTFUL:g}: a ridge keeps it at {KEPT:g} and "
        f"its conditions are met to a few digits only{pair if apart < 1e-5 else ''}; {remedy}",
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


def _raise_if_singular(basis: Basis) -> None:
    """Raise LinAlgError if centres coincide or the polynomials are dependent on them."""
    points, q = basis.points, len(basis.powers)
    first, second, apart = _nearest_pair(points)
    if apart < 1e-15:
        same = np.flatnonzero((np.abs(points - points[first]) < 1e-15).all(axis=1))
        first, second = (same[0], same[1]) if len(same) > 1 else (first, second)
        pair = f"centres {first} and {second} coincide"
        raise np.linalg.LinAlgError(f"singular fit: {pair}; remove duplicates (or use smoothing)")
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


@cache
def _dpotrf() -> Callable[..., None]:
    from numba.extending import get_cython_function_address

    address = get_cython_function_address("scipy.linalg.cython_lapack", "dpotrf")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5)(address)


def factor_cholesky(matrix: Floats) -> int:
    """Put the Cholesky factor in the lower triangle of a Fortran-ordered matrix; 0, or the first minor that fails."""
    if matrix.dtype != np.float64 or not matrix.flags.f_contiguous or matrix.ndim != 2:
        raise ValueError("LAPACK needs a two-dimensional float64 array in Fortran order")
    lower, size, failed = ctypes.c_char(b"L"), ctypes.c_int(len(matrix)), ctypes.c_int(0)
    order = ctypes.byref(size)
    _dpotrf()(ctypes.byref(lower), order, matrix.ctypes.data, order, ctypes.byref(failed))
    return failed.value
