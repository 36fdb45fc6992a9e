"""Fits of a bounded condition: the ridge is what it is said to be, the bound holds, and little is
lost.
"""

import numpy as np
import pytest
import trimesh
from scipy import linalg

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fitting import Basis, solve
from rbfmuscle.implicit.kernels import KERNELS
from rbfmuscle.implicit.placement import sample_surface
from rbfmuscle.implicit.selection import spacing, surface_error


@pytest.fixture(scope="module")
def plate():
    """80 points and normals of a thin ellipsoid, and other points of it."""
    mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([30.0, 18.0, 4.0])
    sample = sample_surface(mesh.vertices, mesh.faces, 80, placement="adaptive")
    others = sample_surface(mesh.vertices, mesh.faces, 600, placement="even")
    return sample.points, sample.normals, others.points


@pytest.mark.parametrize(
    ("kernel", "bound"), [("quintic", 1e6), ("cubic", 1e3), ("matern_52", 1e4)]
)
def test_what_is_left_is_one_ridge_in_units_of_the_spacing(plate, kernel, bound):
    points, normals, _ = plate
    basis, count = Basis(points, KERNELS[kernel], 0.1, hermite=True), len(points)
    right = np.concatenate([np.zeros(count), normals.T.ravel()]) * basis.scale
    (weights,), (coefficients,), condition = solve(basis, right[None], condition=bound)
    matrix, polynomials = basis.matrices(0, 1)[0], basis.polynomials[0]
    # Units of the unknowns: values 1, derivatives about the spacing.
    unit = np.r_[np.ones(count), np.full(basis.size - count, 1.0 / np.sqrt(count))]
    left = right - matrix @ weights - polynomials.T @ coefficients
    ridge = (unit**2 * left) @ weights / (weights @ weights)
    assert np.abs(unit**2 * left - ridge * weights).max() < 1e-5 * ridge * np.abs(weights).max()
    assert (np.abs(polynomials @ weights) < 1e-9 * np.abs(weights).max()).all()
    null = np.linalg.qr((polynomials * unit).T, mode="complete")[0][:, len(basis.powers) :]
    values = linalg.eigvalsh(null.T @ (unit[:, None] * matrix * unit) @ null)
    assert (
        0.7 * values[-1] / bound < ridge < 1.01 * values[-1] / bound
    )  # six steps of power iteration
    assert condition <= bound
    assert condition < 1.5 * (values[-1] + ridge) / (values[0] + ridge)


def test_a_bound_that_is_not_reached_changes_next_to_nothing_and_one_that_is_costs_little(plate):
    points, normals, others = plate
    plain = RBFField.fit_hermite(points, normals, kernel="cubic")
    bounded = RBFField.fit_hermite(points, normals, kernel="cubic", condition=1e12)
    assert bounded.condition < plain.condition  # values and slopes in comparable units
    assert np.abs(plain(others) - bounded(others)).max() < 1e-6 * spacing(points).mean()

    # Septic loses little of its error.
    reach = spacing(points).mean()
    plain = RBFField.fit_hermite(points, normals, kernel="septic")
    bounded = RBFField.fit_hermite(points, normals, kernel="septic", condition=1e10)
    assert bounded.condition <= 1e10 < plain.condition
    assert surface_error(bounded, others, reach) < 1.02 * surface_error(plain, others, reach)


def test_what_no_ridge_can_mend_is_refused(plate):
    points, normals, _ = plate
    with pytest.raises(np.linalg.LinAlgError, match=r"condition of 1e\+30; lower the bound"):
        RBFField.fit_hermite(points, normals, kernel="gaussian", epsilon=1e-3, condition=1e30)
    flat, along = points * [1.0, 0.0, 0.0], np.tile([1.0, 0.0, 0.0], (len(points), 1))
    with pytest.raises(np.linalg.LinAlgError, match="singular fit"):
        RBFField.fit_hermite(flat, along, kernel="quintic", condition=1e8)
