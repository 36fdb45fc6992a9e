"""Values and gradients of an RBF field at many points.

Points are handled in blocks that stay in the first-level cache; the inner loops run over the points of a block.
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


class Terms(NamedTuple):
    """A field as the loops read it, in the scaled coordinates (points - origin) / scale.

    ``centres`` (3, K); ``a`` (K,) and ``b`` (3, K) are the weights of the values and of the derivatives, of which the
    latter count where ``hermite``; ``coefficients`` (q,) and ``powers`` (q, 3) are the polynomial's.
    """

    origin: np.ndarray
    scale: float
    centres: np.ndarray
    a: np.ndarray
    b: np.ndarray
    hermite: bool
    epsilon: float
    coefficients: np.ndarray
    powers: np.ndarray


def evaluate(points: Floats, terms: Terms, kernel: Kernel, with_gradient: bool) -> tuple[Floats, Floats]:
    """A field's values (n,) at points (n, 3), and its gradients (n, 3) by these, which are empty where not wanted."""
    count = len(points)
    value, gradient = np.empty(count), np.empty((count if with_gradient else 0, 3))
    cubic, form = kernel.plain_cube and terms.epsilon == 1.0, kernel.form

    def work(start: int, stop: int) -> None:
        if cubic:
            _evaluate_cubic_loop(points, terms, start, stop, value, gradient)
        else:
            _evaluate_loop(points, terms, form, start, stop, value, gradient)

    in_chunks(count, work, least=max(_BLOCK, _SERIAL // terms.centres.shape[1]))
    return value, gradient


# The length of a block is a multiple of a cache line, so that all rows are contiguous and filled alike. The cubic
# kernel has a loop of its own, so that what muscles use by default does not wait for the others to be compiled.


@compiled(error_model="numpy")
def _evaluate_cubic_loop(points, terms, start, stop, value, gradient):
    """Value and, where there is room for it, gradient of the cubic kernel with epsilon 1 at points[start:stop]."""
    wanted, centres, a, b = len(gradient) > 0, terms.centres, terms.a, terms.b
    for low in range(start, stop, _BLOCK):
        n = min(_BLOCK, stop - low)
        p, acc, g = _fill_block(points, terms, low, n)
        for j in range(centres.shape[1]):
            at, slope = (centres[0, j], centres[1, j], centres[2, j]), (b[0, j], b[1, j], b[2, j])
            if wanted:
                _cubic_gradient_loop(p, at, a[j], slope, acc, g)
            else:
                _cubic_value_loop(p, at, a[j], slope, acc)
        _polynomial_loop(terms, wanted, p, acc, g)
        _give_block_loop(terms.scale, low, n, acc, g, value, gradient)


@compiled(error_model="numpy")
def _evaluate_loop(points, terms, form, start, stop, value, gradient):
    """Value and, where there is room for it, gradient of any kernel at points[start:stop]."""
    wanted = len(gradient) > 0
    for low in range(start, stop, _BLOCK):
        n = min(_BLOCK, stop - low)
        p, acc, g = _fill_block(points, terms, low, n)
        _general_block_loop(terms, form, wanted, p, acc, g)
        _polynomial_loop(terms, wanted, p, acc, g)
        _give_block_loop(terms.scale, low, n, acc, g, value, gradient)


@compiled(error_model="numpy")
def _fill_block(points, terms, low, n):
    """Scaled points (3, m) of a block, its end repeats the last point; zeros (m,) and (3, m) to add to."""
    size = (n + 7) // 8 * 8
    p = np.empty((3, size))
    for i in range(size):
        for c in range(3):
            p[c, i] = (points[low + min(i, n - 1), c] - terms.origin[c]) / terms.scale
    return p, np.zeros(size), np.zeros((3, size))


@compiled(error_model="numpy")
def _give_block_loop(scale, low, n, acc, g, value, gradient):
    for i in range(n):
        value[low + i] = acc[i]
    if len(gradient) > 0:
        for i in range(n):
            for c in range(3):
                gradient[low + i, c] = g[c, i] / scale


@compiled(error_model="numpy")
def _general_block_loop(terms, form, gradient, p, acc, g):
    """Any kernel: radial functions into scratch blocks, then their sums."""
    d, u = np.empty_like(p), np.empty_like(acc)
    work, radial = np.empty((3, u.size)), np.empty((3, u.size))
    hermite, centres, weight, slope = terms.hermite, terms.centres, terms.a, terms.b
    wanted = (2 << (int(gradient) + int(hermite))) - 1
    e2, ball = terms.epsilon * terms.epsilon, _ball(p)
    for j in range(centres.shape[1]):
        at = centres[0, j], centres[1, j], centres[2, j]
        if form.compact and _out_of_reach(ball, at, terms.epsilon):
            continue
        a, b = weight[j], (slope[0, j], slope[1, j], slope[2, j])
        _offsets_loop(p, at, e2, d, u)
        _radial_loop(form, wanted, u, work, radial)
        _add_value_loop(a, b, e2, hermite, radial, d, acc)
        if gradient:
            _add_gradient_loop(a, b, e2, hermite, radial, d, g)


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def _out_of_reach(ball, at, epsilon):
    """Whether a kernel that ends at 1 / epsilon is zero in the whole ball."""
    dx, dy, dz = ball[0] - at[0], ball[1] - at[1], ball[2] - at[2]
    reach = ball[3] + 1.0 / epsilon
    return dx * dx + dy * dy + dz * dz >= reach * reach


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def _polynomial_loop(terms, gradient, p, acc, g):
    """Adds a field's polynomial to acc, its gradient to g."""
    coefficients, powers = terms.coefficients, terms.powers
    term = np.empty_like(acc)
    for q in range(len(coefficients)):
        c, i, j, k = coefficients[q], powers[q, 0], powers[q, 1], powers[q, 2]
        _monomial_loop(p, i, j, k, c, term, acc)
        if gradient and i > 0:
            _monomial_loop(p, i - 1, j, k, c * i, term, g[0])
        if gradient and j > 0:
            _monomial_loop(p, i, j - 1, k, c * j, term, g[1])
        if gradient and k > 0:
            _monomial_loop(p, i, j, k - 1, c * k, term, g[2])


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic_value_loop(p, at, a, b, acc):
    """acc += a r^3 - 3 r (B . d)."""
    bx, by, bz = b
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz
        acc[i] += np.sqrt(u) * (a * u - 3.0 * (bx * dx + by * dy + bz * dz))


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic_gradient_loop(p, at, a, b, acc, g):
    """Adds 3 a r d - 3 r B - 3/r (B . d) d to g, the value to acc."""
    bx, by, bz = b
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz + 1e-300
        r = np.sqrt(u)
        bd = 3.0 * (bx * dx + by * dy + bz * dz)
        acc[i] += r * (a * u - bd)
        radial = 3.0 * a * r - bd / r
        r3 = 3.0 * r
        g[0, i] += radial * dx - r3 * bx
        g[1, i] += radial * dy - r3 * by
        g[2, i] += radial * dz - r3 * bz


@compiled(error_model="numpy", fastmath={"contract"})
def _offsets_loop(p, at, e2, d, u):
    """d = p - centre, u = e2 |d|^2."""
    for i in range(u.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        d[0, i] = dx
        d[1, i] = dy
        d[2, i] = dz
        u[i] = e2 * (dx * dx + dy * dy + dz * dz)


@compiled(error_model="numpy", fastmath={"contract"})
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


@compiled(error_model="numpy", fastmath={"contract"})
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
