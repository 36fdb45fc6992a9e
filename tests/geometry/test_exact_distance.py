"""Exact distances to triangle meshes, with libigl as the judge."""

import igl
import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.exact_distance import ExactDistance, faces_across


def tree(mesh):
    return ExactDistance(mesh.vertices, mesh.faces)


PSEUDONORMAL = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL


def _shapes():
    rough = trimesh.creation.icosphere(2, 10.0)
    rng = np.random.default_rng(3)
    rough.vertices *= rng.uniform(0.8, 1.2, (len(rough.vertices), 1))
    return {
        "sphere": trimesh.creation.icosphere(3, 10.0),
        "box": trimesh.creation.box((20.0, 30.0, 40.0)),
        "torus": trimesh.creation.torus(20.0, 5.0),
        "thin plate": trimesh.creation.box((40.0, 30.0, 0.5)),
        "rough": rough,
    }


@pytest.fixture(params=_shapes().items(), ids=lambda item: item[0])
def shape(request):
    return request.param[1]


def _points(mesh, count=3000, seed=0):
    rng = np.random.default_rng(seed)
    near = mesh.vertices[rng.integers(len(mesh.vertices), size=count)] + rng.normal(0.0, 2.0, (count, 3))
    low, high = mesh.bounds
    return np.concatenate([near, rng.uniform(low - 20.0, high + 20.0, (count, 3))])


def _judge(points, mesh):
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    distance, _, closest, _ = igl.signed_distance(points, vertices, faces, PSEUDONORMAL)[:4]
    return distance, closest


def test_distances_and_nearest_points_are_those_of_libigl(shape):
    points = _points(shape)
    expected, _ = _judge(points, shape)
    distance, closest, face, _ = tree(shape).nearest(points)
    np.testing.assert_allclose(distance, expected, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), np.abs(expected), atol=1e-11)
    on_face = trimesh.triangles.closest_point(shape.triangles[face], points)
    np.testing.assert_allclose(closest, on_face, atol=1e-9)


def test_beyond_reach_the_reach_is_returned_and_nearer_distances_are_exact(shape):
    points = _points(shape)
    exact = tree(shape)
    whole, near = exact.signed_distance(points), exact.signed_distance(points, reach=3.0)
    within = np.abs(whole) < 3.0
    assert 0 < within.sum() < len(points)
    np.testing.assert_allclose(near[within], whole[within], atol=1e-12)
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
