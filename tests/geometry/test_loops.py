"""Laws of arithmetic on points and triangles, on a few of them."""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.triangles import nearest_weights
from rbfmuscle.geometry.winding import wound_around


def solid():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    return np.array(mesh.vertices) * [2.0, 1.0, 0.7] + [5.0, 0.0, 1.0], np.array(mesh.faces)


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
