"""Lines of points, tubes about them, and taut lines over obstacles, by closed forms."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.frames import diameter
from rbfmuscle.geometry.lines import (
    STEEPEST,
    distance_along,
    line_length,
    points_along,
    taut_line,
    tube_mesh,
)

CORNER = np.array([[0.0, 0, 0], [3.0, 0, 0], [3.0, 4.0, 0]])
UP = np.array([0.0, 1.0, 0.0])
ENDS = np.array([[10.0, 5.0, 0.0], [110.0, 5.0, 0.0]])


def test_distances_along_a_line():
    assert distance_along(CORNER).tolist() == [0.0, 3.0, 7.0] and line_length(CORNER) == 7.0
    found = points_along(CORNER, np.array([-1.0, 1.5, 3.0, 5.0, 9.0]))
    wanted = [[0, 0, 0], [1.5, 0, 0], [3, 0, 0], [3, 2, 0], [3, 4, 0]]
    np.testing.assert_allclose(found, wanted, atol=1e-15)


@pytest.mark.parametrize("sides", [3, 12])
@pytest.mark.parametrize("direction", [[1.0, 0, 0], [0.0, 0, -2.0], [1.0, 2.0, 3.0]])
def test_a_straight_tube_is_a_closed_prism(sides, direction):
    line = np.linspace(0.0, 1.0, 5)[:, None] * np.array(direction) + 1.0
    vertices, faces = tube_mesh(line, np.full(5, 0.5), sides)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    area = 0.5 * sides * np.sin(2.0 * np.pi / sides) * 0.5**2
    assert mesh.volume == pytest.approx(area * np.linalg.norm(direction), rel=1e-12)


def test_rings_of_a_tube_have_their_radius_and_lie_across_the_line():
    angles = np.linspace(0.0, 1.5, 40)
    line = 30.0 * np.stack([np.cos(angles), np.sin(angles), 0.2 * angles], axis=1)
    radii = np.linspace(1.0, 3.0, 40)
    vertices, faces = tube_mesh(line, radii, 8)
    rings = vertices[:-2].reshape(40, 8, 3) - line[:, None]
    np.testing.assert_allclose(np.linalg.norm(rings, axis=2), np.tile(radii[:, None], 8))
    ahead = np.gradient(line, axis=0)
    across = np.einsum("nsk,nk->ns", rings, ahead) / np.linalg.norm(ahead, axis=1)[:, None]
    assert np.abs(across).max() < 1e-12
    # Neighbouring rings do not twist: a spoke turns as the line does, here 0.04 a step.
    spokes = rings[:, 0] / radii[:, None]
    assert np.linalg.norm(np.diff(spokes, axis=0), axis=1).max() < 0.045
    np.testing.assert_array_equal(vertices[-2:], line[[0, -1]])
    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0.0


def test_without_an_obstacle_a_line_is_straight():
    for place in ([60.0, 4.0, 0.0], [5.0, 30.0, 0.0], [120.0, 30.0, 0.0]):
        line = taut_line(*ENDS, UP, [(np.eye(4), np.array([place]))], 10.0)
        np.testing.assert_array_equal(line[[0, -1]], ENDS)
        assert line_length(line) == pytest.approx(100.0, abs=1e-12)


def test_a_line_passes_over_a_point_that_is_lower_the_farther_aside():
    for aside in (0.0, 6.0, -6.0):
        line = taut_line(*ENDS, UP, [(np.eye(4), np.array([[50.0, 25.0, aside]]))], 10.0)
        np.testing.assert_allclose(line[1], [50.0, 25.0 - aside**2 / 20.0, 0.0])
    # The same in the frame of a bone that has moved.
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [7.0, -3.0, 2.0]
    local = (np.array([[50.0, 25.0, 6.0]]) - pose[:3, 3]) @ pose[:3, :3]
    line = taut_line(*ENDS, UP, [(pose, local)], 10.0)
    np.testing.assert_allclose(line[1], [50.0, 25.0 - 1.8, 0.0])


def test_a_line_leaves_its_ends_no_steeper_than_the_limit():
    for along in (10.0, 90.0):  # from the start; the same from the end
        near = min(along, 100.0 - along)
        top = STEEPEST * near
        place = np.array([[10.0 + along, 5.0 + top + 4.0, 0.0]])
        line = taut_line(*ENDS, UP, [(np.eye(4), place)], 10.0)
        np.testing.assert_allclose(line[1], [10.0 + along, 5.0 + top - 4.0, 0.0])


def test_a_line_over_a_cylinder_has_the_length_of_tangents_and_arc():
    angles = np.linspace(0.0, np.pi, 2001)
    radius, reach = 20.0, 50.0
    bone = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    ends = np.array([[-reach, 0, 0], [reach, 0, 0]])
    line = taut_line(*ends, UP, [(np.eye(4), bone)], 10.0)
    turn = np.arcsin(radius / reach)
    wanted = 2.0 * np.sqrt(reach**2 - radius**2) + 2.0 * radius * turn
    # A polygon of 0.0016 radian a side is shorter by a share of 1e-7.
    assert line_length(line) == pytest.approx(wanted, rel=1e-6)
    assert (np.diff(line[:, 0]) > 0.0).all()


def test_diameter_of_a_box_is_its_diagonal_wherever_it_lies():
    box = np.asarray(trimesh.creation.box((2.0, 3.0, 6.0)).vertices)
    # Vertices may be moved by 1e-12 of the size.
    assert diameter(box + 100.0) == pytest.approx(7.0, rel=1e-11)
