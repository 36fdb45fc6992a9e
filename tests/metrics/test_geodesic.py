"""The shortest path over bones between a muscle's ends, against closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.tubes import line_length
from rbfmuscle.metrics.centreline import shortest_path
from rbfmuscle.metrics.mesh_distance import BoneProbe

RADIUS, FAR = 10.0, 25.0


def ball():
    return BoneProbe("ball", trimesh.creation.icosphere(5, RADIUS))


def over_the_ball(height):
    """Points from one side of the ball to the other, over it for a positive height."""
    x = np.linspace(-FAR, FAR, 20)
    return np.stack([x, np.zeros(20), height * (1 - (x / FAR) ** 2)], axis=1)


@pytest.mark.parametrize("height", [20.0, -20.0, 12.0])
def test_string_over_a_ball_is_two_tangents_and_an_arc(height):
    motion = np.eye(4)  # of the whole scene
    motion[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    motion[:3, 3] = 3.0, -7.0, 11.0
    line = trimesh.transform_points(over_the_ball(height), motion)
    path = shortest_path(line, [ball()], {"ball": motion})
    path = trimesh.transform_points(path, np.linalg.inv(motion))
    tangent = np.sqrt(FAR**2 - RADIUS**2)
    wrapped = 2 * tangent + RADIUS * (np.pi - 2 * np.arctan2(tangent, RADIUS))
    # 33 nodes cut the arc's corners, and the ball has facets: a thousandth of the length.
    assert line_length(path) == pytest.approx(wrapped, rel=1e-3)
    assert np.sign(path[len(path) // 2, 2]) == np.sign(height)
    assert np.linalg.norm(path[1:-1], axis=1).min() > 0.995 * RADIUS
    away = np.eye(4)  # with nothing between it is straight
    away[:3, 3] = 0.0, 40.0, 0.0
    for probes, poses in (([], {}), ([ball()], {"ball": away})):
        path = shortest_path(over_the_ball(height), probes, poses)
        assert line_length(path) == pytest.approx(2 * FAR, rel=1e-12)
