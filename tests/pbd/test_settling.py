"""Known answers of a mesh muscle that others meet: distances to its surface, what forces do to
it.
"""

import numpy as np
import trimesh

from pbd_baseline.settling import MeshSettling, MovingSurface
from rbfmuscle.geometry.interpolation import Embedding


def ask(surface, points):
    """Distances, normals, and the places that are nearest, from searches that begin at vertex 0 and
    come nearer with each edge.
    """
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    normal = np.empty_like(points)
    feet = Embedding(np.empty(points.shape, dtype=np.int64), np.empty(points.shape))
    nearest = np.zeros(len(points), dtype=np.int64)
    distance = surface.ask(points, nearest, *feet, normal)
    return distance, normal, feet.of(surface.vertices)


def test_distances_to_a_cube_are_those_to_its_faces_edges_and_corners():
    """Half a side is 1; the cube is then moved and stretched."""
    mesh = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide().subdivide()
    surface = MovingSurface(mesh.vertices, mesh.faces, 3.0)
    for scale, shift in ((1.0, [0.0, 0.0, 0.0]), (1.1, [0.3, -0.2, 0.1])):
        surface.move(np.ascontiguousarray(mesh.vertices * scale + shift))
        points = [[0.1, 0.2, 1.5], [0.1, 1.3, 1.3], [1.02, -1.05, 1.9], [0.2, -0.1, -0.7]]
        feet = [[0.1, 0.2, 1.0], [0.1, 1.0, 1.0], [1.0, -1.0, 1.0], [0.2, -0.1, -1.0]]
        points, feet = (scale * np.array(part) + shift for part in (points, feet))
        distance, normal, found = ask(surface, points)
        away = np.linalg.norm(points - feet, axis=1) * [1.0, 1.0, 1.0, -1.0]
        np.testing.assert_allclose(distance, away, atol=1e-9)
        np.testing.assert_allclose(found, feet, atol=1e-9)
        # Outwards from the nearest place, beside a face, half way around an edge and at a corner.
        np.testing.assert_allclose(normal, (points - feet) / away[:, None], atol=1e-9)
    assert np.isinf(ask(surface, [0.0, 0.0, 9.0])[0]).all()


def test_distances_to_a_ball_are_those_to_its_radius_out_to_the_reach():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    surface = MovingSurface(mesh.vertices, mesh.faces, 6.0)
    way = np.random.default_rng(3).normal(size=(30, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for depth in (-5.5, -2.0, 0.5, 5.5):
        distance, normal, feet = ask(surface, (10.0 + depth) * way)
        # The middle of a triangle of side 3.2 is 3.2² / 6 / 10 = 0.17 below its ball.
        np.testing.assert_allclose(distance, depth, atol=0.2)
        np.testing.assert_allclose(np.linalg.norm(feet, axis=1), 10.0, atol=0.2)
        assert np.einsum("ij,ij->i", normal, way).min() > 0.98


def test_forces_at_contacts_move_vertices_as_a_dense_matrix_of_them_does():
    """J the matrix of the contacts, M that of the masses: motions M⁻¹ Jᵀ f, and J M⁻¹ Jᵀ."""
    rng = np.random.default_rng(8)
    points, mass = rng.normal(size=(9, 3)), rng.uniform(0.5, 2.0, 9)
    mass[3] = 0.0  # held
    moving = MeshSettling(points, mass, 1.0, lambda number: None, most=5)
    at, columns = np.array([2, 3]), np.array([[0, 1, 2], [5, 3, 7], [8, 0, 4]])
    shares = rng.dirichlet(np.ones(3), 3)
    normal, force = rng.normal(size=(5, 3)), rng.normal(size=5)
    normal[0] = [0.0, 0.0, 1.0]
    jacobian = np.zeros((5, 9, 3))
    for row, vertex in enumerate(at):
        jacobian[row, vertex] = normal[row]
    for row, (corners, parts) in enumerate(zip(columns, shares, strict=True), len(at)):
        jacobian[row, corners] = parts[:, None] * normal[row]
    rows = moving.rows_of(at, normal, Embedding(columns, shares))
    dense, spread = jacobian.reshape(5, -1), np.repeat(mass, 3)
    np.testing.assert_allclose(rows.delassus, dense * spread @ dense.T, atol=1e-14)
    motion = rows.motion(force)
    np.testing.assert_allclose(motion.ravel(), spread * (dense.T @ force), atol=1e-14)
    # Held, it stays; and what the contacts feel of the motion is the matrix times the forces.
    assert (motion[3] == 0.0).all()
    np.testing.assert_allclose(dense @ motion.ravel(), rows.delassus @ force, atol=1e-13)
