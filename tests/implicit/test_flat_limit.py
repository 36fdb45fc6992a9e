"""Flat kernels: the limit, small epsilon against many digits, least squares, what is refused and warned of."""

import itertools

import mpmath
import numpy as np
import pytest

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.contour import common_denominator
from rbfmuscle.implicit.fit.flat_limit import FlatField
from rbfmuscle.implicit.kernels.table import KERNELS
from rbfmuscle.validation import NumericalWarning, UsageError

LITERAL = {
    "gaussian": lambda u: mpmath.exp(-u),
    "multiquadric": lambda u: -mpmath.sqrt(1 + u),
    "inverse_multiquadric": lambda u: 1 / mpmath.sqrt(1 + u),
    "inverse_quadratic": lambda u: 1 / (1 + u),
    "generalised_multiquadric": lambda u: (1 + u) ** mpmath.mpf("1.5"),
}
ANALYTIC = sorted(LITERAL)


def scattered(count, seed=0):
    """Points in the unit ball and a smooth function of them."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= rng.uniform(size=(count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1)[:, None]
    return points, smooth(points)


def smooth(points):
    return np.exp(0.5 * points[:, 0]) * np.cos(points[:, 1] + 0.5 * points[:, 2])


def exact_interpolant(kernel, points, values, where, epsilon):
    """The interpolant with 80 digits, whatever the condition."""
    with mpmath.workdps(80):
        degree = KERNELS[kernel].degree
        phi, square = LITERAL[kernel], mpmath.mpf(epsilon) ** 2
        points, where = ([[mpmath.mpf(float(c)) for c in p] for p in rows] for rows in (points, where))
        monomials = [lambda p: 1, lambda p: p[0], lambda p: p[1], lambda p: p[2]][: (0, 1, 4)[degree + 1]]

        def row(x):
            radial = [phi(square * sum((a - b) ** 2 for a, b in zip(x, p))) for p in points]
            return radial + [m(x) for m in monomials]

        count, size = len(points), len(points) + len(monomials)
        matrix = mpmath.zeros(size)
        for i, point in enumerate(points):
            matrix[i, :] = mpmath.matrix([row(point)])
        matrix[count:, :count] = matrix[:count, count:].T
        right = mpmath.matrix([*map(float, values), *[0] * len(monomials)])
        weights = mpmath.lu_solve(matrix, right)
        return np.array([float(mpmath.fdot(row(x), weights)) for x in where])


def test_every_analytic_kernel_is_tried():
    assert {name for name, kernel in KERNELS.items() if kernel.smoothness == 99} == set(ANALYTIC)


@pytest.mark.parametrize("kernel", ANALYTIC)
@pytest.mark.parametrize("epsilon", [0.0, 1e-3, 0.2])
def test_flat_interpolant_agrees_with_many_digits(kernel, epsilon):
    points, values = scattered(20)
    where = 0.8 * scattered(6, seed=1)[0]
    field = FlatField.fit(points, values, kernel=kernel, epsilon=epsilon)
    # with 80 digits the limit itself can be taken: the error of epsilon = 1e-8 is of the order of 1e-16
    expected = exact_interpolant(kernel, points, values, where, epsilon or 1e-8)
    assert np.abs(field(where) - expected).max() < 1e-7  # condition 1e7 on the circle
    assert np.abs(field(where) - expected).max() < 20 * field.error + 1e-13


# a kernel with a linear polynomial has no interpolant on a line
@pytest.mark.parametrize("kernel", [name for name in ANALYTIC if KERNELS[name].degree < 1])
def test_limit_on_a_line_is_the_polynomial_interpolant(kernel):
    at = np.array([-1.0, -0.55, -0.2, 0.3, 0.7, 1.0])
    values = np.array([0.3, -0.2, 0.5, 1.0, 0.4, -0.6])
    x = np.linspace(-1, 1, 21)
    polynomial = np.polynomial.Polynomial.fit(at, values, 5)
    direction, place = np.array([2.0, -1.0, 2.0]) / 3, np.array([5.0, 6.0, 7.0])
    field = FlatField.fit(place + at[:, None] * direction, values, kernel=kernel)
    value, gradient = field.value_and_gradient(place + x[:, None] * direction)
    assert np.abs(value - polynomial(x)).max() < 1e-10
    assert np.abs(gradient @ direction - polynomial.deriv()(x)).max() < 1e-8


@pytest.mark.parametrize("kernel", ["gaussian", "multiquadric"])
def test_twenty_points_have_the_cubic_polynomial_as_limit_by_interpolation_and_least_squares(kernel):
    centres, values = scattered(20)
    powers = [p for p in itertools.product(range(4), repeat=3) if sum(p) <= 3]

    def monomials(points):
        return np.prod(points[:, None, :] ** np.array(powers), axis=2)

    where = 0.7 * scattered(30, seed=1)[0]
    cubic = np.linalg.solve(monomials(centres), values)
    assert (
        np.abs(FlatField.fit(centres, values, kernel=kernel)(where) - monomials(where) @ cubic).max() < 1e-6
    )
    samples, data = scattered(120, seed=2)
    samples *= 0.9
    cubic = np.linalg.lstsq(monomials(samples), data, rcond=None)[0]
    fitted = FlatField.fit_least_squares(samples, data, centres, kernel=kernel)
    assert np.abs(fitted(where) - monomials(where) @ cubic).max() < 1e-6


@pytest.mark.parametrize("kernel", ANALYTIC)
def test_flat_fits_continue_the_direct_ones(kernel):
    points, values = scattered(20)
    samples = 0.9 * scattered(100, seed=3)[0]
    field = FlatField.fit(points, values, kernel=kernel)
    epsilon = 0.9 * field.radius
    direct = RBFField.fit(points, values, kernel=kernel, epsilon=epsilon)
    value, gradient = field.at(epsilon).value_and_gradient(samples)
    assert np.abs(value - direct(samples)).max() < 1e-8
    assert np.abs(gradient - direct.gradient(samples)).max() < 1e-7
    if KERNELS[kernel].order == 0:  # with a polynomial the direct fit leaves its weights free
        data = (samples, smooth(samples), points)
        flat = FlatField.fit_least_squares(*data, kernel=kernel, epsilon=epsilon)
        direct = RBFField.fit_least_squares(*data, kernel=kernel, epsilon=epsilon)
        assert np.abs(flat(samples) - direct(samples)).max() < 1e-8


@pytest.mark.parametrize("kernel", ["gaussian", "inverse_multiquadric"])
def test_unit_and_place_do_not_matter(kernel):
    points, values = scattered(20)
    where = 0.8 * points
    field = FlatField.fit(points, values, kernel=kernel, epsilon=0.05)
    moved = FlatField.fit(1e3 * points + 7e3, values, kernel=kernel, epsilon=0.05e-3)
    assert np.abs(field(where) - moved(1e3 * where + 7e3)).max() < 1e-8
    assert np.abs(field.gradient(where) - 1e3 * moved.gradient(1e3 * where + 7e3)).max() < 1e-7


@pytest.mark.parametrize("kernel", ["multiquadric", "inverse_quadratic"])
def test_a_diverging_limit_is_told_and_that_of_the_gaussian_exists(kernel):
    """The Gaussian always has a limit (Schaback 2005), others diverge on grids (Fornberg, Wright & Larsson 2004)."""
    grid = np.array([(x, y, 0.0) for x in np.linspace(-1, 1, 5) for y in np.linspace(-1, 1, 5)])
    values = smooth(grid)
    with pytest.warns(NumericalWarning, match="no limit exists"):
        FlatField.fit(grid, values, kernel=kernel)
    assert np.abs(FlatField.fit(grid, values, kernel=kernel, epsilon=0.1)(grid) - values).max() < 1e-8
    assert np.abs(FlatField.fit(grid, values)(grid) - values).max() < 1e-11


def test_flat_least_squares_is_as_good_at_the_limit_where_the_truncated_one_is_lost():
    centres, _ = scattered(60)
    samples, data = scattered(300, seed=1)
    unseen, expected = scattered(200, seed=2)
    flat = FlatField.fit_least_squares(samples, data, centres, epsilon=0.01)
    with pytest.warns(NumericalWarning, match="directions out.*FlatField"):
        truncated = RBFField.fit_least_squares(samples, data, centres, kernel="gaussian", epsilon=0.01)
    worst = [np.abs(field(unseen) - expected).max() for field in (flat, truncated)]
    assert worst[0] < 1e-3
    assert worst[0] < 0.1 * worst[1]


def test_common_poles_are_found_though_their_series_hardly_falls():
    half = 16
    angles = np.pi * (np.arange(half) + 0.5) / half
    t, orders = np.exp(1j * angles), np.arange(-half, half)
    # poles at 0.98 and -0.6 inside the circle and one outside, which the numerator takes up
    functions = np.stack(
        [1 / (t - 0.98), 1 / ((t + 0.6) * (t - 0.98)) + t, 1 / (t + 0.6) + 1 / (t - 9)], axis=1
    )
    coefficients = (np.exp(-1j * np.outer(orders, angles)) @ functions).real / half
    poles = np.polynomial.polynomial.polyroots(common_denominator(coefficients))
    assert np.abs(np.sort(poles)[:2] - [-0.6, 0.98]).max() < 1e-9


def test_one_and_two_centres():
    assert FlatField.fit([[1.0, 2, 3]], [4.0])([[1.0, 2, 3]])[0] == pytest.approx(4.0)
    pair = FlatField.fit([[0.0, 0, 0], [2, 0, 0]], [1.0, 3.0])
    assert pair([[0.5, 0, 0]])[0] == pytest.approx(1.5, abs=1e-12)
    assert FlatField.fit([[0.0, 0, 0], [2, 0, 0]], [0.0, 0.0])([[1.0, 0, 0]])[0] == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kernel": "cubic"}, "not analytic"),
        ({"kernel": "gausian"}, "did you mean"),
        ({"epsilon": -1.0}, "at least 0"),
        ({"epsilon": 5.0}, "RBFField.fit"),
        ({"reach": 0.5}, "reach must lie"),
    ],
)
def test_what_cannot_be_is_refused(change, message):
    with pytest.raises(UsageError, match=message):
        FlatField.fit(*scattered(20), **change)


def test_points_out_of_reach_coinciding_or_too_many_centres_and_too_few_samples_are_refused():
    points, values = scattered(20)
    with pytest.raises(UsageError, match="fit with reach=3"):
        FlatField.fit(points, values)(points * 3 / np.linalg.norm(points, axis=1)[:, None] + 1e-3)
    with pytest.raises(np.linalg.LinAlgError, match="coincide"):
        FlatField.fit(points[[0, 0, 1, 2]], values[:4])
    with pytest.raises(UsageError, match="at most 600 centres"):
        FlatField.fit(*scattered(601))
    with pytest.raises(UsageError, match="at least 20 points"):
        FlatField.fit_least_squares(points[:10], values[:10], points)
