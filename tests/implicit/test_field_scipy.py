"""Interpolation beside SciPy's RBFInterpolator, where the kernels coincide."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import KERNELS

SHARED = {
    "linear": 1.0,
    "cubic": 1.0,
    "quintic": 1.0,
    "thin_plate_spline": 1.0,
    "multiquadric": 4.0,
    "inverse_multiquadric": 4.0,
    "inverse_quadratic": 4.0,
    "gaussian": 6.0,
}


def problem(count):
    rng = np.random.default_rng(count)
    points = rng.uniform(-1, 1, (count, 3))
    return points, np.sin(2 * points[:, 0]) + points[:, 1] * points[:, 2], rng.uniform(-0.9, 0.9, (500, 3))


@pytest.mark.parametrize("kernel", SHARED)
@pytest.mark.parametrize("count", [500, 1000, 2000])
def test_values_are_those_of_scipy(kernel, count):
    points, values, where = problem(count)
    field = RBFField.fit(points, values, kernel=kernel, epsilon=SHARED[kernel])
    # SciPy adds a constant where none is needed
    degree = KERNELS[kernel].degree
    expected = RBFInterpolator(points, values, kernel=kernel, epsilon=SHARED[kernel], degree=degree)(where)
    assert np.abs(field(where) - expected).max() < 1e-8
