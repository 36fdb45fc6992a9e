"""Values and gradients of an RBF field at many points.

Points are handled in blocks that stay in the first-level cache; inner loops run over a block.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.jit import compiled

# Points of a block, and pairs of points and centres below which a thread does not pay.
_BLOCK, _SERIAL = 256, 200_000
_CHUNK = 4096  # points that are sorted into fits at a time
# Beyond this share of the radius of every ball, all grow until the point lies there in the nearest.
RIM = 0.95
NEAR = 0.15  # how close to a centre its closeness levels off, in radii of the fit's ball


class Terms(NamedTuple):
    """A field of P local fits of n centres each, as the loops read it.

    In the coordinates of a fit, (points - origin) / scale with ``origin`` (P, 3) and ``scale``
    (P,): ``centres`` (P, 3, n); ``a`` (P, n) and ``b`` (P, 3, n) are the weights of the values and
    of the derivatives, which count where ``hermite``; ``epsilon`` (P,); ``coefficients`` (P, q) and
    ``powers`` (q, 3) are the polynomial's. A fit counts in a ball, in the caller's coordinates,
    with ``middle`` (P, 3) and ``radius`` (P,); a single fit counts everywhere.
    """

    origin: np.ndarray
    scale: np.ndarray
    centres: np.ndarray
    a: np.ndarray
    b: np.ndarray
    hermite: bool
    epsilon: np.ndarray
    coefficients: np.ndarray
    powers: np.ndarray
    middle: np.ndarray
    radius: np.ndarray


class Lots(NamedTuple):
    """Where n points lie in the balls of P fits, which grow until they are met, and sums."""

    shares: np.ndarray  # (P, n) squared distances from the middles over squared radii, 0 for one
    growth: np.ndarray  # (4, n) what the squares grew by, derivatives of half its logarithm
    total: np.ndarray  # (8, n) sums


def evaluate(
    points: Floats, terms: Terms, kernel: Kernel, with_gradient: bool
) -> tuple[Floats, Floats]:
    """A field's values (n,) at points (n, 3), and its gradients (n, 3) by these, which are empty
    where not wanted.
    """
    count = len(points)
    value, gradient = np.empty(count), np.empty((count if with_gradient else 0, 3))
    form = None if kernel.plain_cube and bool((terms.epsilon == 1.0).all()) else kernel.form

    def work(start: int, stop: int) -> None:
        _evaluate_loop(points, terms, form, start, stop, value, gradient)

    in_chunks(count, work, least=max(_BLOCK, _SERIAL // terms.centres.shape[2]))
    return value, gradient


# The length of a block is a multiple of a cache line, so that all rows are contiguous and filled
# alike. The cubic kernel has a loop of its own; without a form nothing else is compiled, so that
# muscles need not wait for the others.


@compiled
def _evaluate_loop(points, terms, form, start, stop, value, gradient):
    """Value and, where there is room for it, gradient at points[start:stop]; form None is the cube
    with epsilon 1.
    """
    wanted, rows = len(gradient) > 0, np.empty(_BLOCK, np.int64)
    for low in range(start, stop, _CHUNK):
        x = points[low : min(low + _CHUNK, stop)]
        lots = _shares_loop(x, terms)
        for fit in range(len(lots.shares)):
            first = np.int64(0)  # the type that `_fill_block` returns, so that it is compiled once
            while first < len(x):
                first, p, acc, g = _fill_block(x, terms, fit, lots.shares, first, rows)
                if p.shape[1] == 0:  # no point in this fit
                    continue
                if form is None:
                    _cubic_block_loop(terms, fit, wanted, p, acc, g)
                else:
                    _general_block_loop(terms, fit, form, wanted, p, acc, g)
                _blend_loop(x, terms, fit, rows, lots, wanted, (p, acc, g))
        _give_loop(low, lots.total, value, gradient)


@compiled
def _shares_loop(x, terms):
    """Where points (n, 3) lie in the balls of the fits."""
    fits, n = len(terms.middle), len(x)
    shares, growth = np.zeros((fits, n)), np.zeros((4, n))
    growth[0] = 1.0
    if fits > 1:
        for k in range(fits):
            (a, b, c), scale = terms.middle[k], 1.0 / terms.radius[k] ** 2
            for i in range(n):
                square = (x[i, 0] - a) ** 2 + (x[i, 1] - b) ** 2 + (x[i, 2] - c) ** 2
                shares[k, i] = scale * square
        for i in range(n):
            nearest = 0
            for k in range(fits):
                nearest = k if shares[k, i] < shares[nearest, i] else nearest
            least = shares[nearest, i]
            if least > RIM * RIM:
                growth[0, i] = RIM * RIM / least
                for k in range(fits):
                    shares[k, i] *= growth[0, i]
                for c in range(3):
                    way = terms.middle[nearest, c] - x[i, c]
                    growth[1 + c, i] = way / (least * terms.radius[nearest] ** 2)
    return Lots(shares, growth, np.zeros((8, n)))


@compiled
def _fill_block(x, terms, fit, shares, first, rows):
    """The next points that lie in a fit's ball, from the first on: where to go on, and these in the
    fit's coordinates.

    Their numbers are put into ``rows`` (`_BLOCK`,), -1 after the last; the points are (3, m), the
    last repeated, and zeros (m,) and (3, m) to add to.
    """
    count = 0
    while first < len(x) and count < _BLOCK:
        if shares[fit, first] < 1.0:
            rows[count] = first
            count += 1
        first += 1
    size = (count + 7) // 8 * 8
    p = np.empty((3, size))
    for i in range(size):
        row = rows[min(i, count - 1)]
        for c in range(3):
            p[c, i] = (x[row, c] - terms.origin[fit, c]) / terms.scale[fit]
    if count < _BLOCK:
        rows[count] = -1
    return first, p, np.zeros(size), np.zeros((3, size))


@compiled(fastmath={"contract"})
def _closeness_loop(p, centres, soft, gradient, out):
    """Add the sum over a fit's centres of 1 / (distance^2 + soft^2)^4 at points (3, m), and its
    gradient, to (4, m).
    """
    for j in range(centres.shape[1]):
        cx = centres[0, j]
        cy = centres[1, j]
        cz = centres[2, j]
        for i in range(p.shape[1]):
            dx = p[0, i] - cx
            dy = p[1, i] - cy
            dz = p[2, i] - cz
            q = 1.0 / (dx * dx + dy * dy + dz * dz + soft * soft)
            v = (q * q) * (q * q)
            out[0, i] += v
            if gradient:
                w = -8.0 * v * q
                out[1, i] += w * dx
                out[2, i] += w * dy
                out[3, i] += w * dz


@compiled
def _blend_loop(x, terms, fit, rows, lots, wanted, block):
    """Add a fit's weight w, w f, and the gradients of both, to their sums; a block has points in
    the fit's coordinates, their values and their gradients.

    w is (1 - t^2)^2 at t of the ball's radius, times how close the fit's own centres are: a sheet
    of another part of the muscle may have come into the ball, of which the fit knows nothing.
    """
    p, acc, g = block
    shares, growth, total = lots
    size = terms.scale[fit]
    radius = terms.radius[fit]
    single = len(terms.middle) == 1
    near = np.zeros((4, p.shape[1]))
    if not single:
        _closeness_loop(p, terms.centres[fit], NEAR * radius / size, wanted, near)
    for n in range(len(acc)):
        i = rows[n]
        if i < 0:
            break
        share = shares[fit, i]
        ball, close = (1.0 - share) ** 2, 1.0 if single else near[0, n] / size**8
        steep = 0.0 if single else -4.0 * (1.0 - share) / radius**2
        total[0, i] += ball * close
        total[1, i] += ball * close * acc[n]
        for c in range(3):
            away = growth[0, i] * (x[i, c] - terms.middle[fit, c])
            away += share * radius**2 * growth[1 + c, i]
            slope = steep * away * close + ball * near[1 + c, n] / size**9
            total[2 + c, i] += slope
            total[5 + c, i] += ball * close * g[c, n] / size + slope * acc[n]


@compiled
def _give_loop(low, total, value, gradient):
    """f = sum w f / sum w, and its gradient."""
    for i in range(total.shape[1]):
        value[low + i] = total[1, i] / total[0, i]
        if len(gradient) > 0:
            for c in range(3):
                slope = total[5 + c, i] - value[low + i] * total[2 + c, i]
                gradient[low + i, c] = slope / total[0, i]


@compiled
def _general_block_loop(terms, fit, form, gradient, p, acc, g):
    """Any kernel: radial functions into scratch blocks, then their sums."""
    d, u = np.empty_like(p), np.empty_like(acc)
    work, radial = np.empty((3, u.size)), np.empty((3, u.size))
    hermite, epsilon = terms.hermite, terms.epsilon[fit]
    centres = terms.centres[fit]
    weight = terms.a[fit]
    slope = terms.b[fit]
    wanted = (2 << (int(gradient) + int(hermite))) - 1
    e2, ball = epsilon * epsilon, _ball(p)
    for j in range(centres.shape[1]):
        at = centres[0, j], centres[1, j], centres[2, j]
        if form.compact and _out_of_reach(ball, at, epsilon):
            continue
        a, b = weight[j], (slope[0, j], slope[1, j], slope[2, j])
        _offsets_loop(p, at, e2, d, u)
        _radial_loop(form, wanted, u, work, radial)
        _add_value_loop(a, b, e2, hermite, radial, d, acc)
        if gradient:
            _add_gradient_loop(a, b, e2, hermite, radial, d, g)
    _polynomial_loop(terms.coefficients[fit], terms.powers, gradient, p, acc, g)


@compiled
def _ball(p):
    """Centre and radius of a ball around the points (3, n): that of their box."""
    middle, square = np.empty(3), 0.0
    for c in range(3):
        least, most = p[c, 0], p[c, 0]
        for i in range(p.shape[1]):
            least, most = min(least, p[c, i]), max(most, p[c, i])
        middle[c] = 0.5 * (least + most)
        square += (most - middle[c]) ** 2
    return middle[0], middle[1], middle[2], np.sqrt(square)


@compiled
def _out_of_reach(ball, at, epsilon):
    """Whether a kernel that ends at 1 / epsilon is zero in the whole ball."""
    dx = ball[0] - at[0]
    dy = ball[1] - at[1]
    dz = ball[2] - at[2]
    reach = ball[3] + 1.0 / epsilon
    return dx * dx + dy * dy + dz * dz >= reach * reach


@compiled
def _monomial_loop(p, i, j, k, factor, term, out):
    """out += factor x^i y^j z^k."""
    for n in range(term.size):
        term[n] = factor
    for axis, power in enumerate((i, j, k)):
        for _ in range(power):
            for n in range(term.size):
                term[n] *= p[axis, n]
    for n in range(term.size):
        out[n] += term[n]


@compiled
def _polynomial_loop(coefficients, powers, gradient, p, acc, g):
    """Adds a fit's polynomial to acc, its gradient to g."""
    term = np.empty_like(acc)
    for q in range(len(coefficients)):
        c = coefficients[q]
        i = powers[q, 0]
        j = powers[q, 1]
        k = powers[q, 2]
        _monomial_loop(p, i, j, k, c, term, acc)
        if gradient and i > 0:
            _monomial_loop(p, i - 1, j, k, c * i, term, g[0])
        if gradient and j > 0:
            _monomial_loop(p, i, j - 1, k, c * j, term, g[1])
        if gradient and k > 0:
            _monomial_loop(p, i, j, k - 1, c * k, term, g[2])


@compiled
def _cubic_block_loop(terms, fit, wanted, p, acc, g):
    """The cubic kernel with epsilon 1, whose polynomial is linear."""
    centres = terms.centres[fit]
    a = terms.a[fit]
    b = terms.b[fit]
    if wanted:
        _cubic_gradient_loop(p, centres, a, b, acc, g)
    else:
        for j in range(centres.shape[1]):
            at, slope = (centres[0, j], centres[1, j], centres[2, j]), (b[0, j], b[1, j], b[2, j])
            _cubic_value_loop(p, at, a[j], slope, acc)
    c = terms.coefficients[fit]
    for i in range(acc.size):
        acc[i] += c[0] + c[1] * p[0, i] + c[2] * p[1, i] + c[3] * p[2, i]
        if wanted:
            for k in range(3):
                g[k, i] += c[1 + k]


@compiled(fastmath={"contract"})
def _cubic_value_loop(p, at, a, b, acc):
    """acc += a r^3 - 3 r (B . d)."""
    bx, by, bz = b
    for i in range(acc.size):
        dx = p[0, i] - at[0]
        dy = p[1, i] - at[1]
        dz = p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz
        acc[i] += np.sqrt(u) * (a * u - 3.0 * (bx * dx + by * dy + bz * dz))


@compiled(fastmath={"contract"})
def _cubic_gradient_loop(p, centres, weight, slope, acc, g):
    """Adds 3 a r d - 3 r B - 3/r (B . d) d of each centre to g, the value to acc."""
    for j in range(centres.shape[1]):
        x = centres[0, j]
        y = centres[1, j]
        z = centres[2, j]
        a = weight[j]
        bx = slope[0, j]
        by = slope[1, j]
        bz = slope[2, j]
        for i in range(acc.size):
            dx = p[0, i] - x
            dy = p[1, i] - y
            dz = p[2, i] - z
            u = dx * dx + dy * dy + dz * dz + 1e-300
            r = np.sqrt(u)
            bd = 3.0 * (bx * dx + by * dy + bz * dz)
            acc[i] += r * (a * u - bd)
            radial = 3.0 * a * r - bd / r
            r3 = 3.0 * r
            g[0, i] += radial * dx - r3 * bx
            g[1, i] += radial * dy - r3 * by
            g[2, i] += radial * dz - r3 * bz


@compiled(fastmath={"contract"})
def _offsets_loop(p, at, e2, d, u):
    """d = p - centre, u = e2 |d|^2."""
    for i in range(u.size):
        dx = p[0, i] - at[0]
        dy = p[1, i] - at[1]
        dz = p[2, i] - at[2]
        d[0, i] = dx
        d[1, i] = dy
        d[2, i] = dz
        u[i] = e2 * (dx * dx + dy * dy + dz * dz)


@compiled(fastmath={"contract"})
def _add_value_loop(a, b, e2, hermite, radial, d, acc):
    """acc += a phi - first (B . d)."""
    bx, by, bz = b
    phi, first = radial[0], radial[1]
    if not hermite:
        for i in range(acc.size):
            acc[i] += a * phi[i]
        return
    for i in range(acc.size):
        acc[i] += a * phi[i] - e2 * first[i] * (bx * d[0, i] + by * d[1, i] + bz * d[2, i])


@compiled(fastmath={"contract"})
def _add_gradient_loop(a, b, e2, hermite, radial, d, g):
    """g += a first d - first B - second (B . d) d."""
    bx, by, bz = b
    first, second = radial[1], radial[2]
    if not hermite:
        for i in range(d.shape[1]):
            w = a * e2 * first[i]
            g[0, i] += w * d[0, i]
            g[1, i] += w * d[1, i]
            g[2, i] += w * d[2, i]
        return
    e4 = e2 * e2
    for i in range(d.shape[1]):
        bd = bx * d[0, i] + by * d[1, i] + bz * d[2, i]
        f = e2 * first[i]
        w = a * f - e4 * second[i] * bd
        g[0, i] += w * d[0, i] - f * bx
        g[1, i] += w * d[1, i] - f * by
        g[2, i] += w * d[2, i] - f * bz
