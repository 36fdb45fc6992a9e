"""Which points of a bone a surface asks about: those in or right beside the cells that it visited, one by one."""

import itertools
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.implicit.extraction.obstacles import CHORD, ObstaclePoints, points_near_cells


def literal(points, pose, grid, state):
    """World points whose cell, or a cell within CHORD of them along each axis, was visited."""
    found = []
    for point in points @ pose[:3, :3].T + pose[:3, 3]:
        at = grid.axes @ (point - grid.origin) / grid.spacing
        if not all(1.0 <= at[k] <= grid.shape[k] - 2.0 for k in range(3)):
            continue
        sides = [{int(at[k] - CHORD), int(at[k] + CHORD)} for k in range(3)]
        if any(state.reshape(grid.shape)[cell] == 1 for cell in itertools.product(*sides)):
            found.append(point)
    return np.array(found)


def test_points_near_visited_cells_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    shape = (11, 9, 14)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.8]).as_matrix()
    grid = SimpleNamespace(
        axes=turn,
        origin=np.array([1.0, -2.0, 0.5]),
        spacing=0.7,
        shape=shape,
        strides=np.array([9 * 14, 14, 1]),
    )
    cells = rng.choice(np.prod(shape), 300, replace=False)
    state = np.zeros(np.prod(shape), dtype=np.int8)
    state[cells] = 1
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    local = rng.uniform(-1.0, 1.0, (700, 3)) * [8.0, 7.0, 9.0] + [5.5, 4.5, 7.0]
    world = local * 0.7 @ turn + grid.origin
    points = (world - pose[:3, 3]) @ pose[:3, :3]
    found = points_near_cells([(ObstaclePoints(points), pose)], grid, state, np.sort(cells))
    expected = literal(points, pose, grid, state)
    assert 30 < len(expected) < 400
    np.testing.assert_allclose(found, expected, atol=1e-12)
