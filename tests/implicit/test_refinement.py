"""Centres and normals fitted to the whole surface."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.refinement import fit_sample
from rbfmuscle.implicit.placement.sampling import sample_surface, spread_points
from rbfmuscle.implicit.selection import spacing

CUBIC = FieldFit(get_kernel("cubic"), 1.0)


@pytest.fixture(scope="module")
def bean():
    """A bent ellipsoid with bumps that 60 centres cannot follow, and the centres."""
    mesh = trimesh.creation.icosphere(subdivisions=4).apply_scale([30.0, 18.0, 8.0])
    v = np.array(mesh.vertices)
    v[:, 2] += (v[:, 0] / 12.0) ** 2 + 0.6 * np.sin(v[:, 0] / 3.0) * np.sin(v[:, 1] / 3.0)
    return (
        v,
        np.asarray(mesh.faces),
        sample_surface(v, np.asarray(mesh.faces), 60, placement="adaptive"),
    )


@pytest.mark.parametrize(
    ("kernel", "epsilon", "condition"),
    [
        ("cubic", 1.0, np.inf),
        ("quintic", 1.0, np.inf),
        ("inverse_multiquadric", 0.12, 1e10),
        ("inverse_multiquadric", 0.02, 1e10),  # without its ridge the problem is not sound
    ],
)
def test_fitted_centres_err_less_at_points_they_have_not_seen(bean, kernel, epsilon, condition):
    vertices, faces, plain = bean
    fit = FieldFit(get_kernel(kernel), epsilon, condition)
    fitted = fit_sample(plain, vertices, faces, fit=fit)
    unseen = spread_points(vertices, faces, 3000, seed=7)[0]

    def error(sample):
        field = fit.fit(sample.points, sample.normals)
        return np.sqrt((field(unseen) ** 2).mean())

    assert error(fitted) < 0.8 * error(plain)
    assert (
        np.linalg.norm(fitted.points - plain.points, axis=1).max()
        < 0.25 * spacing(plain.points).mean()
    )
    np.testing.assert_allclose(np.linalg.norm(fitted.normals, axis=1), 1.0, atol=1e-12)
    assert (fitted.control_faces == plain.control_faces).all()


def test_units_and_place_do_not_matter(bean):
    vertices, faces, sample = bean
    fitted = fit_sample(sample, vertices, faces, fit=CUBIC)
    shift = np.array([3.0, -1.0, 2.0])
    moved = replace(sample, points=sample.points * 1e-3 + shift)
    there = fit_sample(moved, vertices * 1e-3 + shift, faces, fit=CUBIC)
    np.testing.assert_allclose((there.points - shift) * 1e3, fitted.points, atol=1e-6)
    np.testing.assert_allclose(there.normals, fitted.normals, atol=1e-6)
