"""Tikhonov regularisation: against the literal minimisation, and its parameter against literal loops."""

import numpy as np
import pytest

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.cross_validation import LeastSquaresPath, SmoothingPath, leave_one_out
from rbfmuscle.implicit.fit.fitting import Basis
from rbfmuscle.implicit.fit.systems import collocation, frame, hermite_system
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.selection import choose_epsilon, choose_smoothing
from rbfmuscle.validation import NumericalWarning, UsageError

KERNELS = ["cubic", "quintic", "multiquadric", "matern_52", "wendland_c2"]


def scattered(count, seed=0, noise=0.0):
    """Points in a cube, noisy values of a smooth function there, and the function's own."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    values = np.sin(2 * points[:, 0]) + points[:, 1] * points[:, 2]
    return points, values + noise * rng.normal(size=count), values


def bumpy_sphere(count, noise):
    """Points of the unit sphere, its normals and normals turned by noise."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    normals = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    turned = normals + noise * np.random.default_rng(0).normal(size=normals.shape)
    return normals * [1.0, 1.3, 0.7], turned / np.linalg.norm(turned, axis=1)[:, None]


def value_basis(points, kernel, epsilon=1.5):
    kernel = get_kernel(kernel)
    origin, scale = frame(points)
    shape = epsilon * scale if kernel.has_epsilon else 1.0
    return Basis((points - origin) / scale, kernel, shape, kernel.degree)


@pytest.mark.parametrize("kernel", KERNELS)
def test_smoothed_fit_minimises_residual_and_energy(kernel):
    """min |f - y|^2 + smoothing w^T A w over the weights with P w = 0, as one stacked least-squares problem."""
    points, values, _ = scattered(40, noise=0.1)
    basis, smoothing = value_basis(points, kernel), 0.02
    full, block = basis.full_matrix()[:40, :40], basis.polynomials
    null = np.linalg.svd(block)[2][len(block) :].T if len(block) else np.eye(40)
    root = np.linalg.cholesky(null.T @ full @ null)
    stacked = np.vstack(
        [
            np.hstack([full @ null, block.T]),
            np.sqrt(smoothing) * np.hstack([root.T, np.zeros((len(root), len(block)))]),
        ]
    )
    found = np.linalg.lstsq(stacked, np.append(values, np.zeros(len(root))), rcond=None)[0]
    expected = np.hstack([full @ null, block.T]) @ found
    field = RBFField.fit(points, values, kernel=kernel, epsilon=1.5, smoothing=smoothing)
    assert np.abs(field(points) - expected).max() < 1e-10


@pytest.mark.parametrize("kernel", ["gaussian", "multiquadric"])
def test_smoothed_least_squares_minimise_residual_and_weights(kernel):
    points, values, _ = scattered(80, noise=0.1)
    centres, smoothing = points[:20], 0.02
    kernel = get_kernel(kernel)
    matrix, _ = collocation(points, centres, kernel, 1.5, kernel.degree, *frame(centres))
    size = matrix.shape[1]
    stacked = np.vstack([matrix, np.sqrt(smoothing) * np.eye(size)])
    found = np.linalg.lstsq(stacked, np.append(values, np.zeros(size)), rcond=None)[0]
    field = RBFField.fit_least_squares(
        points, values, centres, kernel=kernel, epsilon=1.5, smoothing=smoothing
    )
    assert np.abs(field(points) - matrix @ found).max() < 1e-10


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("kind", ["value", "all", "normal"])
def test_residuals_along_the_path_equal_those_of_each_fit(kernel, kind):
    if kind == "value":
        points, right, _ = scattered(40)
        basis = value_basis(points, kernel)
    else:
        points, normals = bumpy_sphere(30, 0.05)
        basis, right, _, _ = hermite_system(points, normals, get_kernel(kernel), 1.5, kind)
    path = SmoothingPath(basis, right)
    for smoothing in (1e-4, 1e-2, 1.0):
        found, expected = path.residuals(smoothing), leave_one_out(basis, right, smoothing=smoothing)
        assert np.abs(found.values - expected.values).max() < 1e-9
        assert np.abs(found.slopes - expected.slopes).max(initial=0) < 1e-9
        assert found.gcv == pytest.approx(expected.gcv, rel=1e-8)


@pytest.mark.parametrize("kernel", ["cubic", "gaussian"])
def test_smoothing_chosen_by_leaving_out_is_the_best_of_literal_loops(kernel):
    points, values, _ = scattered(30, noise=0.2)
    basis = value_basis(points, kernel)
    full, q = basis.full_matrix(), len(basis.powers)

    def literal(smoothing):
        matrix = full + smoothing * np.diag([1.0] * 30 + [0.0] * q)
        missed = []
        for k in range(30):
            rest = np.delete(np.arange(30 + q), k)
            weights = np.linalg.solve(matrix[np.ix_(rest, rest)], np.append(values, np.zeros(q))[rest])
            missed.append(values[k] - full[k, rest] @ weights)
        return np.sqrt(np.mean(np.square(missed)))

    choice = choose_smoothing(points, values=values, kernel=kernel, epsilon=1.5, criterion="loo")
    assert choice.objective == pytest.approx(literal(choice.smoothing), rel=1e-6)
    assert choice.objective <= min(literal(s) for s in np.geomspace(1e-6, 10, 40)) * (1 + 1e-6)
    assert 1e-4 < choice.smoothing < 10


def test_least_squares_smoothing_by_gcv_is_the_best_of_its_definition():
    points, values, _ = scattered(60, noise=0.2)
    kernel, centres = get_kernel("gaussian"), points[:30]
    matrix, _ = collocation(points, centres, kernel, 1.5, -1, *frame(centres))

    def literal(smoothing):
        hat = matrix @ np.linalg.solve(matrix.T @ matrix + smoothing * np.eye(30), matrix.T)
        return np.sqrt(60 * ((values - hat @ values) ** 2).sum() / (60 - np.trace(hat)) ** 2)

    choice = choose_smoothing(points, values=values, centres=centres, kernel="gaussian", epsilon=1.5)
    # the normal equations of the literal version square the condition
    assert choice.objective == pytest.approx(literal(choice.smoothing), rel=1e-6)
    assert choice.objective <= min(literal(s) for s in np.geomspace(1e-4, 100, 40)) * (1 + 1e-6)
    path = LeastSquaresPath(matrix, values)
    assert path.residuals(choice.smoothing).gcv == pytest.approx(choice.objective**2)


@pytest.mark.parametrize("criterion", ["gcv", "loo"])
@pytest.mark.parametrize("kernel", ["cubic", "matern_52"])
def test_chosen_smoothing_takes_noise_away(kernel, criterion):
    points, values, truth = scattered(200, noise=0.1)

    def error(smoothing):
        field = RBFField.fit(points, values, kernel=kernel, epsilon=1.5, smoothing=smoothing)
        return np.sqrt(np.mean((field(points) - truth) ** 2))

    chosen = error(criterion)
    assert chosen < 0.7 * error(0.0)
    # the criterion estimates the error from one draw of the noise
    assert chosen < 1.3 * min(error(s) for s in np.geomspace(1e-6, 1, 25))


def surface_error(points, normals, smoothing, derivatives):
    """RMS distance of 1000 unseen points of the ellipsoid from the surface, and the smoothing."""
    field = RBFField.fit_hermite(points, normals, smoothing=smoothing, derivatives=derivatives)
    value, gradient = field.value_and_gradient(bumpy_sphere(1000, 0.0)[0])
    return np.sqrt(np.mean((value / np.linalg.norm(gradient, axis=1)) ** 2)), field.smoothing


@pytest.mark.parametrize("criterion", ["gcv", "loo"])
def test_chosen_smoothing_of_a_surface_through_noisy_points(criterion):
    points, normals = bumpy_sphere(150, 0.1)
    points += 0.03 * np.random.default_rng(5).normal(size=points.shape)
    chosen, smoothing = surface_error(points, normals, criterion, "normal")
    choice = choose_smoothing(points, normals=normals, criterion=criterion, derivatives="normal")
    assert smoothing == choice.smoothing
    assert chosen < 0.6 * surface_error(points, normals, 0.0, "normal")[0]
    scan = [surface_error(points, normals, s, "normal")[0] for s in np.geomspace(1e-6, 1, 13)]
    assert chosen < 1.3 * min(scan)


@pytest.mark.parametrize("derivatives", ["all", "normal"])
def test_points_without_noise_are_not_smoothed_for_their_noisy_normals(derivatives):
    points, normals = bumpy_sphere(150, 0.2)
    chosen, smoothing = surface_error(points, normals, "gcv", derivatives)
    assert smoothing < 1e-6
    assert chosen < 1.01 * min(
        surface_error(points, normals, s, derivatives)[0] for s in np.geomspace(1e-6, 1, 13)
    )


def test_gcv_smooths_points_that_are_a_third_of_their_spacing_off():
    points, normals = bumpy_sphere(150, 0.1)
    points += 0.1 * np.random.default_rng(5).normal(size=points.shape)
    errors = [surface_error(points, normals, smoothing, "normal")[0] for smoothing in ("gcv", 0.0)]
    assert errors[0] < 0.8 * errors[1]


def test_smoothing_that_leaves_no_surface_is_told():
    points, _ = bumpy_sphere(60, 0.0)
    normals = np.random.default_rng(0).normal(size=points.shape)
    with pytest.warns(NumericalWarning, match="contradict each other"):
        choose_smoothing(points, normals=normals)


def test_data_without_noise_are_hardly_smoothed():
    points, values, _ = scattered(100)
    unseen, _, expected = scattered(300, seed=1)
    fields = [RBFField.fit(points, values, smoothing=s) for s in (0.0, "gcv")]
    errors = [np.abs(field(unseen) - expected).max() for field in fields]
    assert errors[1] < 1.05 * errors[0]


def test_what_cannot_be_chosen_is_refused():
    points, values, _ = scattered(20)
    with pytest.raises(UsageError, match="'gcv' or 'loo'"):
        RBFField.fit(points, values, smoothing="best")
    with pytest.raises(UsageError, match="'gcv' or 'loo'"):
        choose_smoothing(points, values=values, criterion="held_out")
    with pytest.raises(UsageError, match="at least 0"):
        RBFField.fit(points, values, smoothing=-1.0)
    with pytest.raises(UsageError, match="nothing to smooth"):
        RBFField.fit(points[:4], values[:4], smoothing="gcv")
    with pytest.raises(UsageError, match="values or normals"):
        choose_smoothing(points)
    with pytest.raises(UsageError, match="afterwards"):
        choose_epsilon(points, values=values, smoothing="gcv")
