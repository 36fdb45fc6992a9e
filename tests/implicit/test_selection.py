"""Leave-one-out, GCV and the search for epsilon against literal loops and scans."""

import warnings

import numpy as np
import pytest
from peers.variable import FAMILIES, fit_variable, search_variable, variable_epsilon

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.cross_validation import LeastSquaresPath, leave_one_out
from rbfmuscle.implicit.fit.fitting import Basis
from rbfmuscle.implicit.fit.systems import collocation, frame, hermite_system
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.selection import (
    CRITERIA,
    choose_epsilon,
    franke_epsilon,
    hardy_epsilon,
    spacing,
    spacing_epsilon,
)
from rbfmuscle.validation import NumericalWarning, UsageError


def sphere(count, radius=1.0):
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return radius * np.c_[ring * np.cos(angle), ring * np.sin(angle), z]


def scattered(count, seed=0):
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return points, np.sin(2 * points[:, 0]) + points[:, 1] * points[:, 2]


@pytest.mark.parametrize("kernel", ["cubic", "quintic", "multiquadric", "matern_52", "wendland_c2", "linear"])
@pytest.mark.parametrize("smoothing", [0.0, 0.01])
def test_leave_one_out_equals_the_literal_loop(kernel, smoothing):
    points, values = scattered(40)
    kernel = get_kernel(kernel)
    basis = Basis(points, kernel, 1.5, kernel.degree)
    found = leave_one_out(basis, values, smoothing=smoothing)
    full, q = basis.full_matrix(smoothing), len(basis.powers)
    for k in range(40):
        rest = np.delete(np.arange(40 + q), k)
        weights = np.linalg.solve(full[np.ix_(rest, rest)], np.append(values, np.zeros(q))[rest])
        assert abs(values[k] - full[k, rest] @ weights - found.values[k]) < 1e-10


@pytest.mark.parametrize("derivatives", ["all", "normal"])
def test_leaving_a_hermite_centre_out_leaves_all_its_conditions_out(derivatives):
    unit = sphere(30)
    points = unit * [1.0, 1.3, 0.7]
    basis, right, _, scale = hermite_system(points, unit, get_kernel("cubic"), 1.0, derivatives)
    found = leave_one_out(basis, right)
    for k in (0, 7, 29):
        rest = np.arange(30) != k
        field = RBFField.fit_hermite(points[rest], unit[rest], derivatives=derivatives)
        assert abs(abs(field(points[k : k + 1])[0]) - abs(found.values[k])) < 1e-9 * max(1, scale)


def test_least_squares_residuals_equal_the_literal_loop():
    points, values = scattered(60)
    centres = points[:15]
    kernel = get_kernel("gaussian")
    matrix, _ = collocation(points, centres, kernel, 1.5, -1, *frame(centres))
    for ridge in (0.0, 1e-3):
        found = LeastSquaresPath(matrix, values).residuals(ridge)
        for k in (0, 20, 59):
            rest = np.arange(60) != k
            normal = matrix[rest].T @ matrix[rest] + ridge * np.eye(15)
            weights = np.linalg.solve(normal, matrix[rest].T @ values[rest])
            # normal equations square the condition: 1e-8 is what the literal loop itself can do
            assert abs(values[k] - matrix[k] @ weights - found.values[k]) < 1e-6


def test_generalised_cross_validation_equals_its_definition():
    points, values = scattered(40)
    basis = Basis(points, get_kernel("matern_52"), 1.5, -1)
    smoothing = 0.05
    full = basis.full_matrix()
    hat = full @ np.linalg.inv(full + smoothing * np.eye(40))
    expected = 40 * ((values - hat @ values) ** 2).sum() / (40 - np.trace(hat)) ** 2
    assert leave_one_out(basis, values, smoothing=smoothing).gcv == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("criterion", [c for c in CRITERIA if c != "held_out"])
@pytest.mark.parametrize("kernel", ["gaussian", "inverse_multiquadric", "wendland_c4"])
def test_chosen_epsilon_is_near_the_best_of_a_scan(kernel, criterion):
    points, values = scattered(120)
    choice = choose_epsilon(points, values=values, kernel=kernel, criterion=criterion)
    assert choice.objective == choice.tried[:, 1][choice.tried[:, 0] == choice.epsilon][0]
    if criterion == "condition":
        # within half a decade of the target unless the kernel cannot reach it
        assert choice.objective < 0.5 or kernel == "wendland_c4"
        return
    where, truth = scattered(500, seed=1)

    def error(epsilon):
        field = RBFField.fit(points, values, kernel=kernel, epsilon=epsilon)
        return np.sqrt(((field(where) - truth) ** 2).mean())

    sound = choice.tried[(choice.tried[:, 2] < 1e12), 0]
    # leave-one-out sees the given points only; a factor of two of the best on unseen ones is its promise
    assert error(choice.epsilon) < 2 * min(error(e) for e in sound) + 1e-6


@pytest.mark.filterwarnings("ignore:kernel .* does not reach")
def test_held_out_points_choose_for_a_hermite_fit():
    unit = sphere(60)
    held_out = sphere(333)
    choice = choose_epsilon(
        unit, normals=unit, kernel="wendland_c4", criterion="held_out", held_out=held_out, span=(0.1, 3)
    )
    scan = [
        np.sqrt((RBFField.fit_hermite(unit, unit, kernel="wendland_c4", epsilon=e)(held_out) ** 2).mean())
        for e in np.geomspace(0.1, 3, 40) / spacing(unit).mean()
    ]
    assert choice.objective < 1.1 * min(scan)


def test_epsilon_scales_with_the_unit():
    points, values = scattered(60)
    metre = choose_epsilon(points, values=values, kernel="gaussian")
    millimetre = choose_epsilon(points * 1000, values=values, kernel="gaussian")
    # golden sections compare objectives that differ by rounding; the minimum itself is flat
    assert millimetre.epsilon * 1000 == pytest.approx(metre.epsilon, rel=1e-3)
    for rule in (hardy_epsilon, franke_epsilon, spacing_epsilon):
        assert rule(points * 1000) * 1000 == pytest.approx(rule(points), rel=1e-12)


def test_wrong_requests_are_answered():
    points, values = scattered(20)
    with pytest.raises(UsageError, match="no shape parameter"):
        choose_epsilon(points, values=values, kernel="cubic")
    with pytest.raises(UsageError, match="criterion must be one of"):
        choose_epsilon(points, values=values, criterion="aic")
    with pytest.raises(UsageError, match="either values or normals"):
        choose_epsilon(points)
    with pytest.raises(UsageError, match="coincides"):
        spacing(np.zeros((3, 3)))


@pytest.mark.parametrize("family", FAMILIES)
def test_variable_epsilon_stays_in_its_range_and_interpolates(family):
    points, values = scattered(60)
    epsilon = variable_epsilon(points, 1.5, 3.0, family=family)
    assert epsilon.min() >= 1.5 and epsilon.max() <= 3.0
    field = fit_variable(points, values, epsilon, kernel="inverse_multiquadric")
    assert np.abs(field(points) - values).max() < 1e-8


def test_evolutionary_search_beats_a_poor_start():
    points, values = scattered(50)
    epsilon, objective = search_variable(points, values, kernel="inverse_multiquadric", generations=4)
    where, truth = scattered(300, seed=2)
    found = fit_variable(points, values, epsilon, kernel="inverse_multiquadric")
    poor = RBFField.fit(points, values, kernel="inverse_multiquadric", epsilon=10.0)
    assert objective > 0
    assert np.abs(found(where) - truth).mean() < 0.5 * np.abs(poor(where) - truth).mean()


@pytest.mark.parametrize("criterion", ["loo", "gcv"])
@pytest.mark.parametrize("kernel", ["wendland_c2", "matern_52", "inverse_multiquadric", "multiquadric"])
def test_normals_choose_a_shape_that_knows_the_surface_between_the_centres(kernel, criterion):
    unit, between = sphere(120), sphere(777)
    stretch = np.array([3.0, 1.5, 1.0])
    points, where = unit * stretch, between * stretch
    normals = unit / stretch
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    choice = choose_epsilon(points, normals=normals, kernel=kernel, criterion=criterion)

    def missed(epsilon):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            field = RBFField.fit_hermite(points, normals, kernel=kernel, epsilon=epsilon)
        value, gradient = field.value_and_gradient(where)
        return np.sqrt((value**2).mean() / (gradient**2).sum(axis=1).mean())

    scan = np.geomspace(0.05, 2.0, 12) / spacing(points).mean()
    # On so smooth a surface the flat range wins by far; left-out points cannot see differences of 1e-4 of the size.
    assert missed(choice.epsilon) < 2.0 * min(missed(e) for e in scan) + 3e-4
