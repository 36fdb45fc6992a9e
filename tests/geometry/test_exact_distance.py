"""Exact distances to triangle meshes, with libigl as the judge."""

import igl
import numpy as np
import pytest
import trimesh
from conftest import samples

from rbfmuscle.geometry.exact_distance import STACK, ExactDistance, faces_across, nearest_triangle

ROUGH = trimesh.creation.icosphere(2, 10.0)
ROUGH.vertices *= np.random.default_rng(3).uniform(0.8, 1.2, (len(ROUGH.vertices), 1))
SHAPES = {
    "sphere": trimesh.creation.icosphere(3, 10.0),
    "box": trimesh.creation.box((20.0, 30.0, 40.0)),
    "torus": trimesh.creation.torus(20.0, 5.0),
    "thin plate": trimesh.creation.box((40.0, 30.0, 0.5)),
    "rough": ROUGH,
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_distances_and_nearest_points_are_those_of_libigl(shape):
    rng = np.random.default_rng(0)
    near = shape.vertices[rng.integers(len(shape.vertices), size=samples(3000))]
    near += rng.normal(0.0, 2.0, near.shape)
    low, high = shape.bounds
    points = np.concatenate([near, rng.uniform(low - 20.0, high + 20.0, near.shape)])
    vertices, faces = np.array(shape.vertices), np.array(shape.faces)
    expected = igl.signed_distance(points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[
        0
    ]
    exact = ExactDistance(shape.vertices, shape.faces)
    distance, closest, face, _ = exact.nearest(points)
    np.testing.assert_allclose(distance, expected, atol=1e-11)
    np.testing.assert_allclose(
        np.linalg.norm(points - closest, axis=1), np.abs(expected), atol=1e-11
    )
    on_face = trimesh.triangles.closest_point(shape.triangles[face], points)
    np.testing.assert_allclose(closest, on_face, atol=1e-9)
    # Beyond reach the reach is returned.
    near, within = exact.signed_distance(points, reach=3.0), np.abs(distance) < 3.0
    assert 0 < within.sum() < len(points)
    np.testing.assert_allclose(near[within], distance[within], atol=1e-12)
    assert np.all(near[~within] == 3.0)


@pytest.mark.parametrize("axis", range(3))
def test_triangles_without_area_count_as_their_longest_edge(axis):
    vertices = np.roll([[0.0, 0, 0], [2, 0, 0], [1, 0, 0], [5, 5, 5]], axis, axis=1)
    exact = ExactDistance(vertices, [[0, 1, 2], [3, 3, 3]])
    points = np.roll([[1.0, 3, 0], [-1, 0, 0], [4, 0, 0], [5, 5, 6]], axis, axis=1)
    np.testing.assert_allclose(np.abs(exact.signed_distance(points)), [3.0, 1.0, 2.0, 1.0])


def test_faces_across_of_open_turned_and_doubled_meshes():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    faces, turned = np.array(box.faces), np.array(box.faces)
    turned[0] = turned[0, ::-1]
    across = faces_across(faces)
    found = {tuple(sorted(pair)) for pair in zip(np.repeat(np.arange(12), 3), across.ravel())}
    assert found == {tuple(pair) for pair in np.sort(box.face_adjacency, axis=1).tolist()}
    assert np.count_nonzero(faces_across(faces[1:]) == -1) == 3
    assert np.count_nonzero(faces_across(turned) == -2) == 6
    assert (faces_across(np.vstack([faces, faces[:1]]))[0] == -2).all()


def test_of_triangles_that_are_equally_near_the_first_is_taken_whatever_their_order():
    """Beyond the corners of a box and the middles of its edges, moved by rounding."""
    box = trimesh.creation.box((2.0, 3.0, 4.0)).subdivide()
    points = np.random.default_rng(2).normal(1.5, 1e-15, box.vertices.shape) * box.vertices
    nearest = trimesh.proximity.closest_point(box, points)[0]
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    for seed in range(5):
        faces = np.random.default_rng(seed).permutation(box.faces)
        tree = ExactDistance(box.vertices, faces).tree
        for point, at in zip(points, nearest):
            best, square = nearest_triangle(tree, tuple(point), -1, np.inf, 1e-9, stack)
            away = np.linalg.norm(
                trimesh.triangles.closest_point(box.vertices[faces], np.tile(at, (len(faces), 1)))
                - at,
                axis=1,
            )
            assert tree.order[best] == np.flatnonzero(away < 1e-9)[0]
            assert square == pytest.approx(((point - at) ** 2).sum())
