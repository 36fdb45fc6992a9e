"""The constraints of an RBF muscle against derivatives, laws and a literal projection."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rbfmuscle.model.clusters import bind_samples, build_clusters, opposite_points
from rbfmuscle.model.constraints import ShapeConstraint, VolumeConstraint, _rotation_loop
from rbfmuscle.model.contact import solve_contact_forces


@pytest.fixture(scope="module")
def ellipsoid():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.apply_scale([60.0, 25.0, 15.0])
    return mesh


@pytest.fixture(scope="module")
def shape(ellipsoid):
    coarse = trimesh.creation.icosphere(subdivisions=2)
    coarse.apply_scale([60.0, 25.0, 15.0])
    clusters = build_clusters(
        coarse.vertices, coarse.vertex_normals, coarse.faces, ellipsoid.vertices, ellipsoid.vertex_normals
    )
    fibre = np.tile([1.0, 0.0, 0.0], (len(coarse.vertices), 1))
    return ShapeConstraint(np.array(coarse.vertices), *clusters, fibre, limits=(0.6, 1.6), hold=0.0)


def test_volume_gradient_agrees_with_central_differences(ellipsoid):
    points = np.array(ellipsoid.vertices)
    constraint = VolumeConstraint(0.5 * points, np.asarray(ellipsoid.faces))
    assert constraint.rest == pytest.approx(ellipsoid.volume / 8.0, rel=1e-12)
    value, gradient = constraint.evaluate(points)
    assert value == pytest.approx(ellipsoid.volume * 7.0 / 8.0, rel=1e-12)
    step = 6e-6 * 60.0
    for vertex, axis in [(0, 0), (7, 1), (200, 2)]:
        shifted = [points.copy(), points.copy()]
        shifted[0][vertex, axis] += step
        shifted[1][vertex, axis] -= step
        difference = (constraint.evaluate(shifted[0])[0] - constraint.evaluate(shifted[1])[0]) / (2 * step)
        # The volume is 1e5, so rounding leaves 1e-11 · 1e5 / step in the quotient.
        assert gradient[vertex, axis] == pytest.approx(difference, abs=1e-6)


def test_volume_projection_of_an_ellipsoid_converges_quadratically(ellipsoid):
    """A step along the gradient with its factor 1/6: -19 %, 1e-2, 4e-5, 3e-10."""
    points = np.array(ellipsoid.vertices)
    wanted = ellipsoid.volume / 0.81
    constraint = VolumeConstraint(points / 0.81 ** (1.0 / 3.0), np.asarray(ellipsoid.faces))
    errors = []
    for _ in range(4):
        value, gradient = constraint.evaluate(points)
        errors.append(abs(value) / wanted)
        points -= value / np.vdot(gradient, gradient) * gradient
    assert errors[0] == pytest.approx(0.19, rel=1e-9)
    assert errors[1] < 2e-2
    assert errors[2] < 1e-4
    assert errors[3] < 1e-8


def test_shape_energy_is_zero_under_rigid_motion_and_fibre_stretch(shape):
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    stretch = np.diag([1.3, 1.3**-0.5, 1.3**-0.5])
    for motion in (turn, turn @ stretch):
        x = shape.rest @ motion.T + [5.0, -3.0, 2.0]
        shape.localise(x)
        np.testing.assert_allclose(shape.target, np.tile(motion, (len(x), 1, 1)), atol=2e-5)
        assert shape.energy(x) < 1e-8 * np.sum(shape.rest**2)


def test_shape_resists_stretch_beyond_its_limits_and_stretch_across_the_fibre(shape):
    for stretch in ([2.0, 2.0**-0.5, 2.0**-0.5], [1.3**-0.5, 1.3, 1.3**-0.5]):
        x = shape.rest * stretch
        shape.localise(x)
        assert shape.energy(x) > 1e-3 * np.sum(shape.rest**2)


def test_right_side_is_the_minimiser_of_the_frozen_energy(shape):
    rng = np.random.default_rng(3)
    x = shape.rest + rng.normal(scale=1.5, size=shape.rest.shape)
    right = shape.localise(x).copy()
    # E's gradient with targets frozen is 2 (L x - b): compare with central differences of the energy.
    gradient = 2.0 * (shape.laplacian @ x - right)
    step = 6e-6 * 60.0
    for index, axis in [(0, 0), (11, 1), (40, 2)]:
        ahead, behind = x.copy(), x.copy()
        ahead[index, axis] += step
        behind[index, axis] -= step
        difference = (shape.energy(ahead) - shape.energy(behind)) / (2 * step)
        assert gradient[index, axis] == pytest.approx(difference, rel=1e-6, abs=1e-6)


def test_contact_forces_solve_the_quadratic_programme():
    rng = np.random.default_rng(5)
    half = rng.normal(size=(12, 12))
    gram = half @ half.T + 0.5 * np.eye(12)
    need = rng.normal(size=12)
    force = np.zeros(12)
    solve_contact_forces(gram, need, force, sweeps=2000, tolerance=1e-13)
    literal = minimize(
        lambda f: 0.5 * f @ gram @ f - need @ f,
        np.zeros(12),
        jac=lambda f: gram @ f - need,
        bounds=[(0, None)] * 12,
        options={"ftol": 1e-15, "gtol": 1e-12, "maxiter": 5000},
    )
    np.testing.assert_allclose(force, literal.x, atol=1e-6)
    assert (gram @ force >= need - 1e-9).all()


def test_samples_are_carried_by_near_centres_of_their_own_side(ellipsoid):
    coarse = trimesh.creation.icosphere(subdivisions=2)
    coarse.apply_scale([60.0, 25.0, 15.0])
    columns, shares = bind_samples(
        np.array(ellipsoid.vertices),
        ellipsoid.vertex_normals,
        np.array(coarse.vertices),
        coarse.vertex_normals,
    )
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=1e-12)
    assert (shares >= 0.0).all()
    carried = np.einsum("sk,ska->sa", shares, coarse.vertices[columns])
    # Centres are about 8 mm apart on the largest section.
    assert np.linalg.norm(carried - ellipsoid.vertices, axis=1).max() < 8.0


def test_opposite_point_of_an_ellipsoid_lies_across_it(ellipsoid):
    top = np.array([[0.0, 0.0, 15.0]])
    found = opposite_points(top, np.array([[0.0, 0.0, 1.0]]), ellipsoid.vertices, ellipsoid.vertex_normals)
    np.testing.assert_allclose(ellipsoid.vertices[found[0]], [0.0, 0.0, -15.0], atol=2.0)


def test_clusters_without_centres_across_are_the_rings_alone(ellipsoid):
    coarse = trimesh.creation.icosphere(subdivisions=2)
    coarse.apply_scale([60.0, 25.0, 15.0])
    start, _, weight = build_clusters(
        coarse.vertices,
        coarse.vertex_normals,
        coarse.faces,
        ellipsoid.vertices,
        ellipsoid.vertex_normals,
        across=0,
    )
    # Two rings about a vertex of five or six neighbours.
    assert np.diff(start).min() >= 15 and np.diff(start).max() <= 18
    assert (weight == 1.0).all()


def test_turning_towards_a_deformation_ends_at_its_polar_rotation():
    rng = np.random.default_rng(0)
    for _ in range(300):
        stretch = rng.normal(size=(3, 3))
        deformation = Rotation.from_rotvec(0.5 * rng.normal(size=3)).as_matrix()
        deformation = deformation @ (np.eye(3) + 0.15 * (stretch + stretch.T))
        u, _, vt = np.linalg.svd(deformation)
        wanted = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        _rotation_loop(deformation, quaternion)
        found = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(found, wanted, atol=2e-3)
