"""Volume derivatives against central differences of a volume found by rays."""

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from peers.sensitivity import volume_derivative

from rbfmuscle.implicit.field import RBFField


def directions(count=24):
    """Gauss product rule on the sphere: directions (n, 3) and weights (n,)."""
    z, weight = leggauss(count)
    angle = 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    z, angle = np.repeat(z, 2 * count), np.tile(angle, count)
    ring = np.sqrt(1 - z * z)
    rays = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    return rays, np.repeat(weight, 2 * count) * np.pi / count


RAYS, WEIGHTS = directions()


def zero_along_rays(field):
    t = np.full(len(RAYS), 1.0)
    for _ in range(30):
        value, gradient = field.value_and_gradient(t[:, None] * RAYS)
        t = t - value / (gradient * RAYS).sum(axis=1)
    return t


def volume(field):
    return WEIGHTS @ zero_along_rays(field) ** 3 / 3


def quadrature(field):
    t = zero_along_rays(field)
    points = t[:, None] * RAYS
    gradient = field.gradient(points)
    slope = np.linalg.norm(gradient, axis=1)
    return points, WEIGHTS * t**2 * slope / (gradient * RAYS).sum(axis=1)


def shape(hermite, kernel):
    rng = np.random.default_rng(0)
    i = np.arange(24) + 0.5
    z, angle = 1 - 2 * i / 24, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    unit = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    points = unit * [1.0, 1.2, 0.9] + 0.02 * rng.normal(size=(24, 3))
    if hermite:
        normals = unit / [1.0, 1.2, 0.9]
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return points, lambda c: RBFField.fit_hermite(c, normals, kernel=kernel, epsilon=0.5)
    points = np.vstack([points, 0.5 * points, 1.5 * points])
    values = np.repeat([0.0, -0.5, 0.5], 24)
    return points, lambda c: RBFField.fit(c, values, kernel=kernel, epsilon=0.5)


@pytest.mark.parametrize("hermite", [True, False])
@pytest.mark.parametrize("kernel", ["cubic", "matern_52", "inverse_multiquadric"])
@pytest.mark.parametrize("refit", [True, False])
def test_volume_derivative_against_central_differences(hermite, kernel, refit):
    points, make = shape(hermite, kernel)
    field = make(points)
    derivative = volume_derivative(field, *quadrature(field), refit=refit)

    def moved(j, step):
        centres = points.copy()
        centres[j] += step
        if refit:
            return volume(make(centres))
        return volume(
            RBFField(
                centres, (field.origin, field.scale), field.kernel, field.epsilon, field.weights,
                (field.coefficients, field.powers), 1.0,
            )
        )  # fmt: skip

    h = 3e-5  # truncation and rounding of the difference are about equal
    largest = np.abs(derivative).max()
    for j in (0, 5, len(points) - 1):
        for step in h * np.eye(3):
            expected = (moved(j, step) - moved(j, -step)) / (2 * h)
            assert abs(derivative[j] @ step / h - expected) < 1e-6 * largest


@pytest.mark.parametrize("hermite", [True, False])
@pytest.mark.parametrize("refit", [True, False])
def test_sum_rules(hermite, refit):
    points, make = shape(hermite, "matern_52")  # no polynomial: all of the field moves with its centres
    field = make(points)
    derivative = volume_derivative(field, *quadrature(field), refit=refit)
    # the quadrature, exact to about 1e-7 for this shape, is what breaks the rules
    assert np.abs(derivative.sum(axis=0)).max() < 1e-5
    if not hermite:  # a Hermite field turns only if its normals turn too
        assert np.abs(np.cross(points, derivative).sum(axis=0)).max() < 1e-5
