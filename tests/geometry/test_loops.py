"""Laws of arithmetic on points and triangles, on a few of them."""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.surfaces import touching_balls
from rbfmuscle.geometry.triangles import nearest_weights
from rbfmuscle.geometry.winding import wound_around


def solid():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    return np.array(mesh.vertices) * [2.0, 1.0, 0.7] + [5.0, 0.0, 1.0], np.array(mesh.faces)


def literal_balls(points, normals):
    """Radii of the balls that touch point i along its normal and pass through point j, the least on each side."""
    steps, nearest = np.full((2, len(points)), np.inf), np.empty(len(points))
    for i, (p, n) in enumerate(zip(points, normals)):
        others = np.delete(points, i, axis=0) - p
        nearest[i] = np.linalg.norm(others, axis=1).min()
        along = others @ n
        radius = (others**2).sum(axis=1) / (2 * np.abs(np.where(along == 0, np.nan, along)))
        for side, which in ((0, along > 0), (1, along < 0)):
            if which.any():
                steps[side, i] = radius[which].min()
    return steps, nearest


def test_touching_balls_are_those_of_the_definition_and_of_the_sphere():
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(2, 9, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    steps, nearest = np.empty((2, 9)), np.empty(9)
    touching_balls(points, normals, steps, nearest)
    expected = literal_balls(points, normals)
    np.testing.assert_allclose(steps, expected[0])
    np.testing.assert_allclose(nearest, expected[1])
    sphere = np.array(trimesh.creation.icosphere(subdivisions=1).vertices)
    steps, nearest = np.empty((2, len(sphere))), np.empty(len(sphere))
    touching_balls(3.0 * sphere, sphere, steps, nearest)
    assert np.isinf(steps[0]).all()  # nothing lies beyond a tangent plane
    np.testing.assert_allclose(steps[1], 3.0)  # the ball inside is the sphere
    # Two sheets 3 apart, each vertex above another.
    grid = np.stack(np.meshgrid(*[np.arange(-8.0, 9.0)] * 2, [-1.5, 1.5]), axis=-1).reshape(-1, 3)
    steps, nearest = np.empty((2, len(grid))), np.empty(len(grid))
    touching_balls(grid, np.sign(grid) * (0.0, 0.0, 1.0), steps, nearest)
    np.testing.assert_allclose(steps[1], 1.5)


def test_a_mesh_winds_around_what_is_inside_it_and_once_only():
    vertices, faces = solid()
    points = np.array([[5.2, 0.1, 1.1], [8.0, 0.3, 1.0]])
    for triangles, expected in ((faces, [True, False]), (faces[:, ::-1], [False, False])):
        found = np.empty(2, dtype=bool)
        wound_around(points, vertices, np.ascontiguousarray(triangles), found)
        np.testing.assert_array_equal(found, expected)


def test_nearest_point_of_a_triangle_is_a_mean_of_its_corners_in_every_region():
    rng = np.random.default_rng(3)
    seen = set()
    for a, b, c, p in rng.normal(size=(4000, 4, 3)) * np.array([1.0, 1.0, 1.0, 2.0])[:, None]:
        weights = np.full(3, np.nan)
        nearest_weights(p, a, b, c, weights)
        assert weights.min() >= 0.0 and weights.sum() == pytest.approx(1.0)
        squared = igl.point_mesh_squared_distance(p[None], np.array([a, b, c]), np.array([[0, 1, 2]]))[0]
        assert ((weights @ [a, b, c] - p) ** 2).sum() == pytest.approx(float(np.ravel(squared)[0]), rel=1e-9)
        seen.add(tuple(weights > 0.0))
    assert len(seen) == 7, "three corners, three edges, the inside"


@pytest.mark.parametrize("seed", range(3))
def test_crossings_turn_with_the_surface(seed):
    """Two balls that reach into each other, as one surface: whichever way the axes lie, the same triangles cross."""
    one, two = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2, radius=0.8)
    vertices = np.vstack([one.vertices, two.vertices + [0.9, 0.2, 0.1]])
    faces = np.vstack([one.faces, two.faces + len(one.vertices)])
    found = FaceTree(vertices, faces).crossing(vertices)
    assert found.sum() > 10
    turned = Rotation.random(random_state=seed).apply(vertices)
    np.testing.assert_array_equal(FaceTree(turned, faces).crossing(turned), found)
