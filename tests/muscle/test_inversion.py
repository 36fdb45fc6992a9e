"""Squeezed material of the solid: the nearest deformation that keeps volume, its energy, a bar pushed together."""

import numpy as np
import pytest
from elastic_bar import bar, settle, shift, with_fibres
from scipy.spatial.transform import Rotation

from rbfmuscle.muscle.inversion import LEAST, STIFFNESS, nearest_volume


@pytest.mark.parametrize("stretches", [(1.0, 1.0, 0.1), (1.2, 0.6, 0.05), (1.0, 0.9, -0.4), (0.3, 0.3, 0.3)])
def test_nearest_deformation_has_the_least_volume_and_none_is_nearer(stretches):
    one, two = Rotation.random(2, random_state=3).as_matrix()
    f, goal = one @ np.diag(stretches) @ two, np.empty((3, 3))
    square = nearest_volume(f, goal)
    assert np.linalg.det(goal) == pytest.approx(LEAST, rel=1e-3)  # ten steps of the search
    assert square == pytest.approx(((f - goal) ** 2).sum(), rel=1e-9)
    rng = np.random.default_rng(5)
    for size in (0.01, 0.1, 0.5):
        for other in goal + size * rng.normal(size=(200, 3, 3)):
            if np.linalg.det(other) >= LEAST:
                assert ((f - other) ** 2).sum() > square * (1 - 1e-2)


def test_what_keeps_its_volume_is_left_as_it_is():
    f, goal = np.diag([1.3, 0.9, 0.8]) @ Rotation.random(random_state=1).as_matrix(), np.empty((3, 3))
    assert nearest_volume(f, goal) == 0.0
    assert np.allclose(goal, f, atol=1e-14)


def test_force_of_squeezed_points_is_the_derivative_of_their_energy():
    solid = with_fibres(bar(), [1.0, 0.0, 0.0], ratio=1.0, slack=1.0)
    rng = np.random.default_rng(1)
    base = solid.rest * [0.5, 0.8, 0.8] + rng.normal(0, 0.05, solid.rest.shape)
    way, h, found = rng.normal(size=base.shape), 1e-4, []
    for sign in (1, -1):
        solid.y = base + sign * h * way
        solid.localise()
        found.append(solid.squeezed)
    assert found[0] > 0.0
    solid.y = base
    solid.localise()
    force = np.zeros_like(base)
    for q in np.flatnonzero(solid.stiffened):
        goal = np.empty((3, 3))
        nearest_volume(solid.f[q], goal)
        pull = STIFFNESS * solid.weights[q] * (solid.f[q] - goal)
        np.add.at(force, solid.quad_columns[q], solid.slopes[q] @ pull.T)
    assert (found[0] - found[1]) / (2 * h) == pytest.approx(np.vdot(force, way), rel=1e-3)


def test_bar_that_is_pushed_together_is_not_turned_inside_out():
    solid = bar(iterations=100)
    length = np.ptp(solid.points[:, 0])
    for part in np.linspace(0.05, 0.7, 14):
        settle(solid, shift(-part * length))
        assert np.isfinite(solid.y).all()
    assert np.linalg.det(solid.f).min() > 0.0
