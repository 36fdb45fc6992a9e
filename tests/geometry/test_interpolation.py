"""Displacements of a surface interpolated into it, against maps that are known inside."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.interpolation import CENTRES, SurfaceInterpolation, spread_points

RADIUS = 20.0


def ball(subdivisions=4):
    return np.array(trimesh.creation.icosphere(subdivisions, RADIUS).vertices)


def inner(count=200):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 3))
    return (
        0.9 * RADIUS * points / np.linalg.norm(points, axis=1)[:, None] * rng.random(count)[:, None]
    )


def test_affine_displacements_come_out_exactly():
    matrix = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix() @ np.diag([1.2, 0.8, 1.1])
    inside = SurfaceInterpolation(ball(), inner())
    shift = np.array([30.0, -200.0, 5.0])
    np.testing.assert_allclose(
        inside(ball() @ matrix.T + shift), inner() @ matrix.T + shift, atol=1e-8
    )


def test_a_bar_that_is_bent_is_followed_inside():
    rng = np.random.default_rng(0)
    size = np.array([60.0, 8.0, 8.0])
    surface = rng.uniform(-1.0, 1.0, (4000, 3))
    side = np.abs(surface).argmax(axis=1)
    surface[np.arange(4000), side] = np.sign(surface[np.arange(4000), side])
    surface *= size
    points = rng.uniform(-0.9, 0.9, (300, 3)) * size

    def bent(p, radius=70.0):
        angle, r = p[:, 0] / radius, radius + p[:, 1]
        return np.stack([r * np.sin(angle), r * np.cos(angle) - radius, p[:, 2]], axis=1)

    found = SurfaceInterpolation(surface, points)(bent(surface))
    # Its ends move by 30 mm; the spline is not this map, but near it.
    assert np.linalg.norm(found - bent(points), axis=1).max() < 0.05


def test_spread_points_leave_no_gap():
    points = ball()
    chosen = points[spread_points(points, CENTRES)]
    gaps = np.linalg.norm(points[:, None] - chosen, axis=2).min(axis=1)
    # As many discs of this radius have twice the sphere's area.
    assert gaps.max() < np.sqrt(2 * 4.0 * RADIUS**2 / CENTRES)
    assert len(np.unique(spread_points(points, CENTRES))) == CENTRES
    assert spread_points(points[:7], CENTRES).tolist() == list(range(7))
