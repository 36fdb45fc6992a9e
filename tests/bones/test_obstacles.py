"""Several bones in one set of arrays answer as each bone's own field does."""

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

from rbfmuscle.bones.obstacles import nearest_bone, query_bone, stack_bones
from rbfmuscle.bones.sdf import BoneSDF


@pytest.fixture(scope="module")
def bones():
    """Three bones of different sizes and shapes, their poses, and points about them."""
    rng = np.random.default_rng(8)
    ball = trimesh.creation.icosphere(3, 10.0)
    box = trimesh.creation.box((8.0, 4.0, 30.0))
    ring = trimesh.creation.torus(12.0, 3.0)
    fields = [BoneSDF.from_mesh(mesh, cache=False) for mesh in (ball, box, ring)]
    poses = np.array([rotation_matrix(0.3 + k, rng.normal(size=3)) for k in range(3)])
    poses[:, :3, 3] = [[0.0, 0.0, 0.0], [25.0, 0.0, 3.0], [-5.0, 30.0, 0.0]]
    return fields, poses, rng.uniform(-30.0, 45.0, (400, 3))


def test_each_bone_answers_as_its_own_field(bones):
    fields, poses, points = bones
    stacked, reach = stack_bones(fields), np.full(len(points), np.inf)
    for b, field in enumerate(fields):
        distance, gradient = np.empty(len(points)), np.empty_like(points)
        query_bone(stacked, b, poses[b], points, reach, distance, gradient)
        wanted, slope = field.distance_and_gradient(points, poses[b])
        assert np.allclose(distance, wanted, rtol=0.0, atol=1e-12)
        # The field's gradient has the length that single precision gives it, here it is one.
        assert np.allclose(gradient, slope, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("limit", [np.inf, 6.0, -1.0])
def test_nearest_bone_is_the_least_distance_within_reach(bones, limit):
    fields, poses, points = bones
    distance, gradient = np.empty(len(points)), np.empty_like(points)
    which = np.empty(len(points), np.int64)
    reach = np.full(len(points), limit)
    nearest_bone(stack_bones(fields), poses, points, reach, distance, gradient, which)
    every = np.array([field.distance(points, pose) for field, pose in zip(fields, poses)])
    inside = every.min(axis=0) <= limit
    assert 0 < inside.sum() <= len(points)
    assert np.array_equal(which >= 0, inside)
    assert np.array_equal(which[inside], every.argmin(axis=0)[inside])
    assert np.allclose(distance[inside], every.min(axis=0)[inside], rtol=0.0, atol=1e-12)
    assert (distance[~inside] > limit).all()
    assert (distance[~inside] <= every.min(axis=0)[~inside] + 1e-5).all()
    assert np.allclose(np.linalg.norm(gradient, axis=1), inside)
