"""Laws of the distance fields' loops on a few triangles, small enough to run without the compiler."""

import igl
import numpy as np
import pytest
import trimesh

from rbfmuscle.bones import build, lists, query
from rbfmuscle.bones.query import _mixed_side
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.exact_distance import ExactDistance, record_square


def angle_iron():
    """A prism over an L: convex and hollow edges and corners, 20 triangles."""
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]])
    vertices = np.vstack([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.8)])
    walls = [[(i, j, j + 6), (i, j + 6, i + 6)] for i in range(6) for j in [(i + 1) % 6]]
    return vertices, np.vstack([caps[:, ::-1], caps + 6, np.concatenate(walls)])


@pytest.fixture(scope="module")
def solid():
    return angle_iron()


@pytest.fixture(scope="module")
def field(solid):
    return BoneSDF.from_mesh(solid, cache=False)


def exact(points, solid):
    found = igl.signed_distance(points, *solid, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    return found[0], found[2]


def around(count=250, seed=0, pad=0.6):
    return np.random.default_rng(seed).uniform([-pad] * 3, [2 + pad, 2 + pad, 0.8 + pad], (count, 3))


def test_distance_is_that_to_the_triangles_on_either_side_and_beside_edges_and_corners(field, solid):
    vertices, faces = solid
    edges = trimesh.Trimesh(vertices, faces, process=False).edges_unique
    spots = np.vstack([vertices, vertices[edges].mean(axis=1)])
    step = 0.03 * np.random.default_rng(3).normal(size=(4, len(spots), 3))
    for points in (around(), (spots + step).reshape(-1, 3)):
        distance, found = exact(points, solid)[0], field.distance(points)
        assert (distance < 0).sum() > 20 and (distance > 0).sum() > 20
        np.testing.assert_allclose(found, distance, atol=1e-6)
        assert (np.sign(found) == np.sign(distance)).all()


def test_gradient_points_away_from_the_nearest_point_outside_and_to_it_inside(field, solid):
    points = around(seed=1)
    distance, nearest = exact(points, solid)
    _, gradient = field.distance_and_gradient(points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)
    # Where two faces are equally near, either is right: the way back leads to the surface.
    back = points - field.distance(points)[:, None] * gradient
    np.testing.assert_allclose(exact(back, solid)[0], 0.0, atol=1e-5)
    clear = np.abs(distance) > 0.05
    expected = (points - nearest) / np.where(distance == 0, 1.0, distance)[:, None]
    agree = np.linalg.norm(gradient - expected, axis=1)[clear] < 1e-4
    assert agree.mean() > 0.98


def test_reach_leaves_what_is_near_exact_and_bounds_what_is_far(field, solid):
    points = around(seed=4, pad=2.0)
    distance, _ = exact(points, solid)
    for reach in (0.0, 0.3, 1.0):
        found = field.distance(points, reach=reach)
        near = distance <= reach
        np.testing.assert_allclose(found[near], distance[near], atol=1e-6)
        assert (found[~near] > reach - 1e-9).all() and (found[~near] <= distance[~near] + 1e-6).all()


def test_a_mixed_cell_interpolates_what_its_corners_say_and_ends_at_its_sides():
    low, size = np.array([2.0, -1.0, 4.0]), 0.5
    corner = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)], dtype=float)

    def asked(place):
        return 1.0 + 2.0 * place[0] - 3.0 * place[1] + place[2] + 5.0 * place[0] * place[1] * place[2]

    row = np.array([[*(asked(c) for c in corner), *low, 1.0 / size]])
    lists = np.zeros(2, dtype=np.int32)  # no triangle, then the number of the corners' row
    for place in np.random.default_rng(0).uniform(-1.0, 2.0, (50, 3)):
        found = _mixed_side(*(low + size * place), 0, lists, row)
        assert found == pytest.approx(asked(np.clip(place, 0.0, 1.0)))


def test_walks_from_beside_the_nearest_triangle_lead_to_it():
    """On a convex body every way downhill ends at the nearest triangle, whichever neighbour it begins at."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.array(ball.vertices) * [2.0, 1.0, 0.7], np.array(ball.faces)
    exact = ExactDistance(vertices, faces)
    builder = build._Builder(exact, np.zeros(3), 1.0, None, None)
    records, across = exact.records, builder.across
    for point in 1.5 * np.random.default_rng(5).normal(size=(60, 3)) + [0.0, 0.0, 2.5]:
        squares = np.array([record_square(records, n, *point) for n in range(len(faces))])
        nearest = int(squares.argmin())
        for start in across[nearest]:
            for walk in (query._walk, lists._walk):
                end = walk(int(start), squares[start], *point, records, across)
                assert squares[end] == pytest.approx(squares[nearest], rel=1e-5)
