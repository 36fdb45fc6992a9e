"""Laws of arithmetic on points and triangles, on a few of them."""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.fields import LevelField
from rbfmuscle.geometry.rest_frame import BoneFrame
from rbfmuscle.geometry.triangles import nearest_weights


def solid():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    return np.array(mesh.vertices) * [2.0, 1.0, 0.7] + [5.0, 0.0, 1.0], np.array(mesh.faces)


def test_a_field_less_a_level_is_zero_where_the_field_has_the_level():
    def ball(points):
        return np.linalg.norm(points, axis=1) - 1.0

    ball.value_and_gradient = lambda points: (ball(points), points)
    field, points = LevelField(ball, 0.5), np.array([[1.5, 0, 0], [0, 2.0, 0]])
    np.testing.assert_allclose(field(points), [0.0, 0.5])
    value, gradient = field.value_and_gradient(points)
    np.testing.assert_allclose(value, [0.0, 0.5])
    np.testing.assert_array_equal(gradient, points)


@pytest.mark.parametrize("scale", [1.0, 40.0])
def test_local_units_are_the_same_wherever_a_bone_is_and_however_large(scale):
    """A slab of three lengths, turned: its local vertices come back from every pose, and its box holds them."""
    turn = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
    vertices = scale * (np.array(trimesh.creation.box((5.0, 2.0, 1.0)).vertices) @ turn.T + [3.0, 1.0, -2.0])
    frame, pose = BoneFrame(vertices), np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.2, 0.9, -0.3]).as_matrix(), [10.0, -4.0, 7.0]
    placed = frame.placed(pose)
    world = vertices @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose((world - placed[:3, 3]) @ placed[:3, :3], frame.local, atol=1e-7)
    low, high = frame.box(np.array([vertices.min(axis=0), vertices.max(axis=0)]))
    assert (frame.local >= low - 1e-7).all() and (frame.local <= high + 1e-7).all()
    # Along its principal axes the slab fills its own box.
    sides = np.sort(np.ptp(frame.local, axis=0)) * frame.size
    np.testing.assert_allclose(sides, scale * np.array([1.0, 2.0, 5.0]), rtol=1e-5)


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
