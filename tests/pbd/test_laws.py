"""Laws of the mesh baseline's parts: the rest costs nothing, half a way twice is the whole way."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pbd_baseline.arap import ARAP, ARAPConstraint
from pbd_baseline.contact import ContactConstraint, _keep_deepest
from pbd_baseline.motion import carry
from pbd_baseline.muscle import _contact_carriers
from pbd_baseline.topology import Topology
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.sim.loop.contact import HalfSpaces
from rbfmuscle.sim.scene.motion import rotation_about


@pytest.fixture
def rest():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(mesh.vertices) * [3.0, 2.0, 1.0]
    return vertices, Topology.from_mesh(vertices, mesh.faces)


def test_rest_is_a_minimum_before_any_rotation_was_fitted(rest):
    vertices, topology = rest
    arap = ARAP(vertices, topology)
    assert arap.energy(vertices) < 1e-25
    np.testing.assert_allclose(arap.gradient(vertices), 0.0, atol=1e-12)
    points, constraint = vertices.copy(), ARAPConstraint(arap)
    constraint.project(points, np.ones(len(points)))
    np.testing.assert_allclose(points, vertices, atol=1e-13)
    arap.fit_rotations(vertices)
    np.testing.assert_allclose(arap.quaternions[:, 0], 1.0, atol=1e-12)


def test_energy_grows_with_the_square_of_a_stretch(rest):
    """Rotations stay where they are when a shape grows evenly, so E is quadratic in the growth."""
    vertices, topology = rest
    arap = ARAP(vertices, topology)
    small, large = (arap.energy(vertices * (1.0 + s)) for s in (0.01, 0.03))
    assert large == pytest.approx(9.0 * small, rel=1e-9)


def motion():
    """A turn about a line that misses the origin, and a way along it."""
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    turn = rotation_about(axis, 0.8, np.array([30.0, -20.0, 10.0]))
    turn[:3, 3] += 4.0 * axis
    return turn


def test_whole_weight_carries_rigidly_and_none_leaves_in_place():
    points = np.random.default_rng(0).normal(size=(6, 3)) * 10.0
    weights = np.repeat([[0.0, 1.0], [1.0, 0.0]], 3, axis=0)
    moved = points.copy()
    carry(moved, weights, np.array([np.eye(4), motion()]))
    turn = motion()
    np.testing.assert_allclose(moved[:3], points[:3] @ turn[:3, :3].T + turn[:3, 3], atol=1e-12)
    np.testing.assert_array_equal(moved[3:], points[3:])


def test_half_the_way_twice_is_the_whole():
    points = np.random.default_rng(1).normal(size=(8, 3)) * 10.0
    moved, motions = points.copy(), np.array([np.eye(4), motion()])
    for _ in range(2):
        carry(moved, np.full((8, 2), 0.5), motions)
    whole = points.copy()
    carry(whole, np.tile([0.0, 1.0], (8, 1)), motions)
    np.testing.assert_allclose(moved, whole, atol=1e-12)


@pytest.mark.parametrize(
    "turn", [motion(), rotation_about([0, 0, 1], 1e-14, np.zeros(3))], ids=["far", "tiny"]
)
def test_one_moving_bone_is_the_general_blend(turn):
    points = np.random.default_rng(2).normal(size=(50, 3)) * 10.0
    share = np.random.default_rng(3).uniform(0, 1, (50, 1))
    weights, motions = np.hstack([1.0 - share, share]), np.array([np.eye(4), turn])
    moved = points.copy()
    carry(moved, weights, motions)
    np.testing.assert_allclose(moved, blended_motion(points, weights, motions), atol=1e-10)


def test_a_shift_alone_is_shared_out():
    shift = np.eye(4)
    shift[:3, 3] = [1.0, 2.0, 3.0]
    points = np.zeros((1, 3))
    carry(points, np.array([[0.75, 0.25]]), np.array([np.eye(4), shift]))
    np.testing.assert_allclose(points, [[0.25, 0.5, 0.75]])


def test_nothing_moves_where_no_bone_does():
    points = np.random.default_rng(4).normal(size=(5, 3))
    moved = points.copy()
    carry(moved, np.full((5, 2), 0.5), np.array([np.eye(4), np.eye(4)]))
    np.testing.assert_array_equal(moved, points)


class Floor:
    """Every point sees the plane z = 0."""

    def half_spaces(self, points, reach):
        count = len(points)
        return HalfSpaces(
            np.arange(count),
            points[:, 2].copy(),
            np.tile([0.0, 0.0, 1.0], (count, 1)),
            np.zeros(count, np.int64),
        )


def floor_contact(points):
    """A vertex, and the middle of the edge to its neighbour, above the floor."""
    columns = np.array([[0, 0, 0], [0, 1, 1]])
    shares = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
    contact = ContactConstraint(columns, shares, reach=5.0)
    contact.find(Floor(), points)
    return contact


POINTS = np.array([[0.0, 0.0, 0.1], [2.0, 0.0, 0.3]])
DOWN = np.array([[1.0, 2.0, -1.0], [0.5, 0.0, -1.0]])


@pytest.mark.parametrize("step", [1.0, -1.0])
def test_a_way_into_a_half_space_is_cleared_and_the_way_along_it_stays(step):
    contact, direction = floor_contact(POINTS), step * DOWN
    before = direction.copy()
    assert contact.clear_way(POINTS, direction, step)
    placed = contact.place(POINTS + step * direction)
    assert placed[:, 2].min() >= -1e-12
    np.testing.assert_array_equal(direction[:, :2], before[:, :2])
    assert not contact.clear_way(POINTS, direction, step), "what is clear stays"


@pytest.mark.parametrize(
    ("step", "sign"), [(0.0, 1.0), (1.0, -1.0), (0.01, 1.0)], ids=["none", "away", "short"]
)
def test_a_way_that_leads_into_nothing_stays(step, sign):
    contact, direction = floor_contact(POINTS), sign * DOWN
    before = direction.copy()
    assert not contact.clear_way(POINTS, direction, step)
    np.testing.assert_array_equal(direction, before)


def test_a_way_without_contacts_stays():
    contact = ContactConstraint(np.zeros((1, 3), dtype=int), np.array([[1.0, 0.0, 0.0]]), reach=5.0)
    direction = DOWN.copy()
    assert not contact.clear_way(POINTS, direction, 1.0) and contact.depth(POINTS) == 0.0
    np.testing.assert_array_equal(direction, DOWN)
    assert contact.project(POINTS.copy()) == 0.0


def test_contact_points_are_vertices_and_the_middles_of_edges_and_faces(rest):
    vertices, topology = rest
    body = SimpleNamespace(vertices=vertices, topology=topology)
    columns, shares = _contact_carriers(body, faces_too=True)
    placed = ContactConstraint(columns, shares, reach=1.0).place(vertices)
    middles = [vertices, vertices[topology.edges].mean(axis=1), vertices[topology.faces].mean(axis=1)]
    np.testing.assert_allclose(placed, np.concatenate(middles), atol=1e-14)
    alone = ContactConstraint(*_contact_carriers(body, faces_too=False), reach=1.0)
    np.testing.assert_array_equal(alone.place(vertices), vertices)


def test_nearest_response_keeps_the_deepest_of_each_point_alone():
    depth = np.array([0.2, 0.5, 0.1, 0.3])
    _keep_deepest(np.array([0, 0, 1, 3]), depth, 4)
    np.testing.assert_array_equal(depth, [0.0, 0.5, 0.1, 0.3])
