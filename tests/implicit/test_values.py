"""Sums of radial functions."""

import numpy as np
import pytest

from rbfmuscle.implicit.evaluation import Terms, evaluate
from rbfmuscle.implicit.kernels import KERNELS


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
@pytest.mark.parametrize("dipoles", [False, True], ids=["values", "hermite"])
def test_values_and_slopes_are_those_of_the_literal_sum(kernel, dipoles):
    rng = np.random.default_rng(3)
    origin = np.array([3.0, -2.0, 1.0])
    scale = 2.5
    epsilon = 0.8
    centres, weights = rng.uniform(-1, 1, (3, 7)), rng.normal(size=(4, 7))
    weights[1:] *= dipoles
    coefficients, powers = np.array([0.3, -1.2, 0.7]), np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    points = origin + scale * rng.uniform(-1, 1, (11, 3))
    parts = origin, np.array(scale), centres, weights
    shape = np.array(epsilon), coefficients
    whole = [part[None] for part in (*parts, *shape, np.zeros(3), np.array(1.0))]
    terms = Terms(*whole[:4], dipoles, *whole[4:6], powers, *whole[6:])

    def found(at, with_gradient=True):
        return evaluate(at, terms, kernel, with_gradient)

    def phi(at, shift=0.0):
        way = at[:, None] - centres.T - shift
        return kernel.phi(np.linalg.norm(way, axis=2), epsilon)

    def literal(at):
        local = (at - origin) / scale
        total = phi(local) @ weights[0] + np.prod(local[:, None] ** powers, axis=2) @ coefficients
        step = 1e-5
        for k in range(3 if dipoles else 0):
            # -B . grad phi(p - c), the slope by the place of the centre
            way = step * np.eye(3)[k]
            total = total + (phi(local, way) - phi(local, -way)) / (2 * step) @ weights[1 + k]
        return total

    value, gradient = found(points)
    smooth = 2e-7 if dipoles else 1e-12
    np.testing.assert_allclose(value, literal(points), atol=smooth * 100, rtol=1e-7)
    np.testing.assert_allclose(found(points, False)[0], value, atol=1e-12)
    step = 6e-6 * scale
    for k in range(3):
        way = step * np.eye(3)[k]
        ahead, behind = found(points + way), found(points - way)
        np.testing.assert_allclose(
            gradient[:, k], (ahead[0] - behind[0]) / (2 * step), atol=2e-7, rtol=2e-7
        )
