"""Triangles that cross others of the same surface."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.crossing import FaceTree, crossing_faces

BALL = trimesh.creation.icosphere(3)


def pentagram():
    """A double cone over a pentagram: all of it is seen from outside, and it covers itself."""
    angles = np.arange(5) * 4.0 * np.pi / 5.0
    rim = np.column_stack([np.cos(angles), np.sin(angles), 0.05 * np.arange(5)])
    turn = [(k, (k + 1) % 5) for k in range(5)]
    faces = np.array([(a, b, 5) for a, b in turn] + [(b, a, 6) for a, b in turn])
    return np.vstack([rim, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]]), faces


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3, None])
def test_a_tree_made_at_rest_finds_crossings_later_and_rings_that_lie_plain_spare_tests(noise):
    flat = np.asarray(BALL.vertices) * [1.0, 0.6, 0.2], np.asarray(BALL.faces)
    points, faces = flat if noise is not None else pentagram()
    tree = FaceTree(points, faces)
    moved = points + (noise or 0.0) * np.random.default_rng(3).normal(size=points.shape)
    quick = tree.crossing(moved)
    assert tree.rings is not None and quick.any() == (noise != 0.0)
    np.testing.assert_array_equal(quick, crossing_faces(moved, faces))
    corner = np.zeros(len(points), dtype=bool)
    corner[faces[quick][:1, 0]] = True
    some = np.flatnonzero(quick & corner[faces].any(axis=1))
    assert np.isin(some, tree.pairs(moved, corner)).all()
    tree.rings = None  # every pair that shares a corner is tested
    np.testing.assert_array_equal(quick, tree.crossing(moved))
    for other in (faces[1:], np.vstack([faces, faces[:1]])):
        assert FaceTree(points, other).rings is None


def test_pairs_are_sought_among_some_triangles():
    points, faces = np.array(BALL.vertices), np.asarray(BALL.faces)
    tree = FaceTree(points, faces)
    assert len(tree.pairs(points)) == 0
    dented = points[:, 2] > 0.95
    points[dented, 2] -= 2.1  # out at the other side
    among = dented[faces].any(axis=1)
    pairs = tree.pairs(points, dented, folds=False)
    assert (among[pairs].any(axis=1)).all() and (pairs[:, 0] != pairs[:, 1]).all()
    np.testing.assert_array_equal(np.unique(pairs), np.flatnonzero(crossing_faces(points, faces)))
    assert len(tree.pairs(points, np.zeros(len(points), bool), folds=False)) == 0
    # Boxes of triangles that did not move are kept.
    tree.pairs(points, dented)
    points[dented, 2] += 2.1
    assert len(tree.pairs(points, dented, folds=False, again=True)) == 0
    points[dented, 2] -= 2.1
    same = tree.pairs(points, dented, folds=False, again=True)
    np.testing.assert_array_equal(np.sort(same, axis=0), np.sort(pairs, axis=0))
