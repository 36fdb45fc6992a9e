"""Which points of a bone are near a surface's triangles."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.implicit.extraction.obstacles import BESIDE, PointGrid, near_triangles


def test_points_near_triangles_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=5.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)[ball.triangles_center[:, 0] > 0.0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    points = rng.uniform(-8.0, 8.0, (700, 3))
    found = near_triangles(
        [(PointGrid(points), pose), (PointGrid(points[:0]), pose)], vertices, faces, margin=0.8
    )
    corners = ((vertices - pose[:3, 3]) @ pose[:3, :3])[faces]
    inside = np.zeros((len(points), len(faces)), dtype=bool)
    for f, (a, b, c) in enumerate(corners):
        normal = np.cross(b - a, c - a)
        along = np.linalg.solve(
            np.column_stack([b - a, c - a, normal / np.linalg.norm(normal)]), (points - a).T
        )
        beside = np.minimum(np.minimum(along[0], along[1]), 1.0 - along[0] - along[1])
        low, high = corners[f].min(axis=0) - 0.8, corners[f].max(axis=0) + 0.8
        boxed = ((points >= low) & (points <= high)).all(axis=1)
        inside[:, f] = boxed & (np.abs(along[2]) <= 0.8) & (beside >= -BESIDE)
    rows = np.flatnonzero(inside.any(axis=1))
    assert 30 < len(rows) < 400
    world = points @ pose[:3, :3].T + pose[:3, 3]
    order = [int(np.argmin(np.linalg.norm(world[rows] - point, axis=1))) for point in found.points]
    np.testing.assert_allclose(found.points, world[rows][order], atol=1e-12)
    for p, row in enumerate(rows[order]):
        near = found.faces[found.first[p] : found.first[p + 1]]
        np.testing.assert_array_equal(near, np.flatnonzero(inside[row]))
