"""Points, normals, edges, areas and crossings of triangle meshes: known answers, and laws under
motion.
"""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.exact_distance import nearest_weights
from rbfmuscle.geometry.frames import RestFrame
from rbfmuscle.geometry.surfaces import (
    EdgeLengths,
    edge_lengths,
    even_points,
    face_normals,
    farthest_move,
    geodesic,
    mesh_volume,
    surface_graph,
    triangle_plane,
    unique_edges,
    vertex_areas,
    vertex_normals,
    volume_cubic,
    volume_loop,
    volume_rate,
)

BOX = trimesh.creation.box((2.0, 3.0, 4.0)).subdivide()
VERTICES, FACES = np.array(BOX.vertices), np.array(BOX.faces)


def test_even_points_lie_on_their_triangles_as_many_as_the_area_of_each():
    stretched, count = VERTICES * [5.0, 1.0, 0.3], 20_000
    points, face = even_points(stretched, FACES, count)
    weights = trimesh.triangles.points_to_barycentric(stretched[FACES[face]], points)
    assert weights.min() > -1e-12
    back = np.einsum("nk,nkd->nd", weights, stretched[FACES[face]])
    np.testing.assert_allclose(back, points, atol=1e-12)
    area = np.linalg.norm(face_normals(stretched, FACES), axis=1)
    share = np.bincount(face, minlength=len(FACES)) - count * area / area.sum()
    assert np.abs(share).max() <= 1.0  # whole points
    # The middle of a triangle's points is that of the triangle, but for their distance.
    middle = np.stack([np.bincount(face, points[:, k]) for k in range(3)], 1)
    middle /= np.bincount(face)[:, None]
    size = np.ptp(stretched[FACES], axis=1).max(axis=1)
    missed = np.linalg.norm(middle - stretched[FACES].mean(axis=1), axis=1)
    assert (missed < 0.05 * size).all()
    assert len(even_points(stretched, FACES[:0], count)[0]) == 0


def test_area_vectors_are_the_sides_of_a_box_and_sum_to_nothing():
    area = face_normals(VERTICES, FACES)
    np.testing.assert_allclose(area.sum(axis=0), 0.0, atol=1e-12)
    for axis, side in enumerate((12.0, 8.0, 6.0)):
        assert area[area[:, axis] > 1e-9, axis].sum() == pytest.approx(side)
    middle = VERTICES[FACES].mean(axis=1)
    assert (np.einsum("ij,ij->i", area, middle) > 0.0).all()
    assert (
        np.einsum("ij,ij->", area, middle) / 3.0
        == pytest.approx(24.0)
        == mesh_volume(VERTICES, FACES)
    )


def test_everything_turns_and_scales_with_the_mesh():
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    scale = 2.5
    shift = np.array([50.0, -20.0, 7.0])
    moved = scale * VERTICES @ turn.T + shift
    area, normals, share = (
        call(VERTICES, FACES) for call in (face_normals, vertex_normals, vertex_areas)
    )
    np.testing.assert_allclose(face_normals(moved, FACES), scale**2 * area @ turn.T, atol=1e-11)
    np.testing.assert_allclose(vertex_normals(moved, FACES), normals @ turn.T, atol=1e-12)
    np.testing.assert_allclose(vertex_areas(moved, FACES), scale**2 * share, rtol=1e-10)
    edges = unique_edges(FACES)
    np.testing.assert_allclose(
        edge_lengths(moved, edges), scale * edge_lengths(VERTICES, edges), rtol=1e-11
    )
    np.testing.assert_allclose(EdgeLengths(VERTICES, FACES)(moved), scale, rtol=1e-11)
    assert mesh_volume(moved, FACES) == pytest.approx(scale**3 * 24.0)
    assert mesh_volume(VERTICES, FACES[:, ::-1]) == pytest.approx(-24.0)


@pytest.mark.parametrize("seed", range(3))
def test_rest_frame_turns_with_its_points_whichever_of_them_comes_first(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * [4.0, 2.0, 1.0]
    # The first lies in the very middle, where it has no direction; the second on one line with the
    # third.
    points[0] = points[1:].mean(axis=0)
    points[1] = 2.0 * points[2] - points[0]
    points[0] = points[1:].mean(axis=0)
    frame = RestFrame(points)
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame.points(frame.local), points, atol=1e-7 * frame.size)
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = RestFrame(1e3 * points @ turn.T + [5.0, -6.0, 7.0])
    np.testing.assert_allclose(moved.local, frame.local, atol=2e-8)
    assert moved.size == pytest.approx(1e3 * frame.size)


def test_nearest_point_of_a_triangle_is_a_mean_of_its_corners_in_every_region():
    rng = np.random.default_rng(3)
    seen = set()
    for a, b, c, p in rng.normal(size=(4000, 4, 3)) * np.array([1.0, 1.0, 1.0, 2.0])[:, None]:
        weights = np.array(nearest_weights(p, a, b, c))
        assert weights.min() >= 0.0 and weights.sum() == pytest.approx(1.0)
        squared = igl.point_mesh_squared_distance(
            p[None], np.array([a, b, c]), np.array([[0, 1, 2]])
        )[0]
        assert ((weights @ [a, b, c] - p) ** 2).sum() == pytest.approx(
            float(np.ravel(squared)[0]), rel=1e-9
        )
        seen.add(tuple(weights > 0.0))
    assert len(seen) == 7, "three corners, three edges, the inside"


@pytest.mark.parametrize("seed", range(3))
def test_crossings_turn_with_the_surface(seed):
    one, two = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2, radius=0.8)
    vertices = np.vstack([one.vertices, two.vertices + [0.9, 0.2, 0.1]])
    faces = np.vstack([one.faces, two.faces + len(one.vertices)])
    found = FaceTree(vertices, faces).crossing(vertices)
    assert found.sum() > 10
    turned = Rotation.random(random_state=seed).apply(vertices)
    np.testing.assert_array_equal(FaceTree(turned, faces).crossing(turned), found)


def test_farthest_move_is_the_greatest_and_what_is_not_finite_is_not_lost():
    before = np.zeros((3, 3))
    assert farthest_move(before, before + [0.0, 0.0, 0.25]) == 0.25
    after = np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 0.0], [0.0, 2.0, 0.0]])
    assert farthest_move(before, after) == 5.0
    after[0, 1] = np.nan
    assert farthest_move(before, after) == np.inf


def test_paths_over_a_surface_begin_at_the_nearest_vertex_and_cross_edges():
    """Over a square of one unit around its middle, in four triangles, unfolded on two others."""
    fan = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    square = trimesh.Trimesh(fan + [3.0, 2.0, 1.0], faces, process=False)
    root = np.sqrt(2.0)
    graph = surface_graph(square)
    # From corner to corner beyond the middle: over the edge between two triangles, and along edges.
    assert geodesic(graph, 0) == pytest.approx([0.0, 1.0, root, 1.0, root / 2])
    assert geodesic(graph, [0, 1]) == pytest.approx([0.0, 0.0, 1.0, 1.0, root / 2])
    away = trimesh.util.concatenate([square, square.copy().apply_translation([9.0, 0, 0])])
    assert np.isinf(geodesic(surface_graph(away), 0)[5:]).all()
    flat = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0]], [[0, 1, 2], [1, 0, 3]])
    assert geodesic(surface_graph(flat), 2)[3] == pytest.approx(2.0)  # across the edge between


def test_the_normal_of_a_triangle_is_twice_its_area_vector():
    vertices = VERTICES + np.random.default_rng(12).normal(0.0, 0.1, VERTICES.shape)
    for f, area in enumerate(face_normals(vertices, FACES)):
        np.testing.assert_allclose(triangle_plane(vertices, FACES, f)[3], 2.0 * area, atol=1e-12)


def test_no_faces_enclose_nothing():
    assert volume_loop(VERTICES, FACES[:0]) == 0.0


def test_volume_along_a_direction_is_a_cubic_of_which_the_rate_is_the_slope():
    rng = np.random.default_rng(11)
    vertices = VERTICES + rng.normal(0.0, 0.1, VERTICES.shape) + [5.0, -3.0, 8.0]
    direction = rng.normal(size=vertices.shape)
    c = volume_cubic(vertices, FACES, direction)
    for s in (-0.7, 0.0, 0.4, 1.3):
        there = mesh_volume(vertices + s * direction, FACES)
        assert c[0] + s * (c[1] + s * (c[2] + s * c[3])) == pytest.approx(there)
        volume, rate = volume_rate(vertices + s * direction, FACES, direction)
        assert volume == pytest.approx(there)
        assert rate == pytest.approx(c[1] + s * (2.0 * c[2] + s * 3.0 * c[3]))
