"""The field of a muscle that moves: fitted anew, and blended in the material."""

import numpy as np
import pytest
from shown_ball import CENTRES, PARTS, X

from rbfmuscle.implicit.field import FieldFit, RBFField, overlapping_parts
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.surface.projection import MovingField


@pytest.mark.parametrize("kernel", ["cubic", "gaussian", "linear"])
def test_a_field_follows_its_centres_with_the_weights_of_the_material(kernel):
    parts = overlapping_parts(CENTRES)
    field = MovingField(FieldFit(get_kernel(kernel), 1.7, 1e10), parts, CENTRES, CENTRES)
    points = 1.02 * X[::5]
    weights = field.weights(points)
    value, gradient = field(points, weights)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    field.move(CENTRES @ turn.T + 3.0, CENTRES @ turn.T)
    there, slope = field(points @ turn.T + 3.0, weights)
    np.testing.assert_allclose(there, value, atol=1e-7)
    np.testing.assert_allclose(slope, gradient @ turn.T, atol=1e-6)
    assert 1.0 <= field.condition < np.inf
    some = np.arange(len(points)) % 2 == 0
    np.testing.assert_allclose(
        field(points @ turn.T + 3.0, weights, some)[0], np.where(some, there, 0.0), atol=1e-12
    )


def test_a_blend_in_the_material_is_the_field_at_rest_and_its_gradient_is_its_derivative():
    fitted = RBFField.fit_hermite(CENTRES, CENTRES, parts=PARTS)
    field = MovingField(FieldFit(get_kernel("cubic"), 1.0), PARTS, CENTRES, CENTRES)
    points = 1.02 * X[::5]
    weights = field.weights(points)
    value, gradient = field(points, weights)
    assert np.abs(value - fitted(points)).max() < 1e-3
    for axis, step in enumerate(6e-6 * np.eye(3)):
        ahead, behind = (field(points + sign * step, weights)[0] for sign in (1, -1))
        np.testing.assert_allclose(gradient[:, axis], (ahead - behind) / 1.2e-5, atol=1e-7)


def test_without_a_fit_the_condition_is_infinite():
    field = MovingField(FieldFit(get_kernel("cubic"), 1.0), PARTS, CENTRES, CENTRES)
    field.move(np.full_like(CENTRES, np.nan), CENTRES)
    assert field.condition == np.inf
