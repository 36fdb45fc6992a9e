"""Frames, boxes and B-splines by what they have to reproduce."""

import numpy as np
import pytest
import trimesh
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import across, box_size, to_local, to_world, unit
from rbfmuscle.geometry.frames import (
    RestFrame,
    box_corners,
    moved_box,
    numbered_by_place,
    on_one_line,
    principal_axes,
)
from rbfmuscle.geometry.interpolation import bspline_sum, bspline_weights
from rbfmuscle.geometry.lines import nearest_pieces
from rbfmuscle.geometry.mesh_distance import half_solid_angle, inside_test
from rbfmuscle.geometry.solids import SolidDistance, label_shells, outer_surface
from rbfmuscle.geometry.surfaces import clustered, simplified

POINTS = np.random.default_rng(4).normal(size=(60, 3)) * [9.0, 4.0, 1.5] + [3.0, -2.0, 8.0]
TURN = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()


def pose():
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = TURN, [5.0, -7.0, 11.0]
    return made


def test_vectors_and_frames_are_what_they_say():
    np.testing.assert_allclose(unit(np.array([[3.0, 0, 4.0], [0, 0, 0]])), [[0.6, 0, 0.8], [0] * 3])
    np.testing.assert_array_equal(across(np.array([1.0, 2.0, 3.0]), np.eye(3)[1]), [1.0, 0.0, 3.0])
    world = to_world(POINTS, pose())
    np.testing.assert_allclose(world, (TURN @ POINTS.T).T + [5.0, -7.0, 11.0])
    np.testing.assert_allclose(to_local(world, pose()), POINTS, atol=1e-12)
    assert box_size(np.array([[0.0, 0, 0], [2.0, -3.0, 6.0]])) == 7.0


def test_boxes_hold_what_they_held_after_a_motion_and_are_tight():
    bounds = np.array([[-1.0, 2.0, 3.0], [4.0, 5.0, 9.0]])
    corners = box_corners(bounds)
    assert len(np.unique(corners, axis=0)) == 8
    np.testing.assert_array_equal([corners.min(axis=0), corners.max(axis=0)], bounds)
    moved = to_world(corners, pose())
    found = moved_box(bounds, pose())
    np.testing.assert_allclose(found, [moved.min(axis=0), moved.max(axis=0)], atol=1e-12)
    many = moved_box(bounds, np.stack([np.eye(4), pose()]))
    np.testing.assert_allclose(many, [bounds, found], atol=1e-12)


def test_a_rest_frame_is_right_handed_and_moves_with_its_points():
    frame = RestFrame(POINTS)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(frame.points(frame.local), POINTS, atol=1e-7)  # rounded to 1e-8
    farthest = np.linalg.norm(POINTS - POINTS.mean(axis=0), axis=1)
    assert frame.size == farthest.max()
    np.testing.assert_allclose(frame.local[farthest.argmax()], [1.0, 0.0, 0.0], atol=1e-8)
    side = frame.local[np.linalg.norm(frame.local[:, 1:], axis=1).argmax()]
    assert side[1] > 0.0 and abs(side[2]) < 1e-7
    moved = RestFrame(2.0 * to_world(POINTS, pose()))
    np.testing.assert_array_equal(moved.local, frame.local)
    np.testing.assert_allclose(moved.directions(np.eye(3)), frame.axes @ TURN.T, atol=1e-12)
    chosen = frame.corners(np.arange(10))
    inside = (POINTS[:10] - frame.origin) @ frame.axes.T
    found = (chosen - frame.origin) @ frame.axes.T
    np.testing.assert_allclose(found.min(axis=0), inside.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(found.max(axis=0), inside.max(axis=0), atol=1e-6)


def test_numbers_by_place_depend_on_no_order_and_no_motion():
    ball = trimesh.creation.icosphere(2)
    vertices, faces = ball.vertices * (1.0 + 0.2 * POINTS[7:10, 0]), np.array(ball.faces)
    vertices = vertices + 0.1 * np.random.default_rng(6).normal(size=vertices.shape)
    order, numbered = numbered_by_place(vertices, faces)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(vertices)))
    # Each face is one of the mesh, from its least number on.
    given = {tuple(np.roll(row, k)) for row in faces.tolist() for k in range(3)}
    assert {tuple(row) for row in order[numbered].tolist()} <= given
    assert (numbered[:, :1] <= numbered).all() and len(numbered) == len(faces)
    rng = np.random.default_rng(7)
    place = rng.permutation(len(vertices))
    moved = np.empty_like(vertices)
    moved[place] = to_world(vertices, pose())
    turned = np.array([np.roll(row, rng.integers(3)) for row in place[faces]])
    again, same = numbered_by_place(moved, rng.permutation(turned))
    np.testing.assert_array_equal(again, place[order])
    np.testing.assert_array_equal(same, numbered)


def test_principal_axes_are_ordered_by_extent_and_right_handed():
    local = np.diag([5.0, 3.0, 1.0])
    found = principal_axes(np.vstack([local, -local]) @ TURN.T + 4.0)
    assert np.linalg.det(found) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(np.abs(found @ TURN), np.eye(3), atol=1e-12)
    assert on_one_line(np.outer([0.0, 1.0, 5.0], [1.0, 2.0, 3.0]) + 7.0)
    assert on_one_line(np.zeros((4, 3))) and not on_one_line(POINTS)


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_weights_are_those_of_cubic_b_splines_and_their_slopes(t):
    weights, slopes = bspline_weights(t)
    basis = BSpline.basis_element(np.arange(5.0))
    places = t + np.array([3.0, 2.0, 1.0, 0.0])
    np.testing.assert_allclose(weights, basis(places), atol=1e-15)
    np.testing.assert_allclose(slopes, basis.derivative()(places), atol=1e-15)


def test_sums_of_splines_are_linear_functions_of_linear_nodes():
    width, slope, start = 5, np.array([2.0, -3.0, 0.5]), np.array([1, 0, 1])
    nodes = np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1)
    blocks = np.stack([np.zeros(125), (nodes @ slope + 7.0).ravel()])
    first = int((start[0] * width + start[1]) * width + start[2])
    place = np.array([0.2, 0.7, 0.4])
    value, *gradient = bspline_sum(blocks, 1, first, width, *place)
    # The cell lies between the second and the third of the four nodes.
    assert value == pytest.approx(7.0 + slope @ (start + 1 + place), abs=1e-12)
    np.testing.assert_allclose(gradient, slope, atol=1e-12)


def test_winding_numbers_are_one_inside_and_nothing_outside():
    mesh = trimesh.creation.box((2.0, 4.0, 6.0))
    points = np.array([[0.0, 0, 0], [0.9, -1.9, 2.9], [1.1, 0, 0], [0, 2.2, 0], [5.0, 6.0, 7.0]])
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)

    def winding(point, faces):
        return sum(half_solid_angle(*(vertices[f] - point)) for f in faces) / (2.0 * np.pi)

    found = [winding(point, faces) for point in points]
    np.testing.assert_allclose(found, [1, 1, 0, 0, 0], atol=1e-12)
    # Above the middle of the lid of a box without it: the lid's solid angle is missing.
    lid = np.abs(mesh.face_normals[:, 2] - 1.0) < 1e-9
    angle = 4.0 * np.arcsin(1.0 * 2.0 / np.sqrt((1.0 + 9.0) * (4.0 + 9.0)))
    open_box = winding(points[0], faces[~lid])
    assert open_box == pytest.approx(1.0 - angle / (4.0 * np.pi), abs=1e-12)
    assert inside_test(vertices, faces)(points).tolist() == [True, True, False, False, False]


def boxes(*middles, size=2.0):
    parts = [trimesh.creation.box([size] * 3).apply_translation(m) for m in middles]
    joined = trimesh.util.concatenate(parts)
    return np.array(joined.vertices), np.array(joined.faces)


def test_shells_are_told_apart_and_their_union_has_its_volume():
    apart, overlapping = [[0.0, 0, 0], [5.0, 0, 0]], [[0.0, 0, 0], [1.5, 0, 0]]
    number, whole = label_shells(boxes(*apart)[1])
    assert whole and number.tolist() == [0] * 12 + [1] * 12
    assert not label_shells(boxes(*apart)[1][1:])[1]
    for middles, wanted, said in ((apart, 16.0, 0), (overlapping, 14.0, 1)):
        vertices, faces, notes = outer_surface(*boxes(*middles))
        made = trimesh.Trimesh(vertices, faces, process=False)
        assert made.volume == pytest.approx(wanted, abs=1e-9) and len(notes) == said


def test_a_solid_is_negative_inside_whatever_the_winding_and_what_it_holds():
    vertices, faces = boxes([0.0, 0, 0])
    inner = 0.5 * vertices
    for order in (1, -1):
        both = np.concatenate([faces[:, ::order], faces + 8])
        solid = SolidDistance(np.concatenate([vertices, inner]), both)
        found = solid.signed([[0.0, 0, 0], [0.9, 0, 0], [1.5, 0, 0]])
        np.testing.assert_allclose(found, [-1.0, -0.1, 0.5], atol=1e-12)


def test_coarser_meshes_have_the_triangles_asked_for_and_nearly_the_volume():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    for make, least in ((simplified, 500), (clustered, 300)):
        vertices, faces = make(ball.vertices, ball.faces, 500)
        assert least <= len(faces) <= 650
        made = trimesh.Trimesh(vertices, faces, process=False)
        assert made.volume == pytest.approx(ball.volume, rel=0.05)  # flat over a tenth of the size
        same = make(ball.vertices, ball.faces, len(ball.faces))
        np.testing.assert_array_equal(same[1], ball.faces)


def test_nearest_pieces_of_lines_have_their_directions_and_inverse_distances():
    lines = [np.array([[0.0, 0, 0], [2.0, 0, 0]]), np.array([[0.0, 5.0, 0], [0.0, 9.0, 0]])]
    directions, shares = nearest_pieces(np.array([[1.0, 3.0, 0.0], [1.0, 3.0, 4.0]]), lines, 3)
    np.testing.assert_allclose(directions, [[[1, 0, 0], [0, 1, 0]]] * 2, atol=1e-15)
    near, far = np.array([9.0, 17.0]), np.array([25.0, 33.0])
    np.testing.assert_allclose(shares, 1.0 / np.sqrt([near, far]))
