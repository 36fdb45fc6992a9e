"""Laws of the distance fields' loops on a few triangles, small enough to run without the
compiler."""

import igl
import numpy as np
import pytest
import trimesh

from rbfmuscle.bones.sdf import BoneSDF


def angle_iron():
    """A prism over an L: convex and hollow edges and corners, 20 triangles."""
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]])
    vertices = np.vstack([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.8)])
    walls = [[(i, j, j + 6), (i, j + 6, i + 6)] for i in range(6) for j in [(i + 1) % 6]]
    return vertices, np.vstack([caps[:, ::-1], caps + 6, np.concatenate(walls)])


SOLID = angle_iron()


@pytest.fixture(scope="module")
def field():
    return BoneSDF.from_mesh(SOLID)


def exact(points):
    found = igl.signed_distance(points, *SOLID, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    return found[0], found[2]


def around(seed):
    return np.random.default_rng(seed).uniform([-0.6] * 3, [2.6, 2.6, 1.4], (250, 3))


def test_distance_is_that_to_the_triangles_on_either_side_and_beside_edges_and_corners(field):
    vertices, faces = SOLID
    edges = trimesh.Trimesh(vertices, faces, process=False).edges_unique
    spots = np.vstack([vertices, vertices[edges].mean(axis=1)])
    step = 0.03 * np.random.default_rng(3).normal(size=(4, len(spots), 3))
    for points in (around(0), (spots + step).reshape(-1, 3)):
        distance, found = exact(points)[0], field.distance(points)
        assert (distance < 0).sum() > 20 and (distance > 0).sum() > 20
        np.testing.assert_allclose(found, distance, atol=1e-6)
        assert (np.sign(found) == np.sign(distance)).all()


def test_gradient_points_away_from_the_nearest_point_outside_and_to_it_inside(field):
    points = around(1)
    distance, nearest = exact(points)
    _, gradient = field.distance_and_gradient(points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)
    # Where two faces are equally near, either is right: the way back leads to the surface.
    back = points - field.distance(points)[:, None] * gradient
    np.testing.assert_allclose(exact(back)[0], 0.0, atol=1e-5)
    clear = np.abs(distance) > 0.05
    expected = (points - nearest) / np.where(distance == 0, 1.0, distance)[:, None]
    agree = np.linalg.norm(gradient - expected, axis=1)[clear] < 1e-4
    assert agree.mean() > 0.98
