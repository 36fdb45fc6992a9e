"""Laws of the mesh baseline's parts: the rest costs nothing, half a way twice is the whole way."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pbd_baseline.constraints import _cubic_step
from pbd_baseline.rest import _inner_balls
from pbd_baseline.shapes import ARAP, ARAPShape
from pbd_baseline.topology import Topology


def energy(arap, points):
    """E(x) = 1/4 sum of w_ij (|e_ij - R_i E_ij|² + |e_ij - R_j E_ij|²) over the edges, with the
    present rotations.
    """
    i, j = arap.topology.edges.T
    turns = Rotation.from_quat(arap.quaternions[:, [1, 2, 3, 0]])
    apart = points[i] - points[j]
    misfit = sum(((apart - turns[k].apply(arap.rest)) ** 2).sum(axis=1) for k in (i, j))
    return 0.25 * float(arap.weights @ misfit)


def gradient(arap, points):
    """Its derivative by the points with the rotations frozen, as the global step has it."""
    return arap.laplacian @ points - arap.targets()


@pytest.fixture
def rest():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(mesh.vertices) * [3.0, 2.0, 1.0]
    return vertices, Topology.from_mesh(vertices, mesh.faces)


def arap_shape(vertices, topology, mass):
    known = {"vertices": vertices, "topology": topology, "inverse_mass": mass}
    return ARAPShape(SimpleNamespace(**known, volume=None, room=None), None)


def test_rest_is_a_minimum_before_any_rotation_was_fitted(rest):
    vertices, topology = rest
    shape = arap_shape(vertices, topology, np.ones(len(vertices)))
    arap = shape.arap
    assert energy(arap, vertices) < 1e-25
    np.testing.assert_allclose(gradient(arap, vertices), 0.0, atol=1e-12)
    points = vertices.copy()
    shape.project(points, 1.0)
    np.testing.assert_allclose(points, vertices, atol=1e-13)
    arap.fit_rotations(vertices)
    np.testing.assert_allclose(arap.quaternions[:, 0], 1.0, atol=1e-12)


def test_rotations_of_a_turned_shape_are_its_turn_and_leave_no_energy(rest):
    vertices, topology = rest
    arap, turn = ARAP(vertices, topology), Rotation.from_rotvec([0.3, -0.4, 0.2])
    turned = turn.apply(vertices) + [5.0, 6.0, 7.0]
    assert energy(arap, turned) > 1.0
    arap.fit_rotations(turned)
    wanted = turn.as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(arap.quaternions, np.tile(wanted, (len(vertices), 1)), atol=1e-9)
    assert energy(arap, turned) < 1e-15
    np.testing.assert_allclose(gradient(arap, turned), 0.0, atol=1e-8)


def test_arap_gradient_with_frozen_rotations_is_the_whole_gradient(rest):
    vertices, topology = rest
    arap, rng = ARAP(vertices, topology), np.random.default_rng(2)
    points, direction = (
        vertices + 0.1 * rng.normal(size=vertices.shape),
        rng.normal(size=vertices.shape),
    )
    energies, step = [], 6e-6
    for sign in (1, -1, 0):
        arap.fit_rotations(points + sign * step * direction)
        energies.append(energy(arap, points + sign * step * direction))
    slope = (energies[0] - energies[1]) / (2 * step)
    assert (gradient(arap, points) * direction).sum() == pytest.approx(slope, rel=1e-6)


def test_edges_in_turn_bring_a_shape_back_and_leave_what_is_held(rest):
    vertices, topology = rest
    held = vertices[:, 0] < -1.5
    mass = np.where(held, 0.0, 1.0)
    shape = arap_shape(vertices, topology, mass)
    arap = shape.arap
    points = vertices + mass[:, None] * 0.2 * np.random.default_rng(6).normal(size=vertices.shape)
    before = energy(arap, points)
    shape.compliance[:] = 0.0
    for _ in range(100):
        shape.project(points, 1.0)
    np.testing.assert_array_equal(points[held], vertices[held])
    assert energy(arap, points) < 1e-3 * before


BETWEEN = st.floats(-1.0, 1.0)


@settings(deadline=None, derandomize=True)
@given(st.floats(-2.0, 2.0), st.floats(0.2, 3.0), st.sampled_from([-1.0, 1.0]), BETWEEN, BETWEEN)
def test_step_to_a_volume_meets_it_or_is_none(error, slope, sign, bend, turn):
    """c0 + c1 s + c2 s² + c3 s³ = wanted: the root that continues zero, or no step where there is
    none near.
    """
    cubic = (1.0 + error, sign * slope, bend, turn)
    s = _cubic_step(cubic, 1.0, 1e-13)
    value = cubic[0] + s * (cubic[1] + s * (cubic[2] + s * cubic[3]))
    assert s == 0.0 or value == pytest.approx(1.0, abs=1e-12)
    assert abs(s) <= 4.0 * abs(error / slope)
    if abs(error) < 0.05 * slope**2:  # so near that the first turn of the cubic lies far behind
        assert cubic[0] == 1.0 or s != 0.0
        assert s * sign * error <= 0.0


@pytest.mark.parametrize("size", [1.0, 1e-7])
def test_no_vertex_is_in_an_inner_ball(size):
    """Beside a fine cone a ball shrinks many times: there are vertices at all distances."""
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rings = np.geomspace(1e-4, 1.0, 60)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.vstack([np.column_stack([0.3 * r * circle, np.full(12, r)]) for r in rings])
    vertices = size * vertices
    outward = np.column_stack([circle, np.full(12, -0.3)])
    normals = np.tile(outward / np.linalg.norm(outward, axis=1)[:, None], (60, 1))
    radius = _inner_balls(vertices, normals)
    middle = vertices - radius[:, None] * normals
    offset = vertices[:, None] - vertices[None]
    away = np.linalg.norm(middle[:, None] - vertices[None], axis=2)
    height = np.einsum("ijk,ik->ij", offset, normals)
    counts = height > 0.3 * np.linalg.norm(offset, axis=2)
    nearest = np.argmin(away, axis=1)
    rows = np.arange(len(vertices))
    within = away[rows, nearest] < radius * (1.0 - 1e-6)
    assert not (within & counts[rows, nearest]).any()
