"""The field of a muscle that moved: its local fits made anew, and blended in the material.

A vertex of the shown mesh has its weights v_p on the local fits f_p from the muscle at rest, and
they stay with it: its field is F(x) = sum_p v_p f_p(x), with the gradient sum_p v_p grad f_p(x). So
a fit to another sheet that has come near has no part in it, and what the fits of a vertex are is
looked for once.

A fit solves A w + P^T b = y, P w = 0, as `rbfmuscle.implicit.fit.fitting` says, here for parts of
some centres each and without a ridge.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.evaluation import (
    NEAR,
    Terms,
    _closeness_loop,
    _cubic_block_loop,
    _general_block_loop,
    _shares_loop,
)
from rbfmuscle.implicit.fit.assembly import (
    _cubic_matrices_loop,
    _matrices_loop,
    _polynomials_loop,
)
from rbfmuscle.implicit.kernels.radial import Form
from rbfmuscle.jit import compiled

# Points of a block, which stays in the first-level cache.
BLOCK = 256
# Fits of less weight than this at a vertex are left out there.
LEAST_WEIGHT = 2e-2
# Numbers in a cache line.
LINE = 8
# Length of a polynomial's part that is new, below which it depends on those before it.
DEPENDENT = 1e-9


class Blend(NamedTuple):
    """Which points (n,) a fit counts at, and how much: those of fit p are ``point[start[p] :
    start[p + 1]]``.
    """

    start: np.ndarray  # (P + 1,)
    point: np.ndarray
    weight: np.ndarray

    def field(self, points: Floats, terms: Terms, form: Form | None) -> tuple[Floats, Floats]:
        """The blended field's values (n,) and gradients (n, 3) at the points (n, 3)."""
        value, gradient = np.empty(len(points)), np.empty((len(points), 3))
        blend_loop(points, terms, form, self, np.ones(len(points), np.bool_), value, gradient)
        return value, gradient


def material_blend(points: Floats, terms: Terms) -> Blend:
    """The weights of a field's local fits at points (n, 3) at rest, as `evaluate` weights them.

    v_p = (1 - t^2)^2 c_p, t the distance from the fit's middle in radii of its ball, and c_p the
    sum over the fit's centres of 1 / (distance^2 + soft^2)^4; the sum over p is one.
    """
    shares = np.zeros((len(terms.middle), len(points)))
    weights = np.ones_like(shares)
    if len(terms.middle) > 1:
        shares = _shares_loop(points, terms)[0]
        _weights_loop(points, terms, shares, weights)
        weights /= weights.sum(axis=0)
        weights[weights < LEAST_WEIGHT] = 0.0
        weights /= weights.sum(axis=0)
    fit, point = np.nonzero(weights)
    start = np.searchsorted(fit, np.arange(len(weights) + 1))
    return Blend(start, point, weights[fit, point])


@compiled
def _weights_loop(x, terms, shares, weights):
    """Weights (P, n) of the fits at points (n, 3), not normalised."""
    p, near = np.empty((3, len(x))), np.empty((4, len(x)))
    for fit in range(len(shares)):
        size = terms.scale[fit]
        for i in range(len(x)):
            for c in range(3):
                p[c, i] = (x[i, c] - terms.origin[fit, c]) / size
        near[:] = 0.0
        _closeness_loop(p, terms.centres[fit], NEAR * terms.radius[fit] / size, False, near)
        for i in range(len(x)):
            inside = max(1.0 - shares[fit, i], 0.0)
            weights[fit, i] = inside * inside * near[0, i] / size**8


@compiled
def blend_loop(x, terms, form, blend, todo, value, gradient):
    """The blended field's values and gradients at those of the points x (n, 3) that ``todo`` (n,)
    marks; form None is the cube with epsilon 1.
    """
    rows, weight = np.empty(BLOCK, np.int64), np.empty(BLOCK)
    for i in range(len(x)):
        if todo[i]:
            value[i] = 0.0
            gradient[i] = 0.0
    for fit in range(len(blend.start) - 1):
        at, end = blend.start[fit], blend.start[fit + 1]
        while at < end:
            count = 0
            while at < end and count < BLOCK:
                i = blend.point[at]
                if todo[i]:
                    rows[count] = i
                    weight[count] = blend.weight[at]
                    count += 1
                at += 1
            if count == 0:
                break
            size = (count + 7) // 8 * 8
            p = np.empty((3, size))
            acc = np.zeros(size)
            g = np.zeros((3, size))
            scale = terms.scale[fit]
            for n in range(size):
                i = rows[min(n, count - 1)]
                for c in range(3):
                    p[c, n] = (x[i, c] - terms.origin[fit, c]) / scale
            if form is None:
                _cubic_block_loop(terms, fit, True, p, acc, g)
            else:
                _general_block_loop(terms, fit, form, True, p, acc, g)
            for n in range(count):
                i = rows[n]
                value[i] += weight[n] * acc[n]
                for c in range(3):
                    gradient[i, c] += weight[n] * g[c, n] / scale


@compiled
def refit_loop(centres, normals, parts, terms, form, epsilon):
    """Hermite fits to parts (P, n) of centres (K, 3) that moved, with f = 0 and unit normals
    (K, 3), put into ``terms``.

    ``epsilon`` is the kernel's shape parameter [1 / length], 0 for one that has none; form is as in
    `blend_loop`. Returns an estimate of the worst condition, infinite where a matrix is not
    definite.
    """
    fits, count = parts.shape
    size = 4 * count
    width = (size + LINE - 1) // LINE * LINE
    a = np.zeros((1, size, width))
    polynomials = np.zeros((1, len(terms.powers), width))
    right, worst = np.empty(size), 1.0
    for fit in range(fits):
        _place_part(centres, parts[fit], terms, fit)
        if epsilon > 0.0:
            terms.epsilon[fit] = epsilon * terms.scale[fit]
        scale = terms.scale[fit]
        points = terms.centres[fit : fit + 1]
        shape = terms.epsilon[fit : fit + 1]
        if form is None:
            _cubic_matrices_loop(points, shape, 0, a)
        else:
            _matrices_loop(points, shape, form, True, 0, a)
        _polynomials_loop(points, terms.powers, polynomials[:, :, :size])
        for i in range(count):
            right[i] = 0.0
            for c in range(3):
                right[(c + 1) * count + i] = normals[parts[fit, i], c] * scale
        condition = _solve_part(a[0], polynomials[0], right, terms.coefficients[fit])
        if not condition < np.inf:
            return np.inf
        worst = max(worst, condition)
        for i in range(count):
            terms.a[fit, i] = right[i]
            for c in range(3):
                terms.b[fit, c, i] = right[(c + 1) * count + i]
    return worst


@compiled
def _place_part(centres, part, terms, fit):
    """Origin, scale, ball and scaled centres of a fit, as `Basis` has them."""
    for c in range(3):
        low, high = np.inf, -np.inf
        for j in part:
            low, high = min(low, centres[j, c]), max(high, centres[j, c])
        terms.origin[fit, c] = 0.5 * (low + high)
        terms.middle[fit, c] = centres[part[0], c]
    farthest, radius = 0.0, 0.0
    for j in part:
        square, away = 0.0, 0.0
        for c in range(3):
            square += (centres[j, c] - terms.origin[fit, c]) ** 2
            away += (centres[j, c] - terms.middle[fit, c]) ** 2
        farthest, radius = max(farthest, square), max(radius, away)
    scale = np.sqrt(farthest) if farthest > 0.0 else 1.0
    terms.scale[fit], terms.radius[fit] = scale, np.sqrt(radius)
    for i in range(len(part)):
        for c in range(3):
            terms.centres[fit, c, i] = (centres[part[i], c] - terms.origin[fit, c]) / scale


@compiled(fastmath={"contract", "reassoc"})
def _solve_part(a, polynomials, right, coefficients):
    """Weights (size,) in place of the right side, and the polynomial's coefficients (q,).

    ``a`` (size, w), whose rows end with zeros up to a whole cache line, and ``polynomials`` (q, w)
    are overwritten. With Q an orthonormal basis of the polynomials, M = (I - Q Q^T) A (I - Q Q^T) +
    gamma Q Q^T is factored. Returns an estimate of its condition, infinite where it is not
    definite.
    """
    q, size = len(polynomials), len(a)
    triangle, short = np.zeros((q, q)), np.empty(q)
    _orthonormalise(polynomials, size, triangle)
    product, norm = _project_matrix(a, polynomials)
    if not _factor(a):
        return np.inf
    most, least = 0.0, np.inf
    for i in range(size):
        most, least = max(most, a[i, i]), min(least, a[i, i])
    for k in range(q):
        short[k] = _leave_out(right, polynomials[k])
    _substitute(a, right)
    for k in range(q):
        _leave_out(right, polynomials[k])
    for k in range(q - 1, -1, -1):
        coefficients[k] = short[k]
        for i in range(size):
            coefficients[k] -= product[k, i] * right[i]
        for m in range(k + 1, q):
            coefficients[k] -= triangle[k, m] * coefficients[m]
        coefficients[k] = coefficients[k] / triangle[k, k] if triangle[k, k] > 0.0 else 0.0
    return (max(most, np.sqrt(norm)) / least) ** 2


@compiled(fastmath={"contract", "reassoc"})
def _project_matrix(a, polynomials):
    """Put M in place of A (size, w); its upper triangle counts.

    With P = A Q: M = A - Q H^T - H Q^T, H = P - Q (Q^T P - gamma I) / 2 , and gamma the mean of the
    rest of the diagonal. Returns P^T (q, w), and the greatest length of its rows.
    """
    q = len(polynomials)
    size = len(a)
    width = a.shape[1]
    product, inner = np.zeros((q, width)), np.zeros((q, q))
    trace, norm = 0.0, 0.0
    for i in range(size):
        trace += a[i, i]
    for k in range(q):
        _subtract_rows(product[k], 0, a, polynomials[k], size)
        for i in range(width):
            product[k, i] = -product[k, i]
    for k in range(q):
        norm = max(norm, np.sqrt(_dot(product[k], product[k])))
        for m in range(q):
            inner[k, m] = _dot(polynomials[k], product[m])
        trace -= inner[k, k]
    gamma = trace / max(size - q, 1)
    if not gamma > 0.0:
        gamma = norm if norm > 0.0 else 1.0
    both, shares = np.empty((2 * q, width)), np.empty(2 * q)
    for k in range(q):
        both[k], both[q + k] = polynomials[k], product[k]
        for m in range(q):
            inner[m, k] = 0.5 * (inner[m, k] + (gamma if k == m else 0.0))
    for k in range(q):
        _subtract_rows(both[q + k], 0, polynomials, inner[:, k], q)
    for i in range(size):
        for k in range(q):
            shares[k], shares[q + k] = both[q + k, i], both[k, i]
        _subtract_rows(a[i], i, both, shares, 2 * q)
    return product, norm


@compiled(fastmath={"contract", "reassoc"})
def _subtract_rows(row, start, rows, shares, count):
    """row -= sum of shares[k] * rows[k] over k < count, from the cache line of ``start`` on.

    Four rows at a time. Indices are unsigned, so that none is tested for counting from the end.
    """
    first, end = np.uint64(start - start % LINE), np.uint64(len(row))
    one, k = np.uint64(1), np.uint64(0)
    while k + np.uint64(3) < np.uint64(count):
        k1 = k + one
        k2 = k1 + one
        k3 = k2 + one
        p = shares[k]
        q = shares[k1]
        r = shares[k2]
        s = shares[k3]
        for j in range(first, end):
            row[j] -= p * rows[k, j] + q * rows[k1, j] + r * rows[k2, j] + s * rows[k3, j]
        k = k3 + one
    while k < np.uint64(count):
        p = shares[k]
        for j in range(first, end):
            row[j] -= p * rows[k, j]
        k += one


@compiled(fastmath={"contract", "reassoc"})
def _dot(one, other):
    total = 0.0
    for i in range(len(one)):
        total += one[i] * other[i]
    return total


@compiled(fastmath={"contract", "reassoc"})
def _leave_out(x, direction):
    """Take the part of x along a unit vector, which may be longer, out of x; how long it was."""
    share = 0.0
    for i in range(len(x)):
        share += x[i] * direction[i]
    for i in range(len(x)):
        x[i] -= share * direction[i]
    return share


@compiled(fastmath={"contract", "reassoc"})
def _orthonormalise(rows, size, triangle):
    """Gram-Schmidt, twice: P^T = Q R with the columns of Q in the rows (q, size and zeros) and R
    (q, q); rows that depend on others become zero.
    """
    for k in range(len(rows)):
        for _ in range(2):
            for m in range(k):
                triangle[m, k] += _leave_out(rows[k], rows[m])
        length = np.sqrt(_dot(rows[k], rows[k]))
        kept = length >= DEPENDENT * np.sqrt(size)
        triangle[k, k] = length if kept else 0.0
        for i in range(rows.shape[1]):
            rows[k, i] = rows[k, i] / length if kept else 0.0


@compiled(fastmath={"contract", "reassoc"})
def _factor(a):
    """Upper factor U, U^T U = A, in place of a symmetric matrix's upper triangle (size, w); whether
    it is definite. What stands left of the diagonal means nothing then.

    Rows are subtracted as in `_subtract_rows`, which costs half as much again when called from
    here.
    """
    one, end = np.uint64(1), np.uint64(a.shape[1])
    for i in range(np.uint64(len(a))):
        first, k = i - i % np.uint64(LINE), np.uint64(0)
        while k + np.uint64(3) < i:
            k1 = k + one
            k2 = k1 + one
            k3 = k2 + one
            p = a[k, i]
            q = a[k1, i]
            r = a[k2, i]
            s = a[k3, i]
            for j in range(first, end):
                a[i, j] -= p * a[k, j] + q * a[k1, j] + r * a[k2, j] + s * a[k3, j]
            k = k3 + one
        while k < i:
            p = a[k, i]
            for j in range(first, end):
                a[i, j] -= p * a[k, j]
            k += one
        if not a[i, i] > 0.0:
            return False
        p = 1.0 / np.sqrt(a[i, i])
        for j in range(first, end):
            a[i, j] *= p
    return True


@compiled(fastmath={"contract", "reassoc"})
def _substitute(upper, x):
    """Solve U^T U x = b in place."""
    one, size = np.uint64(1), np.uint64(len(x))
    for j in range(size):
        x[j] /= upper[j, j]
        share = x[j]
        for i in range(j + one, size):
            x[i] -= share * upper[j, i]
    for n in range(size):
        j = size - n - one
        total = 0.0
        for i in range(j + one, size):
            total += upper[j, i] * x[i]
        x[j] = (x[j] - total) / upper[j, j]
