"""Slivers and triangles that look inwards, planted on a ball and mended."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.extraction.material_mesh import (
    LEAST_ANGLE,
    MaterialMesh,
    flip_edges,
    mend_slivers,
    triangle_quality,
)

BALL = trimesh.creation.icosphere(subdivisions=3)


def onto_ball(mesh, vertices):
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True)


def planted(seed, count=12):
    """A ball some of whose vertices lie on or beyond a neighbour's far edge."""
    points, faces = np.array(BALL.vertices), np.array(BALL.faces)
    chosen = np.random.default_rng(seed).choice(len(faces), count, replace=False)
    for a, b, c in faces[chosen]:
        points[a] = 0.45 * (points[b] + points[c]) + 0.02 * (points[b] - points[a]) - 0.05 * points[a]
    return onto_ball(None, points), faces


def bad_triangles(vertices, faces):
    return triangle_quality(vertices, faces, vertex_normals(vertices, faces)) < LEAST_ANGLE


def angles(vertices, faces):
    return np.degrees(trimesh.Trimesh(vertices, faces, process=False).face_angles).min(axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_planted_slivers_go_and_the_ball_stays_closed(seed):
    points, faces = planted(seed)
    assert bad_triangles(points, faces).sum() >= 12
    mesh, vertices = mend_slivers(MaterialMesh(points, faces), points, onto_ball)
    found = trimesh.Trimesh(vertices, mesh.faces, process=False)
    assert found.is_watertight and found.is_winding_consistent and found.euler_number == 2
    assert len(vertices) == len(points) and len(mesh.faces) == len(faces)
    assert angles(vertices, mesh.faces).min() > LEAST_ANGLE
    assert np.einsum("nd,nd->n", found.face_normals, found.triangles_center).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=1e-12)
    far = np.linalg.norm(vertices - points, axis=1) > 1e-12
    assert 0 < far.sum() < 0.4 * len(points), "only what lies around a sliver moves"


def test_a_flip_makes_no_edge_of_four_triangles():
    """Of a tetrahedron every edge is there already, so none can be flipped."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.01, 0.0], [0.5, 0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert bad_triangles(points, faces).any()
    assert flip_edges(points, faces) is faces


def test_what_cannot_be_mended_is_given_back_no_worse():
    points, faces = planted(0)
    mesh = MaterialMesh(points, faces)
    spoil = np.random.default_rng(1)
    same, vertices = mend_slivers(mesh, points, lambda m, v: v + spoil.normal(size=v.shape))
    assert same is mesh and vertices is points
