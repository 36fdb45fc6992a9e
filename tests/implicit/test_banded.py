"""Compact kernels: a band of neighbours gives the fit of the full matrix."""

import numpy as np
import pytest

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.banded import factorise_band
from rbfmuscle.implicit.fit.fitting import Basis, factorise
from rbfmuscle.implicit.kernels.table import KERNELS

COMPACT = [name for name, kernel in KERNELS.items() if kernel.compact]


def ellipsoid(count):
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    unit = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    points = unit * [0.4, 0.5, 1.0]
    normals = unit / [0.4, 0.5, 1.0]
    # another order than along the spiral, or the band would be narrow as it is
    mixed = np.random.default_rng(0).permutation(count)
    return points[mixed], (normals / np.linalg.norm(normals, axis=1)[:, None])[mixed]


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["value", "normal", "gradient"])
@pytest.mark.parametrize("name", COMPACT)
def test_band_gives_the_weights_of_the_full_matrix(name, kind, smoothing):
    kernel = KERNELS[name]
    if kind != "value" and not kernel.hermite:
        return
    points, normals = ellipsoid(900 if kind == "value" else 400)
    basis = Basis(points, kernel, 7.0, -1, kind=kind, normals=normals)
    right = np.random.default_rng(1).normal(size=basis.size)
    narrow, full = factorise_band(basis, smoothing), factorise(basis, smoothing)
    assert narrow is not None
    weights, coefficients, condition = narrow.solve(right)
    expected, _, estimate = full.solve(right)
    assert np.abs(weights - expected).max() < 1e-10 * np.abs(expected).max()
    assert len(coefficients) == 0
    assert estimate / 10 < condition < 10 * estimate


@pytest.mark.parametrize(
    "name, epsilon, count", [("wendland_c2", 0.5, 900), ("cubic", 7.0, 900), ("wendland_c2", 7.0, 50)]
)
def test_full_matrix_is_kept_where_a_band_would_not_pay(name, epsilon, count):
    points, _ = ellipsoid(count)
    assert factorise_band(Basis(points, KERNELS[name], epsilon, KERNELS[name].degree)) is None


def test_centres_out_of_each_others_reach_have_their_values_for_weights():
    points, _ = ellipsoid(900)
    basis = Basis(points, KERNELS["wendland_c4"], 1e3, -1)
    assert np.array_equal(factorise_band(basis).solve(points[:, 2])[0], points[:, 2])


def test_evaluation_by_cells_is_that_of_the_literal_sum():
    points, _ = ellipsoid(400)
    field = RBFField.fit(points, points[:, 2], kernel="wendland_c2", epsilon=7.0)
    where = np.random.default_rng(2).uniform(-1.2, 1.2, (5000, 3))
    r = np.linalg.norm(where[:, None] - points, axis=2)
    kernel = KERNELS["wendland_c2"]
    expected = kernel.phi(r, 7.0) @ field.weights
    assert np.abs(field(where) - expected).max() < 1e-13
    slopes = np.einsum("nk,nkc,k->nc", kernel.first(r, 7.0), where[:, None] - points, field.weights)
    assert np.abs(field.gradient(where) - slopes).max() < 1e-11
