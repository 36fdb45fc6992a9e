"""The shown mesh: folds of a scan are smoothed, shapes stay, edges are as long as asked for."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.surfaces import edge_lengths, unique_edges
from rbfmuscle.surface.display import display_mesh, neighbour_lists


def shown(mesh, resolution=0):
    return display_mesh(SimpleNamespace(mesh=mesh), resolution)


@pytest.mark.parametrize(("most", "smoothed"), [(1.0, True), (0.01, False)])
def test_a_folded_vertex_of_a_plane_goes_back_in_the_plane_where_that_is_little(
    most, smoothed, monkeypatch
):
    monkeypatch.setattr("rbfmuscle.surface.display.UNFOLD_WAY", most)
    box = trimesh.creation.box([16.0, 16.0, 16.0]).subdivide().subdivide()
    box.apply_translation([100.0, 50.0, 20.0])
    vertices, faces = np.array(box.vertices), np.array(box.faces)
    corner = np.linalg.norm(vertices - [100.0, 50.0, 28.0], axis=1).argmin()
    ring = np.setdiff1d(faces[(faces == corner).any(axis=1)], corner)
    vertices[corner] += 1.02 * (vertices[ring[0]] - vertices[corner])
    found, same = shown(trimesh.Trimesh(vertices, faces, process=False))
    np.testing.assert_array_equal(same, faces)
    moved = np.linalg.norm(found - vertices, axis=1) > 1e-5
    assert moved[corner] == smoothed
    # What moves is of the folded triangles, and stays in their plane.
    assert np.isin(np.flatnonzero(moved), [corner, *ring]).all()
    np.testing.assert_allclose(found[moved, 2], 28.0, atol=1e-5)  # of the frame's seven digits
    top = (found[faces][:, :, 2] > 27.9).all(axis=1)
    assert (trimesh.Trimesh(found, faces).face_normals[top, 2] < 0.0).any() != smoothed


@pytest.mark.parametrize(
    ("line", "angle"),
    [
        # A foot that widens upwards from a plate, and a lens with a sharp rim.
        ([[0, 0], [10, 0], [10, 1], [2, 1], [3, 2], [0, 2]], 130.0),
        ([[0, 0], [10, 0.8], [0, 1.6]], 165.0),
    ],
)
def test_an_overhang_and_a_sharp_rim_are_the_shape(line, angle, monkeypatch):
    monkeypatch.setattr("rbfmuscle.surface.display.UNFOLD_WAY", np.inf)
    mesh = trimesh.creation.revolve(np.array(line, dtype=float), sections=12)
    assert np.degrees(mesh.face_adjacency_angles).max() > angle
    found, _ = shown(mesh)
    np.testing.assert_allclose(found, mesh.vertices, atol=1e-5)  # the frame's seven digits


def test_neighbours_are_those_that_share_an_edge():
    faces = np.array(trimesh.creation.icosphere(1).faces)
    start, other = neighbour_lists(faces, 42)
    for v in range(42):
        around = faces[(faces == v).any(axis=1)]
        np.testing.assert_array_equal(other[start[v] : start[v + 1]], np.setdiff1d(around, [v]))


def test_triangles_that_cross_are_smoothed_until_none_do():
    ball = trimesh.creation.icosphere(2)
    vertices = np.array(ball.vertices)
    far = vertices.copy()
    far[0] = -1.3 * vertices[0]  # through the other side
    found, faces = shown(trimesh.Trimesh(far, ball.faces, process=False))
    assert crossing_faces(far, faces).any() and not crossing_faces(found, faces).any()
    away = np.linalg.norm(found - vertices, axis=1)
    assert away[np.abs(vertices @ vertices[0]) < 0.5].max() < 1e-5


def test_a_tangle_is_smoothed_ring_by_ring_until_none_cross():
    ball = trimesh.creation.icosphere(2)
    noise = np.random.default_rng(1).normal(size=ball.vertices.shape)
    tangle = trimesh.Trimesh(ball.vertices + noise, ball.faces, process=False)
    found, faces = shown(tangle)
    assert crossing_faces(tangle.vertices, faces).sum() > 50
    assert not crossing_faces(found, faces).any()


def test_a_resolution_gives_so_many_edges_along_the_longest_side():
    bar = trimesh.creation.icosphere(3).apply_scale([5.0, 5.0, 20.0])
    found, faces = shown(bar, 20)
    assert 200 < len(found) < 12_000
    # The vertices lie closer where the surface is curved.
    assert edge_lengths(found, unique_edges(faces)).mean() == pytest.approx(40.0 / 20.0, rel=0.1)
