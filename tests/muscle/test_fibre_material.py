"""Fibres with active stress in the finite-element solid: derivatives, and the closed form of a free bar."""

import numpy as np
import pytest
from peers.fibre_material import FibreMaterial, PassiveFibres, free_stretch

STEP = 1e-5


def test_passive_fibres_make_the_modulus_along_them_so_many_times_that_across():
    made, x = PassiveFibres.of_ratio(np.eye(3)[:1], 20.0), np.array([[0.8, 1.0, 1.3]])
    above, below, here = (made.evaluate(x + step, 0.0) for step in (STEP, -STEP, 0.0))
    assert (above[0] - below[0]) / (2 * STEP) == pytest.approx(here[1], abs=1e-8)
    # An incompressible ground of shear modulus 1 pulls along by 3 a strain, neo-Hookean at rest.
    assert (3.0 + here[2][0, 1]) / 3.0 == pytest.approx(20.0)


def _bricks(direction, **options):
    pytest.importorskip("skfem")
    from peers.finite_element import HexSolid, brick_grid

    cube, bricks = brick_grid((3, 3, 3))
    count = len(bricks)
    made = FibreMaterial(
        np.broadcast_to(direction, (count, 3)), np.arange(count) % 3 == 0, np.full(count, 1.3), **options
    )
    return cube * [20.0, 10.0, 10.0], bricks, made, HexSolid


def test_free_bar_shortens_to_the_closed_form():
    points, bricks, made, solid_of = _bricks(np.array([1.0, 0.0, 0.0]))
    count = len(bricks)
    made = FibreMaterial(made.direction, np.zeros(count, dtype=bool), np.ones(count))
    solid = solid_of(points, bricks, poisson=0.4995, fibres=made)
    held = np.zeros(points.shape, dtype=bool)
    left = points[:, 0] < -19.9
    held[left, 0] = True
    corner = [np.flatnonzero(left & (points[:, 1] == y) & (points[:, 2] == -10.0))[0] for y in (-10.0, 10.0)]
    held[corner[0]], held[corner[1], 2] = True, True
    u = np.zeros_like(points)
    for activation in np.linspace(0.0, 1.0, 11)[1:]:
        solid.activation = activation
        u = solid.solve(u, held, np.zeros_like(u), settled=1e-12).displacement
    stretch = np.ptp((points + u)[:, 0]) / 40.0
    # Poisson's ratio 0.4995: the volume gives by some 1e-4.
    assert stretch == pytest.approx(free_stretch(30.0), rel=1e-3)
    assert np.ptp((points + u)[:, 1]) / 20.0 == pytest.approx(free_stretch(30.0) ** -0.5, rel=1e-3)
