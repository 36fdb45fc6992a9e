"""RBFField: interpolation, derivatives, Hermite fits, errors."""

import numpy as np
import pytest

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels import KERNELS
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
    normals = unit / AXES
    return unit * AXES + 100.0, normals / np.linalg.norm(normals, axis=1)[:, None]


def central_gradient(field, points, step):
    return np.stack([(field(points + e) - field(points - e)) / (2 * step) for e in step * np.eye(3)], axis=1)


@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
@pytest.mark.parametrize("kernel", HERMITE)
def test_hermite_fit_meets_points_and_normals(kernel):
    points, normals = ellipsoid(80)
    field = RBFField.fit_hermite(points, normals, kernel=kernel, epsilon=1 / 60)
    value, gradient = field.value_and_gradient(points)
    bound = 1e-15 * field.condition + 1e-9
    assert np.abs(value).max() < 60 * bound
    assert np.abs(gradient - normals).max() < bound


@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
@pytest.mark.parametrize("kernel", KERNELS)
def test_gradient_is_the_derivative_of_the_value(kernel):
    points, _ = ellipsoid(60)
    rng = np.random.default_rng(1)
    field = RBFField.fit(points, rng.normal(size=60), kernel=kernel, epsilon=1 / 50)
    # off the centres: kernels that are only C0 there have no derivative at a centre
    where = 100 + rng.normal(size=(50, 3)) * 30
    expected = central_gradient(field, where, 6e-6 * 100)
    gradient = field.gradient(where)
    # central differences at this step lose about 1e-10 of the largest value a weight contributes
    scale = np.abs(gradient).max() + np.abs(field.weights).max() * 1e-4
    assert np.abs(gradient - expected).max() < 1e-5 * scale


def test_unknown_kernel_is_answered_with_the_nearest_name():
    with pytest.raises(UsageError, match="did you mean 'gaussian'"):
        RBFField.fit(np.eye(3), np.zeros(3), kernel="gausian")


def test_rough_kernel_is_refused_for_hermite_fits():
    points, normals = ellipsoid(20)
    with pytest.raises(UsageError, match="needs C2"):
        RBFField.fit_hermite(points, normals, kernel="linear")
