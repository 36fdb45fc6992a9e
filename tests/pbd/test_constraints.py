"""Known answers of the mesh baseline: connections, colours, constraints, volume."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from constraint_values import constraint_values
from peers.paper_models import DeepestContact, project_volume

from pbd_baseline.constraints import (
    BendingConstraint,
    ContactConstraint,
    EdgeConstraint,
    VolumeConstraint,
)
from pbd_baseline.rest import even_weights
from pbd_baseline.topology import Topology, colour
from rbfmuscle.geometry.harmonic import harmonic_weights
from rbfmuscle.simulation.contact import HalfSpaces


def ellipsoid(subdivisions=3, axes=(3.0, 2.0, 1.0)):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.array(mesh.vertices) * axes, np.array(mesh.faces, dtype=np.int64)


@pytest.fixture
def body():
    vertices, faces = ellipsoid()
    return vertices, faces, Topology.from_mesh(vertices, faces)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def test_constraints_of_one_colour_share_no_vertex(body):
    _, _, topology = body
    members = np.column_stack([topology.edges, topology.wings])
    order, start = colour(members, np.ones(topology.vertex_count))
    assert sorted(order) == list(range(len(members)))
    for low, high in itertools.pairwise(start):
        used = members[order[low:high]]
        assert len(np.unique(used)) == used.size
        assert (np.diff(used.min(axis=1)) > 0).all()  # by the first vertex, for the cache


def test_constraints_at_one_vertex_take_as_many_colours_as_they_are():
    """More than there are bits in two numbers; no colour is left out."""
    members = np.column_stack([np.zeros(130, dtype=int), np.arange(1, 131)])
    order, start = colour(members, np.ones(131))
    assert sorted(order) == start[:-1].tolist() == list(range(130)) and start[-1] == 130


def test_icosahedron_has_thirty_edges_and_rings_of_five():
    mesh = trimesh.creation.icosahedron()
    topology = Topology.from_mesh(mesh.vertices, mesh.faces)
    edges, wings = topology.edges, topology.wings
    assert (
        np.array_equal(edges, np.unique(np.sort(mesh.edges, axis=1), axis=0)) and len(edges) == 30
    )
    turns = [np.roll(mesh.faces, shift, axis=1) for shift in range(3)]
    faces = {tuple(map(int, face)) for turned in turns for face in turned}
    for (i, j), (along, against) in zip(edges.tolist(), wings.tolist(), strict=True):
        assert (i, j, along) in faces and (j, i, against) in faces
    assert np.array_equal(np.diff(topology.ring_start), np.full(12, 5))
    for vertex in range(12):
        around = slice(topology.ring_start[vertex], topology.ring_start[vertex + 1])
        assert topology.ring[around].tolist() == sorted(mesh.vertex_neighbors[vertex])
        for other, edge in zip(topology.ring[around], topology.ring_edge[around], strict=True):
            assert sorted((vertex, other)) == edges[edge].tolist()


def test_a_sweep_over_a_mesh_is_one_edge_after_another(rng):
    vertices, faces = ellipsoid(1)
    topology = Topology.from_mesh(vertices, faces)
    given, mass = (
        vertices + 0.1 * rng.normal(size=vertices.shape),
        rng.uniform(0.5, 2.0, len(vertices)),
    )
    for family, extra in ((EdgeConstraint, ()), (BendingConstraint, (topology.wings,))):
        whole = family(vertices, topology.edges, *extra, mass, stiffness=0.7)
        swept, stepped = given.copy(), given.copy()
        whole.project(swept)
        for number in whole.order:
            parts = [part[[number]] for part in (topology.edges, *extra)]
            family(vertices, *parts, mass, stiffness=0.7).project(stepped)
        np.testing.assert_allclose(swept, stepped, atol=1e-12)
        assert np.abs(swept - given).max() > 1e-2


def test_only_constraints_between_held_vertices_are_left_out(body, rng):
    vertices, _, topology = body
    given = vertices + 0.1 * rng.normal(size=vertices.shape)
    mass = (vertices[:, 0] < 1.0).astype(float)
    for family, extra in ((EdgeConstraint, ()), (BendingConstraint, (topology.wings,))):
        members = np.column_stack([topology.edges, *extra])
        constraint = family(vertices, topology.edges, *extra, mass)
        live = mass[members].any(axis=1)
        assert sorted(constraint.order) == np.flatnonzero(live).tolist()
        assert constraint.colours[-1] == live.sum() < len(members)
        found = given.copy()
        constraint.project(found)
        moved = np.abs(found - given).max(axis=1)
        assert (moved[mass == 0.0] == 0.0).all() and (moved[mass > 0.0] > 0.0).all()


@pytest.mark.parametrize("number", [0, 100, 500])
@pytest.mark.parametrize("family", ["edge", "bending"])
def test_projection_follows_the_gradient(body, rng, family, number):
    vertices, _, topology = body
    points = vertices + 0.02 * rng.normal(size=vertices.shape)
    edge, wing = topology.edges[[number]], topology.wings[[number]]
    ones = np.ones(len(points))
    if family == "edge":
        constraint, members = EdgeConstraint(vertices, edge, ones), edge[0]
    else:
        constraint = BendingConstraint(vertices, edge, wing, ones, stiffness=1.0)
        members = np.concatenate([edge[0], wing[0]])
    gradient, step = np.zeros((len(members), 3)), 6e-6 * 3.0
    for a, d in np.ndindex(gradient.shape):
        ahead = np.zeros_like(points)
        ahead[members[a], d] = step
        after, before = (constraint_values(constraint, points + s * ahead)[0] for s in (1, -1))
        gradient[a, d] = (after - before) / (2 * step)
    moved = points.copy()
    constraint.project(moved)
    expected = -constraint_values(constraint, points)[0] * gradient / (gradient**2).sum()
    # central differences of step 2e-5 on values of order one
    np.testing.assert_allclose((moved - points)[members], expected, atol=1e-7)


def test_an_edge_without_stiffness_is_hard_beyond_its_limits():
    ends = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    for length, kept in ((1.0, 1.6), (1.8, 1.8), (3.0, 2.4)):
        points = ends * 0.5 * length
        edge = EdgeConstraint(
            ends, np.array([[0, 1]]), np.array([1.0, 3.0]), stiffness=0.0, limits=(0.8, 1.2)
        )
        edge.project(points)
        assert points[:, 0] == pytest.approx(
            [0.25 * (length - kept), 0.25 * (length - kept) + kept]
        )


def test_volume_gradient_agrees_with_differences_and_sums_to_nothing(body, rng):
    vertices, faces, _ = body
    constraint = VolumeConstraint(vertices, faces)
    gradient = constraint.gradient(vertices)
    direction = rng.normal(size=vertices.shape)
    step = 6e-6 * 3.0
    ahead, behind = (constraint.volume(vertices + sign * step * direction) for sign in (1, -1))
    assert (gradient * direction).sum() == pytest.approx((ahead - behind) / (2 * step), rel=1e-7)
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-13)
    np.testing.assert_allclose(np.cross(vertices, gradient).sum(axis=0), 0.0, atol=1e-12)


def test_volume_is_met_quadratically_and_by_restoring_in_one_step(rng):
    vertices, faces = ellipsoid(4)
    constraint = VolumeConstraint(vertices, faces)
    points, errors = vertices * [1.0, 0.9, 0.9], []
    project_volume(constraint, points, np.zeros(len(points)))  # which nothing can move
    for _ in range(4):
        errors.append(abs(constraint.volume(points) / constraint.rest - 1.0))
        project_volume(constraint, points, np.ones(len(points)))
    # 0.19, 1e-2, 4e-5, 3e-10; the gradient without its sixth would leave 0.16 after one step
    assert errors[0] == pytest.approx(0.19)
    assert errors[1] < 1.5e-2 and errors[2] < 1e-4 and errors[3] < 1e-8
    points = vertices * 0.9 + 0.01 * rng.normal(size=vertices.shape)
    constraint.restore(points, constraint.gradient(points))
    assert constraint.volume(points) == pytest.approx(constraint.rest, rel=1e-14)


def test_a_vertex_in_two_bones_moves_by_both_ways_or_by_the_longest_alone():
    spaces = HalfSpaces(np.zeros(2, int), np.array([-0.2, -0.5]), np.eye(3)[:2], np.arange(2))
    contacts = SimpleNamespace(half_spaces=lambda *given: spaces)
    for kind, wanted in (
        (ContactConstraint, [0.2, 0.5, 0.0]),
        (DeepestContact, [0.0, 0.5, 0.0]),
    ):
        constraint, points = kind(reach=1.0), np.zeros((1, 3))
        assert constraint.find(contacts, points) == constraint.depth(points) == 0.5
        constraint.project(points)
        np.testing.assert_allclose(points, [wanted], atol=1e-15)


def test_even_weights_stretch_less_than_harmonic_ones(body):
    vertices, faces, topology = body
    groups = [np.flatnonzero(vertices[:, 0] < -2.9), np.flatnonzero(vertices[:, 0] > 2.9)]
    even, harmonic = (
        even_weights(vertices, faces, groups),
        harmonic_weights(vertices, faces, groups),
    )
    i, j = topology.edges.T
    length = np.linalg.norm(vertices[i] - vertices[j], axis=1)
    steepest = [np.abs((w[i, 0] - w[j, 0]) / length).max() for w in (even, harmonic)]
    assert steepest[0] < 0.7 * steepest[1]
    np.testing.assert_allclose(even.sum(axis=1), 1.0)
    assert even.min() >= 0.0
    assert (even[groups[0], 0] == 1.0).all()
    np.testing.assert_allclose(even_weights(vertices, faces, groups[:1]), 1.0, atol=1e-12)


def test_weights_on_collapsed_triangles_are_finite_and_near_those_of_sound_ones():
    """Vertices in the middle of an edge opposite to them: triangles without area."""
    vertices, faces = ellipsoid()
    groups = [np.flatnonzero(vertices[:, 0] < -2.9), np.flatnonzero(vertices[:, 0] > 2.9)]
    sound = even_weights(vertices, faces, groups)
    for face in np.random.default_rng(2).choice(len(faces), 8, replace=False):
        if np.abs(vertices[faces[face, 0], 0]) < 2.5:
            vertices[faces[face, 0]] = vertices[faces[face, 1:]].mean(axis=0)
    found = even_weights(vertices, faces, groups)
    np.testing.assert_allclose(found.sum(axis=1), 1.0)
    # A few of 642 vertices were moved by up to an edge, which is a fifteenth of the distance
    # between the groups.
    assert np.abs(found - sound).max() < 0.15
