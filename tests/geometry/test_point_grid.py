"""Points near triangles, and triangles moved off points."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.point_grid import BESIDE, MARGIN, PointGrid, _near_loop, push_off


def test_points_near_triangles_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=5.0)
    vertices, faces = (
        np.asarray(ball.vertices),
        np.asarray(ball.faces)[ball.triangles_center[:, 0] > 0.0],
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    points = rng.uniform(-8.0, 8.0, (700, 3))
    local = (vertices - pose[:3, 3]) @ pose[:3, :3]
    grid, pairs = PointGrid.of(points), np.empty((20_000, 2), dtype=np.int64)
    some = np.arange(len(faces))

    def near(of):
        return _near_loop(vertices, faces, some, pose, of, pairs)

    assert near(PointGrid.of(points[:0])) == 0
    met = near(grid)
    found = np.zeros((len(points), len(faces)), dtype=bool)
    found[grid.number[pairs[:met, 0]], pairs[:met, 1]] = True
    corners = local[faces]
    inside = np.zeros((len(points), len(faces)), dtype=bool)
    for f, (a, b, c) in enumerate(corners):
        normal = np.cross(b - a, c - a)
        frame = np.column_stack([b - a, c - a, normal / np.linalg.norm(normal)])
        along = np.linalg.solve(frame, (points - a).T)
        beside = np.minimum(np.minimum(along[0], along[1]), 1.0 - along[0] - along[1])
        sides = np.linalg.norm([a - b, b - c, c - a], axis=1)
        margin = MARGIN * sides.max()
        low, high = corners[f].min(axis=0) - margin, corners[f].max(axis=0) + margin
        boxed = ((points >= low) & (points <= high)).all(axis=1)
        inside[:, f] = boxed & (np.abs(along[2]) <= margin) & (beside >= -BESIDE)
    assert 30 < inside.any(axis=1).sum() < 400
    np.testing.assert_array_equal(found, inside)
    some = some[::2]
    met = near(grid)
    assert set(pairs[:met, 1]) == set(some[inside.any(axis=0)[some]])


def test_points_that_came_through_end_on_the_surface_and_the_way_fades_where_they_are_deep():
    ball = trimesh.creation.icosphere(2)
    faces, edge = np.asarray(ball.faces), float(ball.edges_unique_length.max())
    middle, normal = ball.triangles_center[5], ball.face_normals[5]
    ways = []
    for depth in np.linspace(0.0, 0.4, 81) * edge:
        vertices, moved = np.array(ball.vertices), np.zeros(len(ball.vertices), dtype=bool)
        grid = PointGrid.of((middle - depth * normal)[None])
        push_off(vertices, faces, grid, np.eye(4), edge, moved)
        left = trimesh.proximity.signed_distance(
            trimesh.Trimesh(vertices, faces), middle[None] - depth * normal
        )[0]
        if depth < 0.2 * edge:
            assert left < 0.0101 * edge
        ways.append(np.linalg.norm(vertices - ball.vertices, axis=1).max() / edge)
        assert moved.any() == (ways[-1] > 0.0)
    assert ways[-1] == 0.0 and max(ways) > 0.2
    # Steps of 0.005 edges, of which a deeper point's triangle takes a few times as much.
    assert np.abs(np.diff(ways)).max() < 0.05


def test_each_point_has_its_triangle_also_exactly_below_an_edge_or_a_corner():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    for x, y in ((0.3, 0.3), (0.5, 0.5)):
        shown, moved = vertices.copy(), np.zeros(5, dtype=bool)
        push_off(shown, faces, PointGrid.of(np.array([[x, y, -0.05]])), np.eye(4), 1.0, moved)
        assert shown[4, 2] < -0.02
    shown, moved = vertices.copy(), np.zeros(5, dtype=bool)
    both = PointGrid.of(np.array([[0.15, 0.5, -0.05], [0.85, 0.5, -0.05]]))
    push_off(shown, faces, both, np.eye(4), 1.0, moved)
    assert moved.all() and (shown[:4, 2] < -0.01).all()
