"""Several bones in one set of arrays answer as each bone's own field does."""

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

from rbfmuscle.bones.obstacles import query_bone, stack_bones
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
