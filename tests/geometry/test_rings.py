"""Rings of triangles around vertices, and where none covers another."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.crossing import plain_loop, vertex_rings
from rbfmuscle.geometry.surfaces import opposite_half_edges

BALL = trimesh.creation.icosphere(2)
POINTS, FACES = np.array(BALL.vertices), np.asarray(BALL.faces)


def rings(faces, count):
    return vertex_rings(faces, opposite_half_edges(faces), count)


def test_a_ring_has_the_triangles_of_its_vertex_in_order():
    start, other = rings(FACES, len(POINTS))
    of_faces = {tuple(np.roll(face, k)) for face in FACES.tolist() for k in range(3)}
    for v in range(len(POINTS)):
        ring = other[start[v] : start[v + 1]]
        found = {(v, *pair) for pair in zip(ring, np.roll(ring, -1), strict=True)}
        assert found == {face for face in of_faces if face[0] == v}


def test_a_vertex_where_rings_meet_and_one_without_faces_have_none():
    two = np.vstack([FACES, FACES + len(POINTS)])
    two[two == len(POINTS)] = 0
    start, _ = rings(two, 2 * len(POINTS) + 1)
    assert set(np.flatnonzero(np.diff(start) == 0)) == {0, len(POINTS), 2 * len(POINTS)}


def plain(points):
    found = np.zeros(len(points), np.bool_)
    plain_loop(points, *rings(FACES, len(points)), found)
    return found


@pytest.mark.parametrize("axes", [[0, 1, 2], [1, 2, 0], [2, 0, 1]])
def test_a_vertex_pushed_over_a_neighbour_is_folded(axes):
    points = POINTS[:, axes].copy()
    assert plain(points).all()
    pushed, over = FACES[40, 0], FACES[40, 1]
    points[pushed] += 2.0 * (points[over] - points[pushed])
    found = plain(points)
    around = np.unique(FACES[(FACES[:, :, None] == [pushed, over]).any(axis=(1, 2))])
    assert not found[pushed]
    assert found[np.setdiff1d(np.arange(len(points)), around)].all()


def test_a_ring_that_goes_round_twice_is_folded():
    turn = 2.0 * np.pi * np.arange(5) / 5
    star = np.column_stack([np.cos(2.0 * turn), np.sin(2.0 * turn), np.zeros(5)])
    points = np.vstack([[[0.0, 0.0, 0.5]], star, [[0.0, 0.0, -0.5]]])
    ring = np.arange(1, 6)
    above = np.column_stack([np.zeros(5, int), ring, np.roll(ring, -1)])
    below = np.column_stack([np.full(5, 6), np.roll(ring, -1), ring])
    start, other = rings(np.vstack([above, below]), 7)
    found = np.ones(7, np.bool_)
    plain_loop(points, start, other, found)
    assert not found[0] and not found[6]
