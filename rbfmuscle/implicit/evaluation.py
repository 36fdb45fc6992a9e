"""Evaluation of an RBF field: values and gradients at many points.

Points are handled in blocks that stay in the first-level cache; the inner loops run over the points of
a block. Large sets are split over threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.implicit.kernels.shares import (
    _add_gradient_loop,
    _add_value_loop,
    _cubic_gradient_loop,
    _cubic_hermite_gradient_loop,
    _cubic_hermite_value_loop,
    _offsets_loop,
)
from rbfmuscle.implicit.kernels.values import _add_values_loop, _cubic_loop
from rbfmuscle.jit import compiled

if TYPE_CHECKING:
    from rbfmuscle.implicit.kernels.table import Kernel


_BLOCK = 256
_SERIAL = 400_000  # pairs below which starting threads does not pay
_SORT_FROM = (
    200  # centres from which sorting the points pays, so that blocks out of a kernel's reach are skipped
)
_POOLS: dict[int, ThreadPoolExecutor] = {}


class Terms(NamedTuple):
    """A field as the loops read it, in the scaled coordinates (points - origin) / scale.

    Attributes
    ----------
    origin : (3,) ndarray
    scale : float
    centres : (3, K) ndarray
    a, b : (K,) and (3, K) ndarray
        Weights of the values, and of the derivatives.
    hermite : bool
        Whether ``b`` counts.
    epsilon : (K,) ndarray
    coefficients, powers : (q,) and (q, 3) ndarray
        Of the polynomial.
    """

    origin: np.ndarray
    scale: float
    centres: np.ndarray
    a: np.ndarray
    b: np.ndarray
    hermite: bool
    epsilon: np.ndarray
    coefficients: np.ndarray
    powers: np.ndarray


def run_in_chunks(loop: Callable[[int, int], None], count: int, cost: int) -> None:
    """Call ``loop(start, stop)`` over 0 ... count, on threads where ``cost`` (pairs) is worth it."""
    # Asked for last: it takes longer than a small question.
    threads = 1 if cost < _SERIAL else min(numba.get_num_threads(), -(-count // _BLOCK))
    if threads < 2:
        loop(0, count)
        return
    if threads not in _POOLS:
        _POOLS[threads] = ThreadPoolExecutor(threads - 1, thread_name_prefix="rbf-field")
    # more parts than threads: one whose core is taken by another, such as a waiting BLAS thread, then does fewer
    parts = max(threads, min(8 * threads, int(cost // _SERIAL), -(-count // _BLOCK)))
    edges = [count * k // parts for k in range(parts + 1)]
    left = iter(range(parts))

    def work() -> None:
        for k in left:
            loop(edges[k], edges[k + 1])

    others = [_POOLS[threads].submit(work) for _ in range(threads - 1)]
    work()
    for other in others:
        other.result()


@compiled(error_model="numpy")
def _cubic_block_loop(terms, gradient, p, acc, g):
    """Hermite values, and gradients, of the cubic kernel with epsilon 1, the commonest by far."""
    centres, a, b = terms.centres, terms.a, terms.b
    for j in range(centres.shape[1]):
        at, w = (centres[0, j], centres[1, j], centres[2, j]), a[j]
        if terms.hermite and gradient:
            _cubic_hermite_gradient_loop(p, at, w, (b[0, j], b[1, j], b[2, j]), acc, g)
        elif terms.hermite:
            _cubic_hermite_value_loop(p, at, w, (b[0, j], b[1, j], b[2, j]), acc)
        elif gradient:
            _cubic_gradient_loop(p, at, w, acc, g)
        else:
            _cubic_loop(p, at, 1.0, w, acc)


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
def _value_block_loop(terms, form, p, acc):
    """Values alone of a field without Hermite weights."""
    ball, centres, weight, epsilon = _ball(p), terms.centres, terms.a, terms.epsilon
    for j in range(centres.shape[1]):
        at, e = (centres[0, j], centres[1, j], centres[2, j]), epsilon[j]
        if not (form.compact and _out_of_reach(ball, at, e)):
            _add_values_loop(form, p, at, e * e, weight[j], acc)


@compiled(error_model="numpy")
def _general_block_loop(terms, form, gradient, p, acc, g):
    """Any kernel: radial functions into scratch blocks, then their sums."""
    d, u = np.empty_like(p), np.empty_like(acc)
    work, radial = np.empty((3, u.size)), np.empty((3, u.size))
    hermite, centres, epsilon = terms.hermite, terms.centres, terms.epsilon
    weight, slope = terms.a, terms.b
    wanted = (2 << (int(gradient) + int(hermite))) - 1
    ball = _ball(p)
    for j in range(centres.shape[1]):
        at, e2 = (centres[0, j], centres[1, j], centres[2, j]), epsilon[j] * epsilon[j]
        if form.compact and _out_of_reach(ball, at, epsilon[j]):
            continue
        a, b = weight[j], (slope[0, j], slope[1, j], slope[2, j])
        _offsets_loop(p, at, e2, d, u)
        _radial_loop(form, wanted, u, work, radial)
        _add_value_loop(a, b, e2, hermite, radial, d, acc)
        if gradient:
            _add_gradient_loop(a, b, e2, hermite, radial, d, g)


@compiled(error_model="numpy")
def _monomial_loop(p, i, j, k, factor, term, out):
    """out += factor x^i y^j z^k."""
    term[:] = factor
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


@compiled(error_model="numpy")
def _fill_block_loop(points, terms, low, n, p):
    """Scaled points of a block, coordinates in rows; its end repeats the last point."""
    for i in range(p.shape[1]):
        for c in range(3):
            p[c, i] = (points[low + min(i, n - 1), c] - terms.origin[c]) / terms.scale


@compiled(error_model="numpy")
def _give_block_loop(scale, low, n, acc, g, value, gradient):
    for i in range(n):
        value[low + i] = acc[i]
    if len(gradient) > 0:
        for i in range(n):
            for c in range(3):
                gradient[low + i, c] = g[c, i] / scale


# The length of a block is a multiple of a cache line, so that all rows are contiguous and filled alike. The cubic
# kernel has a loop of its own, so that what muscles use by default does not wait for the others to be compiled.


@compiled(error_model="numpy")
def _evaluate_cubic_loop(points, terms, start, stop, value, gradient):
    """Value and, where there is room for it, gradient of the cubic kernel with epsilon 1 at points[start:stop]."""
    for low in range(start, stop, _BLOCK):
        n = min(_BLOCK, stop - low)
        size = (n + 7) // 8 * 8
        p, acc, g = np.empty((3, size)), np.zeros(size), np.zeros((3, size))
        _fill_block_loop(points, terms, low, n, p)
        _cubic_block_loop(terms, len(gradient) > 0, p, acc, g)
        _polynomial_loop(terms, len(gradient) > 0, p, acc, g)
        _give_block_loop(terms.scale, low, n, acc, g, value, gradient)


@compiled(error_model="numpy")
def _evaluate_values_loop(points, terms, form, start, stop, value):
    """Values alone of a field of any kernel without Hermite weights at points[start:stop]."""
    nothing = np.empty((0, 3))
    for low in range(start, stop, _BLOCK):
        n = min(_BLOCK, stop - low)
        size = (n + 7) // 8 * 8
        p, acc = np.empty((3, size)), np.zeros(size)
        _fill_block_loop(points, terms, low, n, p)
        _value_block_loop(terms, form, p, acc)
        _polynomial_loop(terms, False, p, acc, p)
        _give_block_loop(terms.scale, low, n, acc, p, value, nothing)


@compiled(error_model="numpy")
def _evaluate_loop(points, terms, form, start, stop, value, gradient):
    """Value and, where there is room for it, gradient of any kernel at points[start:stop]."""
    wanted = len(gradient) > 0
    for low in range(start, stop, _BLOCK):
        n = min(_BLOCK, stop - low)
        size = (n + 7) // 8 * 8
        p, acc, g = np.empty((3, size)), np.zeros(size), np.zeros((3, size))
        _fill_block_loop(points, terms, low, n, p)
        _general_block_loop(terms, form, wanted, p, acc, g)
        _polynomial_loop(terms, wanted, p, acc, g)
        _give_block_loop(terms.scale, low, n, acc, g, value, gradient)


def evaluate(
    points: Floats,
    frame: tuple[Floats, float],
    centres: Floats,
    weights: Floats,
    kernel: Kernel,
    epsilon: Floats,
    polynomial: tuple[Floats, Integers],
    with_gradient: bool,
) -> tuple[Floats, Floats]:
    """A field and its gradient.

    Parameters
    ----------
    points : (n, 3) ndarray
    frame : pair of (3,) ndarray and float
        Origin and scale: scaled coordinates are (points - origin) / scale.
    centres : (3, K) ndarray
        Scaled.
    weights : (4, K) or (1, K) ndarray
        a, and for a Hermite fit B.
    kernel : Kernel
    epsilon : (K,) ndarray
        In scaled coordinates.
    polynomial : pair of (q,) and (q, 3) ndarrays
        Coefficients and powers of the monomials in scaled coordinates.
    with_gradient : bool

    Returns
    -------
    value : (n,) ndarray
    gradient : (n, 3) ndarray
        With respect to points; empty where it is not wanted.
    """
    hermite, count = len(weights) == 4, len(points)
    b = weights[1:] if hermite else np.zeros((3, weights.shape[1]))
    cubic = kernel.plain_cube and bool((epsilon == 1.0).all())
    value, gradient = np.empty(count), np.empty((count if with_gradient else 0, 3))
    sort = kernel.compact and centres.shape[1] >= _SORT_FROM and count > 4 * _BLOCK and epsilon.min() > 2.0
    if sort:
        places = _by_cells(points)
        points = points[places]
    terms, form = Terms(*frame, centres, weights[0], b, hermite, epsilon, *polynomial), kernel.form

    def loop(start, stop):
        if cubic:
            _evaluate_cubic_loop(points, terms, start, stop, value, gradient)
        elif not with_gradient and not hermite:
            _evaluate_values_loop(points, terms, form, start, stop, value)
        else:
            _evaluate_loop(points, terms, form, start, stop, value, gradient)

    run_in_chunks(loop, count, count * centres.shape[1])
    if not sort:
        return value, gradient
    back = np.empty_like(places)
    back[places] = np.arange(count)
    return value[back], gradient[back] if with_gradient else gradient


def _by_cells(points: Floats) -> Integers:
    """Order (n,) in which points lie cell by cell of a grid with about one block of points in each."""
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    side = max((size.prod() * _BLOCK / len(points)) ** (1 / 3), size.max() / 30)
    x, y, z = ((points - low) / (side or 1.0)).astype(np.uint16).T
    # two bytes: NumPy then sorts by counting
    return np.argsort((x * np.uint16(32) + y) * np.uint16(32) + z, kind="stable")
