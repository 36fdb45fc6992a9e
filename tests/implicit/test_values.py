"""The vectorised exponential, logarithm and sums of radial functions."""

import mpmath
import numpy as np
import pytest

from rbfmuscle.implicit.evaluation import Terms, evaluate
from rbfmuscle.implicit.kernels.radial import _exp_loop, _log_loop
from rbfmuscle.implicit.kernels.table import KERNELS


def in_units_of_last_place(found, exact):
    with mpmath.workdps(40):
        away = [
            abs(mpmath.mpf(f) - e) / mpmath.mpf(np.spacing(abs(f))) for f, e in zip(found, exact)
        ]
        return float(max(away))


def test_exponential_and_logarithm_are_right_to_two_units_in_the_last_place():
    rng = np.random.default_rng(0)
    x = np.concatenate(
        [rng.uniform(-700, 700, 1500), rng.uniform(-1, 1, 500), [0.0, -1e-300, 1e-17]]
    )
    out = np.empty_like(x)
    _exp_loop(1.0, x, out)
    assert in_units_of_last_place(out, [mpmath.exp(mpmath.mpf(v)) for v in x]) < 2
    _exp_loop(-1.0, np.array([708.5, 1e5, np.inf]), out[:3])
    assert not out[:3].any()
    x = np.concatenate([np.exp(x[:1500]), 1 + rng.uniform(-0.3, 0.4, 500), [1 + 1e-13, 0.0]])
    _log_loop(x, out[:-1])
    assert in_units_of_last_place(out[:-2], [mpmath.log(mpmath.mpf(v)) for v in x[:-1]]) < 2
    assert np.isfinite(out[-2])


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
    parts = origin, np.array(scale), centres, weights[0], weights[1:]
    shape = np.array(epsilon), coefficients
    whole = [part[None] for part in (*parts, *shape, np.zeros(3), np.array(1.0))]
    terms = Terms(*whole[:5], dipoles, *whole[5:7], powers, *whole[7:])

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
