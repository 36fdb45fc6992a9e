"""RBFField: interpolation, derivatives, Hermite fits, errors."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from rbfmuscle.implicit.field import COVERED, PART, FieldFit, RBFField, overlapping_parts
from rbfmuscle.implicit.fitting import Basis, solve
from rbfmuscle.implicit.kernels import KERNELS, get_kernel
from rbfmuscle.validation import UsageError

HERMITE = [name for name, kernel in KERNELS.items() if kernel.hermite]
AXES = np.array([40.0, 50.0, 60.0])


def fibonacci(count):
    """Points spread evenly over the unit sphere: (count, 3)."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return np.c_[ring * np.cos(angle), ring * np.sin(angle), z]


def ellipsoid(count):
    """Points and outward unit normals of an ellipsoid with half-axes AXES."""
    unit = fibonacci(count)
    return unit * AXES + 100.0, unit / AXES / np.linalg.norm(unit / AXES, axis=1)[:, None]


@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
@pytest.mark.parametrize("kernel", HERMITE)
def test_hermite_fit_meets_points_and_normals(kernel):
    points, normals = ellipsoid(80)
    field = RBFField.fit_hermite(points, normals, kernel=kernel, epsilon=1 / 60)
    value, gradient = field.value_and_gradient(points)
    bound = 1e-15 * field.condition + 1e-9
    assert np.abs(value).max() < 60 * bound
    assert np.abs(gradient - normals).max() < bound


def augmented(basis):
    """The indefinite matrix [A P^T; P 0] of a single fit."""
    polynomials = basis.polynomials[0]
    zero = np.zeros((len(polynomials), len(polynomials)))
    return np.block([[basis.matrices(0, 1)[0], polynomials.T], [polynomials, zero]])


@pytest.mark.parametrize("hermite", [False, True], ids=["value", "gradient"])
@pytest.mark.parametrize("kernel", ["cubic", "quintic", "septic", "polyharmonic_4", "multiquadric"])
def test_definite_solve_equals_the_augmented_indefinite_one(kernel, hermite):
    # at several radii: on one ellipsoid a quadratic would vanish
    unit = fibonacci(40)
    radii = np.linspace(0.4, 1.0, 40)[:, None]
    kernel = get_kernel(kernel)
    basis = Basis(radii * unit * [0.5, 0.7, 1.0], kernel, 2.0, hermite=hermite)
    right = np.random.default_rng(3).normal(size=basis.size)
    weights, coefficients, condition = solve(basis, right[None])
    q = len(basis.powers)
    expected = np.linalg.solve(augmented(basis), np.append(right, np.zeros(q)))
    bound = 1e-15 * condition * np.abs(expected).max()
    assert np.abs(np.append(weights, coefficients) - expected).max() < 100 * bound


@pytest.mark.parametrize(
    "kernel", ["cubic", "gaussian", "matern_72", "inverse_multiquadric", "wendland_c2"]
)
def test_condition_estimate_is_within_a_factor_of_thirty(kernel):
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (200, 3))
    kernel = get_kernel(kernel)
    basis = Basis(points, kernel, 4.0)
    _, _, condition = solve(basis, points[None, :, 0])
    matrix = basis.matrices(0, 1)[0]
    free = np.linalg.qr(basis.polynomials[0].T, mode="complete")[0][:, len(basis.powers) :]
    true = np.linalg.norm(matrix, 2) / np.linalg.eigvalsh(free.T @ matrix @ free).min()
    assert true / 30 < condition < true * 1.01


@pytest.mark.parametrize("kernel", ["cubic", "quintic", "multiquadric", "matern_52", "wendland_c2"])
def test_smoothed_fit_minimises_residual_and_energy(kernel):
    """min |f - y|^2 + smoothing w^T A w over the weights with P w = 0, as one stacked least-squares
    problem.
    """
    rng = np.random.default_rng(0)
    kernel = get_kernel(kernel)
    smoothing = 0.02
    points, values = rng.uniform(-1, 1, (40, 3)), rng.normal(size=40)
    basis = Basis(points, kernel, 1.5)
    full, block = basis.matrices(0, 1)[0, :40, :40], basis.polynomials[0]
    null = np.linalg.svd(block)[2][len(block) :].T if len(block) else np.eye(40)
    root = np.linalg.cholesky(null.T @ full @ null)
    energy = np.sqrt(smoothing) * np.hstack([root.T, np.zeros((len(root), len(block)))])
    fit = np.hstack([full @ null, block.T])
    found = np.linalg.lstsq(
        np.vstack([fit, energy]), np.append(values, np.zeros(len(root))), rcond=None
    )[0]
    field = RBFField.fit(points, values, kernel=kernel, epsilon=1.5, smoothing=smoothing)
    assert np.abs(field(points) - fit @ found).max() < 1e-10


def test_conditions_that_no_field_meets_are_named():
    points, normals = ellipsoid(30)
    points[17] = points[4]
    flat = np.random.default_rng(7).normal(size=(30, 3)) * [1, 1, 0]
    for words, fit in (
        ("centres 4 and 17 coincide", lambda: RBFField.fit(points, np.ones(30))),
        ("centres 4 and 17 coincide", lambda: RBFField.fit_hermite(points, normals)),
        ("coplanar", lambda: RBFField.fit(flat, flat[:, 0])),
        ("collinear", lambda: RBFField.fit(flat * [1, 0, 0], flat[:, 0])),
        ("degree too high", lambda: RBFField.fit(flat[:5], flat[:5, 0], kernel="quintic")),
    ):
        with pytest.raises(np.linalg.LinAlgError, match=words):
            fit()


def test_one_and_four_centres():
    field = RBFField.fit_hermite([[1.0, 2, 3]], [[0.0, 0, 1]])
    assert abs(field([[1.0, 2, 5]])[0] - 2) < 1e-9
    points, normals = ellipsoid(4)
    assert np.abs(RBFField.fit_hermite(points, normals)(points)).max() < 1e-9
    with pytest.raises(UsageError, match="at least one point"):
        RBFField.fit_hermite(np.zeros((0, 3)), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("did you mean 'gaussian'", {"kernel": "gausian"}),
        ("needs C2", {"kernel": "linear"}),
        *(("smoothing must be", {"smoothing": wrong}) for wrong in (-1.0, np.nan, np.inf)),
        *(
            ("condition must be at least 1", {"condition": wrong})
            for wrong in (0.0, 0.5, -1e10, np.nan)
        ),
    ],
)
def test_wrong_arguments_are_refused(words, options):
    with pytest.raises(UsageError, match=words):
        RBFField.fit_hermite(*ellipsoid(20), **options)


SHARED = {"linear": 1.0, "cubic": 1.0, "quintic": 1.0, "thin_plate_spline": 1.0, "gaussian": 6.0}
SHARED |= dict.fromkeys(("multiquadric", "inverse_multiquadric", "inverse_quadratic"), 4.0)


@pytest.mark.parametrize(("kernel", "epsilon"), SHARED.items())
def test_values_are_those_of_scipy(kernel, epsilon):
    rng = np.random.default_rng(2000)
    points, where = rng.uniform(-1, 1, (2000, 3)), rng.uniform(-0.9, 0.9, (500, 3))
    values = np.sin(2 * points[:, 0]) + points[:, 1] * points[:, 2]
    field = RBFField.fit(points, values, kernel=kernel, epsilon=epsilon)
    # SciPy adds a constant where none is needed
    degree = KERNELS[kernel].degree
    expected = RBFInterpolator(points, values, kernel=kernel, epsilon=epsilon, degree=degree)(where)
    assert np.abs(field(where) - expected).max() < 1e-8


def bent(points, normals):
    """A strip along z bent to half a ring about an axis along y, and its normals turned with it."""
    angle, radius = points[:, 2] * np.pi / np.ptp(points[:, 2]), np.ptp(points[:, 2]) / np.pi
    along = np.c_[np.cos(angle), np.zeros(len(angle)), np.sin(angle)]
    where = (radius + points[:, :1]) * along + points[:, 1:2] * [0, 1, 0]
    across = np.c_[-np.sin(angle), np.zeros(len(angle)), np.cos(angle)]
    return where, normals[:, :1] * along + normals[:, 1:2] * [0, 1, 0] + normals[:, 2:] * across


def strip(count):
    unit, axes = fibonacci(count), np.array([4.0, 15.0, 80.0])
    return unit * axes, unit / axes / np.linalg.norm(unit / axes, axis=1)[:, None]


def test_every_centre_is_well_inside_some_part():
    points, _ = strip(300)
    parts = overlapping_parts(points)
    assert len(parts) < 300 / 5 and set(parts[:, :COVERED].ravel()) == set(range(300))
    near = np.sort(np.linalg.norm(points[:, None] - points[parts[:, 0]], axis=2), axis=0)[:PART].T
    np.testing.assert_allclose(np.linalg.norm(points[parts] - points[parts[:, :1]], axis=2), near)
    assert overlapping_parts(points[:PART]).shape == (1, PART)


@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
@pytest.mark.parametrize(
    "kernel", ["cubic", "quintic", "gaussian", "wendland_c4", "linear", "matern_12"]
)
def test_a_blended_field_is_nearly_that_of_one_fit_and_its_slope_is_its_derivative(kernel):
    points, normals = strip(300)
    fit = FieldFit(KERNELS[kernel], 1 / 20, 1e10 if KERNELS[kernel].has_epsilon else np.inf)
    parts, (others, _) = overlapping_parts(points), strip(777)
    straight, arc = (points, normals, others), (*bent(points, normals), bent(others, others)[0])
    for centres, turned, where in (straight, arc):
        field, whole = (
            fit.fit(centres, turned, parts),
            fit.fit(centres, turned, np.arange(300)[None]),
        )
        # Centres are 10 apart: bent, a part that does not have one counts there a little.
        assert np.abs(field(centres)).max() < max(1e-2, 1.5 * np.abs(whole(centres)).max())
        assert (
            np.sqrt((field(where) ** 2).mean()) < 1.5 * np.sqrt((whole(where) ** 2).mean()) + 0.02
        )
        assert field.condition < 20 * whole.condition
        at = np.concatenate(
            [where[::20] * 1.05, np.random.default_rng(5).uniform(-150, 150, (60, 3))]
        )
        value, gradient = field.value_and_gradient(
            at
        )  # also far outside, where the balls of all parts grow
        steps = 1e-3 * np.eye(3)  # 6e-6 of the bar's length
        ahead = np.stack([(field(at + h) - field(at - h)) / 2e-3 for h in steps], axis=1)
        off = np.abs(ahead - gradient) / (1e-3 * np.abs(value)[:, None] + np.abs(ahead) + 1.0)
        assert np.median(off) < 1e-6 and np.percentile(off, 95) < 1e-4
