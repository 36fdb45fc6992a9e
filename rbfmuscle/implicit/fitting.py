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

Local fits with the cubic kernel, whose polynomial is linear, have a loop of their own
(`_cubic_loop`): there value and gradient at the first centre stand for the polynomial. With T the
values and derivatives of linear functions at the other centres by those at the first, and U the
rows of A between the first and the others, weights z of the others with -T^T z at the first
annihilate the polynomials, and

    (A - T U - (T U)^T) z = y - T y_0

with A and y of the other centres; the block of A for the first centre alone is zero.
"""

import math
import warnings
from functools import cached_property

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
        fits, count = self.parts.shape
        # Axes first, as NumPy takes ten times as long along rows of three.
        away = np.ascontiguousarray(centres.T)[:, self.parts]
        origin = 0.5 * (away.min(axis=2) + away.max(axis=2))
        away -= origin[:, :, None]
        self.origin = np.ascontiguousarray(origin.T)
        self.scale = np.sqrt((away[0] ** 2 + away[1] ** 2 + away[2] ** 2).max(axis=1))
        self.scale[self.scale == 0.0] = 1.0
        away /= self.scale[:, None]
        self.points = np.ascontiguousarray(np.swapaxes(away, 0, 1))
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

    @cached_property
    def polynomials(self) -> Floats:
        """The monomials at the centres, and their derivatives, (P, q, size)."""
        return _monomials(self.points, self.powers, self.hermite)

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
# Rows of a matrix that are eliminated at a time; values and derivatives of a centre are as many.
PANEL = 4


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
    found = None
    if basis.hermite and basis.kernel.plain_cube and len(basis.parts) > 1 and not smoothing:
        found = _solve_cubic(basis, right) if math.isinf(condition) else None
    if found is None or not found[2].max() < DOUBTFUL:
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


def _solve_cubic(basis: Basis, right: Floats) -> Fits | None:
    """`_solve_all` of local fits with the cubic kernel, without smoothing or bound."""
    fits, _, count = basis.points.shape
    weights = np.empty((fits, 4, count))
    coefficients = np.empty((fits, 4))
    conditions = np.empty(fits)
    given = basis.points, right.reshape(weights.shape), weights, coefficients, conditions

    def work(start: int, stop: int) -> None:
        _cubic_loop(*(part[start:stop] for part in given))

    in_chunks(fits, work, least=_SERIAL)
    if not np.isfinite(conditions).all():
        return None
    return weights.reshape(fits, -1), coefficients, conditions


@loop(fastmath={"contract", "reassoc"})
def _cubic_loop(points, right, weights, coefficients, conditions):
    """Weights (P, 4, n), coefficients (P, 4) and conditions (P,) of cubic fits to points (P, 3, n)
    with right sides (P, 4, n); the condition is infinite where a matrix is not definite.
    """
    others = points.shape[2] - 1
    size = 4 * others
    way = np.empty((3, others))
    first = np.empty((4, 4, others))
    blocks = np.zeros((4, others, 4, others))
    matrix = blocks.reshape(size, size)
    panel = np.empty((PANEL, size))
    sides = np.empty((2, 4, others))
    solved = sides.reshape(2, size)
    signs = np.empty(size)
    for i in range(size):
        signs[i] = (1.0 if i * 0x9E3779B1 >> 7 & 1 else -1.0) / np.sqrt(2.0 * size)
    for p in range(len(points)):
        for c in range(3):
            for i in range(others):
                way[c, i] = points[p, c, 1 + i] - points[p, c, 0]
        largest = _fill_reduced(way, first, blocks)
        weakest = _factorise(matrix, panel)
        if weakest < 0:
            conditions[p] = np.inf
            continue
        for i in range(others):
            sides[0, 0, i] = right[p, 0, 1 + i] - right[p, 0, 0]
            for c in range(3):
                sides[0, 0, i] -= way[c, i] * right[p, 1 + c, 0]
                sides[0, 1 + c, i] = right[p, 1 + c, 1 + i] - right[p, 1 + c, 0]
        # As `_probe` has it.
        solved[1] = signs
        solved[1, weakest] += np.copysign(np.sqrt(0.5), signs[weakest])
        for k in range(2):
            _substitute(matrix, solved[k])
        _complete(way, sides[1], weights[p])
        conditions[p] = max(1.0, largest * np.sqrt((weights[p] ** 2).sum()))
        _complete(way, sides[0], weights[p])
        for e in range(4):
            coefficients[p, e] = right[p, e, 0]
            for c in range(4):
                for i in range(others):
                    coefficients[p, e] -= first[e, c, i] * sides[0, c, i]
        for c in range(3):
            coefficients[p, 0] -= coefficients[p, 1 + c] * points[p, c, 0]


@loop
def _complete(way, others, weights):
    """Weights (4, n) that annihilate linear functions, from those (4, m) of all centres but the
    first.
    """
    weights[:, 1:] = others
    for c in range(4):
        weights[c, 0] = -others[c].sum()
    for c in range(3):
        weights[1 + c, 0] -= (way[c] * others[0]).sum()


@loop(fastmath={"contract", "reassoc"})
def _fill_reduced(way, first, blocks):
    """The matrix of all centres but the first, which lie by ``way`` (3, m) from that, as ``blocks``
    (4, m, 4, m) of values and derivatives; U as ``first`` (4, 4, m).

    Only the upper triangle is filled. Returns the length of A q for the unit vector q of the
    constants, about the largest eigenvalue of A.
    """
    count = way.shape[1]
    total = np.zeros((4, 1 + count))
    for i in range(count):
        u = way[0, i] ** 2 + way[1, i] ** 2 + way[2, i] ** 2
        r = np.sqrt(u)
        first[0, 0, i] = r * u
        for c in range(3):
            first[0, 1 + c, i] = 3.0 * r * way[c, i]
            first[1 + c, 0, i] = -3.0 * r * way[c, i]
            for e in range(3):
                first[1 + e, 1 + c, i] = -3.0 / (r + 1e-300) * way[e, i] * way[c, i]
            first[1 + c, 1 + c, i] -= 3.0 * r
        for e in range(4):
            total[e, 0] += first[e, 0, i]
            total[e, 1 + i] = first[0, e, i]
    for i in range(count):
        for j in range(count):
            x = way[0, j] - way[0, i]
            y = way[1, j] - way[1, i]
            z = way[2, j] - way[2, i]
            u = x * x + y * y + z * z
            r = np.sqrt(u)
            r3 = 3.0 * r
            q = -3.0 / (r + 1e-300)
            blocks[0, i, 0, j] = r * u
            blocks[0, i, 1, j] = r3 * x
            blocks[0, i, 2, j] = r3 * y
            blocks[0, i, 3, j] = r3 * z
            blocks[1, i, 1, j] = q * x * x - r3
            blocks[1, i, 2, j] = q * x * y
            blocks[1, i, 3, j] = q * x * z
            blocks[2, i, 2, j] = q * y * y - r3
            blocks[2, i, 3, j] = q * y * z
            blocks[3, i, 3, j] = q * z * z - r3
        for j in range(count):
            total[0, 1 + i] += blocks[0, i, 0, j]
            for c in range(3):
                total[1 + c, 1 + i] -= blocks[0, i, 1 + c, j]
        for e in range(4):
            for c in range(e, 4):
                for j in range(count):
                    blocks[e, i, c, j] -= first[e, c, j] + first[c, e, i]
        for c in range(4):
            for j in range(count):
                for k in range(3):
                    blocks[0, i, c, j] -= way[k, i] * first[1 + k, c, j]
        for j in range(count):
            for k in range(3):
                blocks[0, i, 0, j] -= way[k, j] * first[1 + k, 0, i]
    square = 0.0
    for e in range(4):
        for i in range(1 + count):
            square += total[e, i] ** 2
    return np.sqrt(square / (1 + count))


@loop(fastmath={"contract", "reassoc"})
def _factorise(matrix, panel):
    """Replace a matrix, of which the upper triangle is read, by its upper Cholesky factor U, U^T U,
    with zeros below; the row of the least pivot, -1 where the matrix is not definite.

    Rows are eliminated `PANEL` at a time, which must divide their number, and whole, so that loops
    become vector code: no slower than LAPACK for the few dozen rows of a local fit.
    """
    size = len(matrix)
    weakest = 0
    for low in range(0, size, PANEL):
        for r in range(PANEL):
            row = low + r
            if not matrix[row, row] > 0.0:
                return -1
            share = 1.0 / np.sqrt(matrix[row, row])
            for j in range(size):
                panel[r, j] = share * matrix[row, j] if j >= row else 0.0
            for i in range(r + 1, PANEL):
                factor = panel[r, low + i]
                for j in range(size):
                    matrix[low + i, j] -= factor * panel[r, j]
            for j in range(size):
                matrix[row, j] = panel[r, j]
            if matrix[row, row] < matrix[weakest, weakest]:
                weakest = row
        for i in range(low + PANEL, size):
            a, b, c, d = panel[0, i], panel[1, i], panel[2, i], panel[3, i]
            for j in range(size):
                matrix[i, j] -= (
                    a * panel[0, j] + b * panel[1, j] + c * panel[2, j] + d * panel[3, j]
                )
    return weakest


@loop(fastmath={"contract", "reassoc"})
def _substitute(factor, side):
    """Solve U^T U x = b in place, with zeros below the diagonal of U."""
    size = len(factor)
    for row in range(size):
        value = side[row] / factor[row, row]
        for j in range(size):
            side[j] -= value * factor[row, j]
        side[row] = value
    for row in range(size - 1, -1, -1):
        value = side[row]
        side[row] = 0.0
        total = 0.0
        for j in range(size):
            total += factor[row, j] * side[j]
        side[row] = (value - total) / factor[row, row]


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
