"""Harmonic weights, gradients on a surface, and the blend of rigid motions."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry import harmonic
from rbfmuscle.geometry.harmonic import blended_motion, cotangent_laplacian, harmonic_weights

LENGTH, RADIUS = 40.0, 5.0


def cylinder(*, rows=40, around=24, shear=0.0):
    """Side of a cylinder along z; ``shear`` turns the rings so that triangles become obtuse."""
    angle = 2 * np.pi * np.arange(around) / around
    height = np.linspace(0, LENGTH, rows + 1)
    turn = angle[None, :] + shear * height[:, None]
    along = np.broadcast_to(height[:, None], turn.shape)
    vertices = np.stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), along], axis=-1)
    i, j = np.meshgrid(np.arange(rows), np.arange(around), indexing="ij")
    a, b = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    faces = np.concatenate(
        [np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)]
    )
    return vertices.reshape(-1, 3), faces, around


def pose(seed, angle):
    rng, motion = np.random.default_rng(seed), np.eye(4)
    axis = rng.normal(size=3)
    motion[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    motion[:3, 3] = rng.normal(size=3) * 50.0
    return motion


def moved(points, motion):
    return points @ motion[:3, :3].T + motion[:3, 3]


def test_laplacian_knows_no_scale_and_takes_linear_functions_for_harmonic():
    """Cotangents are of angles alone; in a plane what is linear has no curvature inside, whatever
    the triangles.
    """
    rng = np.random.default_rng(5)
    across, up = np.meshgrid(np.arange(7.0), np.arange(7.0), indexing="ij")
    inside = (np.minimum(across, up) > 0) & (np.maximum(across, up) < 6)
    flat = np.stack([across, up, 0 * up], axis=-1)
    flat[inside, :2] += rng.uniform(-0.12, 0.12, (inside.sum(), 2))
    points = flat.reshape(-1, 3)
    faces = Delaunay(points[:, :2]).simplices
    laplacian = cotangent_laplacian(points, faces)
    flux = (laplacian @ points)[inside.ravel()]
    assert np.abs(flux).max() < 0.02  # a right angle's weight of none is raised to a thousandth
    larger = cotangent_laplacian(30.0 * points, faces)
    np.testing.assert_allclose(larger.toarray(), laplacian.toarray(), atol=1e-12)
    gradient = harmonic.surface_gradient(points, faces, points @ [2.0, -3.0, 0.0] + 7)
    assert gradient == pytest.approx(np.broadcast_to([2.0, -3.0, 0.0], gradient.shape), abs=1e-9)
    third = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, np.sqrt(0.75), 0.0]])
    assert cotangent_laplacian(third, np.array([[0, 1, 2]]))[0, 1] == pytest.approx(
        -0.5 / np.sqrt(3.0)
    )


class TestWeights:
    def test_linear_between_the_ends_of_a_cylinder(self):
        vertices, faces, around = cylinder()
        ends = [np.arange(around), np.arange(len(vertices) - around, len(vertices))]
        weights = harmonic_weights(vertices, faces, ends)
        expected = vertices[:, 2] / LENGTH
        # Diagonals of the right-angled triangles have cotangent 0 and are raised to a small
        # positive weight.
        assert weights[:, 1] == pytest.approx(expected, abs=1e-9)
        assert weights[:, 0] == pytest.approx(1 - expected, abs=1e-9)

    @pytest.mark.parametrize("shear", [0.0, 0.3, 0.8])
    def test_laws_hold_on_bad_triangles(self, shear):
        vertices, faces, around = cylinder(shear=shear)
        groups = [
            np.arange(5),
            np.arange(300, 310),
            np.arange(len(vertices) - around, len(vertices)),
        ]
        weights = harmonic_weights(vertices, faces, groups)
        assert weights.min() >= 0 and weights.max() <= 1
        assert weights.sum(axis=1) == pytest.approx(1, abs=1e-12)
        for k, group in enumerate(groups):
            assert np.array_equal(weights[group], np.broadcast_to(np.eye(3)[k], (len(group), 3)))
        laplacian = cotangent_laplacian(vertices, faces)
        assert abs(laplacian - laplacian.T).max() < 1e-12
        assert np.abs(laplacian @ np.ones(len(vertices))).max() < 1e-10
        off = laplacian.copy()
        off.setdiag(0)
        assert off.max() <= 0  # the maximum principle
        assert np.linalg.eigvalsh(laplacian.toarray())[0] > -1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-4, 1.1e-4, 0.03, 1.0, 3.0, np.pi])
def test_shared_motion_is_rigid(angle):
    points, motion = np.random.default_rng(5).normal(size=(30, 3)) * 40, pose(1, angle)
    weights = np.random.default_rng(6).dirichlet(np.ones(3), size=30)
    found = blended_motion(points, weights, np.array([motion] * 3))
    assert found == pytest.approx(moved(points, motion), abs=1e-6 if angle == np.pi else 1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 0.03, 1.0, 3.0])
def test_a_twist_moves_points_as_the_exponential_of_its_matrix(angle):
    rng = np.random.default_rng(8)
    points, velocity, axis = rng.normal(size=(3, 3))
    turn = angle * axis / np.linalg.norm(axis)
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), turn), velocity
    found = np.empty((1, 3))
    harmonic.exponential_loop(points[None], np.concatenate([turn, velocity])[None], found)
    assert found[0] - points == pytest.approx(
        (expm(twist) - np.eye(4))[:3] @ np.append(points, 1.0), abs=1e-14
    )
