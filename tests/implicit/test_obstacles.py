"""Which points of a bone are near a surface's triangles."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.implicit.extraction.obstacles import NEAR, points_near_faces


def test_points_near_faces_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=5.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    points = rng.uniform(-8.0, 8.0, (700, 3))
    faces = np.asarray(ball.faces)[ball.triangles_center[:, 0] > 0.0]
    found = points_near_faces([(points, pose), (points[:0], pose)], np.asarray(ball.vertices), faces, 0.8)
    world = points @ pose[:3, :3].T + pose[:3, 3]
    away = np.linalg.norm(world[:, None] - ball.vertices[faces].mean(axis=1), axis=2).min(axis=1)
    expected = world[away < NEAR * 0.8]
    assert 30 < len(expected) < 400
    np.testing.assert_allclose(found, expected, atol=1e-12)
