"""Systems of RBF fits in scaled coordinates, and their solution: one Cholesky factorisation, and
what to do and say when it fails.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives, so that every
row of every block is one contiguous run.

A conditionally positive definite matrix A with polynomial block P (q rows) is definite on the
weights with P w = 0. With Q an orthonormal basis of the rows of P (P^T = Q R) the augmented system

    [A  P^T] [w]   [y]
    [P   0 ] [b] = [0]

has w = M^-1 (I - Q Q^T) y with M = (I - Q Q^T) A (I - Q Q^T) + gamma Q Q^T, definite for any gamma
> 0, and R b = Q^T (y - A w). The condition of M is that of A on those weights, as gamma is the mean
of the other eigenvalues; adding a multiple of P^T P to A instead costs two digits at 2,000 centres.
Where polynomials are dependent on the centres of a fit, as the second degree is on those of a flat
part, the rows of P that add nothing are left out.
"""

import math
import warnings

import numpy as np
from scipy.linalg import lapack
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.implicit.kernels import Kernel
from rbfmuscle.loops import loop
from rbfmuscle.validation import NumericalWarning, UsageError


def exponents(degree: int) -> Integers:
    """Exponents (q, 3) of the monomials of total degree up to ``degree``; (0, 3) for degree -1."""
    every = [power for power in np.ndindex(*[degree + 1] * 3) if sum(power) <= degree]
    every.sort(key=lambda power: (sum(power), *(-p for p in power)))
    return np.array(every, dtype=np.int64).reshape(-1, 3)


class Basis:
    """Centres, kernel and polynomials of P fits of n centres each, every one in coordinates scaled
    to order one.

    Of the caller's ``centres`` (K, 3), of which ``parts`` (P, n) says which each fit has, and
    epsilon [1 / length]: ``points`` (P, 3, n) are (x - ``origin``) / ``scale``, in the unit ball,
    and ``epsilon`` (P,) goes with them. The unknowns of a fit, ``size`` of them, are values at its
    centres, for a ``hermite`` one also all derivatives. ``polynomials`` (P, q, size) are the
    monomials of ``powers`` (q, 3) and their derivatives. LinAlgError for fewer values than
    polynomial terms.
    """

    def __init__(
        self,
        centres: Floats,
        kernel: Kernel,
        epsilon: float,
        *,
        hermite: bool = False,
        parts: Integers | None = None,
    ) -> None:
        if not len(centres):
            raise UsageError("a fit needs at least one point, got none")
        self.centres, self.parts = (
            centres,
            np.arange(len(centres))[None] if parts is None else parts,
        )
        points, (fits, count) = centres[self.parts], self.parts.shape
        self.origin = 0.5 * (points.min(axis=1) + points.max(axis=1))
        away = points - self.origin[:, None]
        self.scale = np.sqrt(np.einsum("pnc,pnc->pn", away, away).max(axis=1))
        self.scale[self.scale == 0.0] = 1.0
        self.points = np.ascontiguousarray(np.swapaxes(away / self.scale[:, None, None], 1, 2))
        self.kernel, self.hermite = kernel, hermite
        self.epsilon = epsilon * self.scale if kernel.has_epsilon else np.ones(fits)
        self.powers = exponents(kernel.degree)
        if not hermite and len(self.powers) > count:
            raise np.linalg.LinAlgError(
                f"degree {kernel.degree} of kernel '{kernel.name}' has {len(self.powers)} "
                "polynomial terms, more than "
                f"the {count} points; degree too high: use a kernel of lower order or add points"
            )
        self.size = 4 * count if hermite else count
        self.polynomials = _monomials(self.points, self.powers, hermite)

    def scaled(self) -> Floats:
        """All centres (K, 3) in the unit ball."""
        away = self.centres - 0.5 * (self.centres.min(axis=0) + self.centres.max(axis=0))
        return np.asarray(away / (np.sqrt((away**2).sum(axis=1).max()) or 1.0))

    def matrices(self, start: int, stop: int) -> Floats:
        """A of the fits from start to stop: (stop - start, size, size)."""
        points, epsilon = self.points[start:stop], self.epsilon[start:stop]
        fits, _, count = points.shape
        square = np.zeros((fits, count, count))
        for axis in range(3):
            square += (points[:, axis, :, None] - points[:, axis, None, :]) ** 2
        square *= epsilon[:, None, None] ** 2
        radial = self.kernel.radial(square, 3 if self.hermite else 1)
        if not self.hermite:
            return radial[0]
        out = np.empty((fits, self.size, self.size))
        _hermite_loop(points, epsilon, *radial, out)
        return out


def _monomials(points: Floats, powers: Integers, derivatives: bool) -> Floats:
    """Monomials (P, q, n) at points (P, 3, n), or with their derivatives by the three axes
    (P, q, 4n).
    """
    raised = np.ones((powers.max(initial=0) + 1, *points.shape))
    for power in range(1, len(raised)):
        raised[power] = raised[power - 1] * points

    def product(powers: Integers) -> Floats:
        x, y, z = (raised[powers[:, axis], :, axis] for axis in range(3))
        return np.swapaxes(x * y * z, 0, 1)

    parts = [product(powers)]
    for axis in range(3 if derivatives else 0):
        lower = powers.copy()
        lower[:, axis] = np.maximum(powers[:, axis] - 1, 0)
        parts.append(powers[:, axis, None] * product(lower))
    return np.concatenate(parts, axis=2)


@loop
def _hermite_loop(points, epsilon, phi, first, second, out):
    """Matrices (P, 4n, 4n) of fits to points (P, 3, n) from the radial functions (P, n, n).

    With d the way from centre j to i, blocks are (value, value) phi; (value, d/dx_c) first * d_c,
    as the other way round by the sign of d; (d/dx_e, d/dx_c) -(first * delta + second * d_c d_e).
    """
    n = points.shape[2]
    for p in range(len(points)):
        e2 = epsilon[p] ** 2
        for j in range(n):
            for i in range(n):
                out[p, j, i] = phi[p, j, i]
            for c in range(3):
                at = (c + 1) * n
                for i in range(n):
                    along = e2 * first[p, j, i] * (points[p, c, i] - points[p, c, j])
                    out[p, j, at + i] = along
                    out[p, at + j, i] = -along
                for e in range(3):
                    row = (e + 1) * n + j
                    for i in range(n):
                        way = points[p, c, i] - points[p, c, j]
                        other = points[p, e, i] - points[p, e, j]
                        out[p, row, at + i] = -e2 * e2 * second[p, j, i] * way * other
                for i in range(n):
                    out[p, at + j, at + i] -= e2 * first[p, j, i]


DOUBTFUL = 1e13
"""Condition above which a fit is reported as doubtful, and a ridge takes part."""
KEPT = 1e12
"""Condition that this ridge keeps: with a greater one Cholesky may still fail."""
_DEPENDENT = 1e-9  # norm of a polynomial beside the others, below which it depends on them
# Fits that are solved at a time, with what NumPy makes of them beside; fits below which a thread
# does not pay.
_CHUNK, _SERIAL = 64, 16


# Weights (P, size), coefficients (P, q) of the polynomials, and the conditions (P,) of P fits.
Fits = tuple[Floats, Floats, Floats]


def solve(
    basis: Basis, right: Floats, *, smoothing: float = 0.0, condition: float = math.inf
) -> tuple[Floats, Floats, float]:
    """Weights (P, size) and polynomial coefficients (P, q) for right sides (P, size), and the worst
    fit's condition.

    ``smoothing`` is added to the diagonal (scaled coordinates). ``condition`` is a bound [1]: a
    ridge of the largest eigenvalue over it, with derivatives in units of the centres' spacing,
    keeps it; the conditions of the fit are then met to about one part in so many.

    The condition is an estimate for the matrix on the weights that annihilate polynomials, 2-norm,
    from below and usually within 10. With a bound, of the matrix with its ridge in units of the
    spacing. Without one, where it is beyond `DOUBTFUL` that number, and a ridge keeps it at `KEPT`,
    with a NumericalWarning. LinAlgError if the system is singular (the message names the likely
    cause), or the bound is more than floating-point numbers hold.
    """
    bound = condition
    found = _solve_all(basis, right, smoothing, bound)
    if math.isinf(condition) and (found is None or not found[2].max() < DOUBTFUL):
        _raise_if_singular(basis)
        bound = KEPT
        found = _solve_all(basis, right, smoothing, bound)
    if found is None:
        _raise_if_singular(basis)
        message = (
            f"no Cholesky factor with a condition of {bound:g}; lower the bound or raise epsilon"
        )
        raise np.linalg.LinAlgError(message)
    weights, coefficients, conditions = found
    if bound != condition:
        _warn(basis)
        return weights, coefficients, DOUBTFUL
    return weights, coefficients, min(float(conditions.max()), condition)


def _solve_all(basis: Basis, right: Floats, smoothing: float, bound: float) -> Fits | None:
    """Solve with a ridge for this bound of the condition, infinity for none.

    None where a matrix is not definite in floating-point numbers, or the polynomials of a single
    fit are dependent.
    """
    fits, q, size = basis.polynomials.shape
    units = np.ones(size)
    if math.isfinite(bound):
        # Derivatives count in units of about the spacing of so many centres in the unit ball; a
        # factor of three changes little.
        count = basis.points.shape[2]
        units[count:] = 1.0 / math.sqrt(count)
    directions, inverse, complete = _orthonormal(basis.polynomials * units)
    if fits == 1 and not complete:
        return None
    weights = np.empty((fits, size))
    coefficients = np.empty((fits, q))
    conditions = np.empty(fits)

    def work(start: int, stop: int) -> None:
        for low in range(start, stop, _CHUNK):
            some = slice(low, min(low + _CHUNK, stop))
            a = basis.matrices(some.start, some.stop)
            if smoothing:
                a[:, np.arange(size), np.arange(size)] += smoothing
            if math.isfinite(bound):
                a *= units[:, None] * units
            given = directions[some], inverse[some], units * right[some]
            solved, coefficients[some], conditions[some] = _solve_some(a, *given, bound)
            weights[some] = solved * units

    try:
        in_chunks(fits, work, least=_SERIAL)
    except np.linalg.LinAlgError:
        return None
    return weights, coefficients, conditions


def _orthonormal(polynomials: Floats) -> tuple[Floats, Floats, bool]:
    """Q (P, size, q) and the inverse of R (P, q, q) for polynomials (P, q, size), and whether none
    are dependent.

    The columns of Q for those that are dependent on others are zero.
    """
    fits, q, size = polynomials.shape
    if not q:
        return np.zeros((fits, size, 0)), np.zeros((fits, 0, 0)), True
    tolerance = _DEPENDENT * math.sqrt(size)
    if size >= q:
        directions, triangle = np.linalg.qr(np.swapaxes(polynomials, 1, 2))
        if np.abs(np.diagonal(triangle, axis1=1, axis2=2)).min() >= tolerance:
            return directions, np.linalg.inv(triangle), True
    directions, values, turned = np.linalg.svd(np.swapaxes(polynomials, 1, 2), full_matrices=False)
    kept = values >= tolerance
    inverse = np.swapaxes(turned, 1, 2) * (kept / np.maximum(values, tolerance))[:, None]
    return directions * kept[:, None], inverse, False


def _solve_some(
    a: Floats, directions: Floats, inverse: Floats, right: Floats, bound: float
) -> tuple[Floats, Floats, Floats]:
    """The parts of `Fits` for matrices (m, size, size), which are overwritten; letters as in the
    head of this file. LinAlgError where a matrix is not definite.
    """
    size, q = directions.shape[1:]
    turned, products = np.ascontiguousarray(np.swapaxes(directions, 1, 2)), a @ directions
    if q:
        # The constants are all but the strongest direction.
        norm = np.sqrt(np.einsum("mnq,mnq->mq", products, products).max(axis=1))
        inner = turned @ products
        gamma = np.trace(a, axis1=1, axis2=2) - np.trace(inner, axis1=1, axis2=2)
        gamma = np.where(gamma > 0.0, gamma / max(size - q, 1), np.where(norm > 0.0, norm, 1.0))
        half = products - 0.5 * directions @ (inner + gamma[:, None, None] * np.eye(q))
        _subtract_loop(a, turned, np.ascontiguousarray(np.swapaxes(half, 1, 2)))
    else:
        norm = _largest(a, _probe(np.ones((len(a), size))), 2)
    if math.isfinite(bound):  # a constant vector is all but a polynomial, which M has no share of
        norm = _largest(a, _probe(np.ones((len(a), size))), 6)
        a[:, np.arange(size), np.arange(size)] += (norm / bound)[:, None]

    def annihilating(vectors: Floats) -> Floats:
        return np.asarray(vectors - (directions @ (turned @ vectors[:, :, None]))[:, :, 0])

    solved = np.stack([annihilating(right), np.zeros_like(right)], axis=1)
    for matrix in a:
        # Upper factors U, A = U^T U, replace the upper triangles. The transpose is the same matrix
        # in Fortran's order, whose lower factor is U^T.
        _, failed = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1, clean=0)
        if failed:
            raise np.linalg.LinAlgError("the matrix is not definite")
    solved[:, 1] = _probe(np.diagonal(a, axis1=1, axis2=2))
    for matrix, both in zip(a, solved):
        lapack.dpotrs(matrix.T, both.T, lower=1, overwrite_b=1)  # in place
    weights = annihilating(solved[:, 0])
    short = turned @ right[:, :, None] - np.swapaxes(products, 1, 2) @ weights[:, :, None]
    condition = np.maximum(1.0, norm * np.linalg.norm(solved[:, 1], axis=1))
    return weights, (inverse @ short)[:, :, 0], condition


def _largest(matrices: Floats, vectors: Floats, steps: int) -> Floats:
    """Largest eigenvalues (m,) of symmetric matrices by power iteration from vectors (m, size),
    lower bounds.
    """
    for _ in range(steps):
        size = np.linalg.norm(vectors, axis=1, keepdims=True)
        vectors = (matrices @ (vectors / np.where(size > 0.0, size, 1.0))[:, :, None])[:, :, 0]
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _probe(pivots: Floats) -> Floats:
    """Vectors (m, size) of random signs and the smallest pivot's unit vector: some of the weakest
    direction each.
    """
    count, size = pivots.shape
    signs = np.where((np.arange(size) * 0x9E3779B1) >> 7 & 1, 1.0, -1.0) / math.sqrt(2 * size)
    found, weakest = np.tile(signs, (count, 1)), np.argmin(pivots, axis=1)
    found[np.arange(count), weakest] += np.copysign(math.sqrt(0.5), signs[weakest])
    return found


@loop(fastmath={"contract"})
def _subtract_loop(a, directions, half):
    """Subtract Q^T H + H^T Q from matrices (m, size, size), with Q and H (m, q, size)."""
    size = a.shape[1]
    for p in range(len(a)):
        for i in range(size):
            for k in range(directions.shape[1]):
                one, other = directions[p, k, i], half[p, k, i]
                for j in range(size):
                    a[p, i, j] -= one * half[p, k, j] + other * directions[p, k, j]


def _warn(basis: Basis) -> None:
    remedy = "spread the centres or add smoothing"
    if basis.kernel.has_epsilon:
        remedy = f"raise epsilon (it is {basis.epsilon.max():.2g} in units of the extent), {remedy}"
    first, second, apart = _nearest_pair(basis.scaled())
    pair = f"; centres {first} and {second} are only {apart:.1e} of the extent apart"
    warnings.warn(
        f"fit with kernel '{basis.kernel.name}' has a condition beyond {DOUBTFUL:g}: a ridge "
        f"keeps it at {KEPT:g} and "
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
    points, q = basis.scaled(), len(basis.powers)
    first, second, apart = _nearest_pair(points)
    if apart < 1e-15:
        same = np.flatnonzero((np.abs(points - points[first]) < 1e-15).all(axis=1))
        first, second = (same[0], same[1]) if len(same) > 1 else (first, second)
        pair = f"centres {first} and {second} coincide"
        raise np.linalg.LinAlgError(f"singular fit: {pair}; remove duplicates (or use smoothing)")
    tolerance = _DEPENDENT * math.sqrt(basis.size)
    if (
        q
        and len(basis.parts) == 1
        and np.linalg.matrix_rank(basis.polynomials[0], tol=tolerance) < q
    ):
        degree = int(basis.powers.sum(axis=1).max())
        flat = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        shape = "special (they lie on one surface of that degree)"
        if flat[1] < 1e-9 * max(flat[0], 1e-300):
            shape = "collinear"
        elif flat[2] < 1e-9 * flat[0]:
            shape = "coplanar"
        raise np.linalg.LinAlgError(
            f"singular fit: the {len(points)} centres are {shape}, so a polynomial of degree "
            f"{degree} "
            f"({q} terms) is not determined; degree too high: lower it or use a kernel of "
            "lower order"
        )
