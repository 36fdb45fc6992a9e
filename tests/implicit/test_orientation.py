"""Normals from the energy of the field: right everywhere on thin and bent shapes, whatever the frame and the part."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbfmuscle.implicit.fit.fitting import solve
from rbfmuscle.implicit.fit.systems import hermite_system
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.orientation import energy_matrix, orient_points
from rbfmuscle.validation import UsageError


def bent_plate(count, seed=0):
    """Points and normals of a thin, bent ellipsoid: 40 x 20 x 5, as a flat muscle."""
    rng = np.random.default_rng(seed)
    i = np.arange(count) + rng.uniform(0.1, 0.9, count)
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    unit = np.c_[z, ring * np.cos(angle), ring * np.sin(angle)]
    axes = np.array([20.0, 10.0, 2.5])
    points, normals = unit * axes, unit / axes
    points[:, 2] += (points[:, 0] / 8.0) ** 2  # and the normals with it
    normals[:, 0] -= normals[:, 2] * points[:, 0] / 32.0
    return points, normals / np.linalg.norm(normals, axis=1)[:, None]


def right(found, normals):
    return np.einsum("ij,ij->i", found, normals)


def test_energy_is_that_of_the_interpolant():
    """g^T H g is w^T y of the Hermite fit to the gradients g and values 0."""
    points, normals = bent_plate(30)
    lower = energy_matrix(points)
    full = lower + np.tril(lower, -1).T
    g = normals.T.ravel()
    basis, _, _, _ = hermite_system(points, normals, get_kernel("cubic"), 1.0, "all")
    y = np.concatenate([np.zeros(30), g])
    assert g @ full @ g == pytest.approx(solve(basis, y)[0] @ y, rel=1e-8)
    assert np.linalg.eigvalsh(full).min() > -1e-9 * np.abs(full).max()


@pytest.mark.parametrize(("count", "degrees"), [(80, 15.0), (200, 6.0)])
def test_every_point_of_a_thin_bent_plate_is_oriented_outwards(count, degrees):
    points, normals = bent_plate(count)
    found = orient_points(points)
    assert np.abs(np.linalg.norm(found, axis=1) - 1.0).max() < 1e-12
    cosine = right(found, normals)
    assert cosine.min() > 0.0 and np.degrees(np.arccos(np.median(cosine))) < degrees


def test_turned_moved_and_scaled_points_have_turned_normals():
    points, _ = bent_plate(80)
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 2.0])
    first, second = orient_points(points), orient_points(1e3 * turn.apply(points) + [5e3, -2e3, 7.0])
    assert right(turn.apply(first), second).min() > 0.99


def test_larger_sets_by_parts_are_oriented_alike():
    points, normals = bent_plate(300)
    cosine = right(orient_points(points, together=100), normals)
    assert cosine.min() > 0.0 and np.degrees(np.arccos(np.median(cosine))) < 4.0


def test_wrong_points_are_refused():
    with pytest.raises(UsageError, match="at least 10 points"):
        orient_points(np.eye(3))
    points, _ = bent_plate(40)
    with pytest.raises(np.linalg.LinAlgError, match="coincide"):
        orient_points(np.concatenate([points, points[:1]]))
