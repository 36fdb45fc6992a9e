"""Interpolation beside SciPy's RBFInterpolator, where the kernels coincide."""

import time

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


@pytest.mark.benchmark
@pytest.mark.parametrize("kernel", ["cubic", "gaussian"])
def test_time_beside_scipy(kernel):
    points, values, _ = problem(1000)
    where = np.random.default_rng(0).uniform(-1, 1, (64**3, 3))
    times = {}
    for name, make in (("ours", RBFField.fit), ("scipy", RBFInterpolator)):
        fits, evaluations = [], []
        for _ in range(2):
            start = time.perf_counter()
            field = make(points, values, kernel=kernel, epsilon=6.0)
            middle = time.perf_counter()
            field(where)
            fits.append(middle - start)
            evaluations.append(time.perf_counter() - middle)
        times[name] = min(fits), min(evaluations)
    print(f"{kernel}: fit and evaluation, ours {times['ours']}, scipy {times['scipy']} s")
