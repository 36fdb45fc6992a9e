"""Handles, surfaces that cross themselves, and what comes and goes between frames."""

import numpy as np
import trimesh

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.metrics.topology import euler_characteristic


def test_euler_of_sphere_torus_and_two_spheres():
    sphere = trimesh.creation.icosphere(2)
    torus = trimesh.creation.torus(3.0, 1.0)
    two = trimesh.util.concatenate([sphere, sphere.copy().apply_translation([5, 0, 0])])
    assert euler_characteristic(sphere.faces) == 2
    assert euler_characteristic(torus.faces) == 0
    assert euler_characteristic(two.faces) == 4


def literal_crossings(vertices, faces):
    """Every edge against every triangle, one by one."""
    marked = np.zeros(len(faces), dtype=bool)
    volume = lambda a, b, c, d: np.linalg.det([b - a, c - a, d - a])  # noqa: E731
    for f, face in enumerate(faces):
        for g, other in enumerate(faces):
            if f == g or len({*face, *other}) < 5:
                continue
            for k in range(3):
                p, q = face[k], face[(k + 1) % 3]
                if p in other or q in other:
                    continue
                a, b, c, p, q = (vertices[i] for i in (*other, p, q))
                if volume(a, b, c, p) * volume(a, b, c, q) >= 0:
                    continue
                sides = {np.sign(volume(p, q, *pair)) for pair in ((a, b), (b, c), (c, a))}
                if sides in ({1.0}, {-1.0}):
                    marked[f] = marked[g] = True
    return marked


def test_crossings_are_those_of_a_literal_search():
    mesh = trimesh.creation.icosphere(1)
    rng = np.random.default_rng(3)
    vertices = mesh.vertices + 0.35 * rng.normal(size=mesh.vertices.shape)
    expected = literal_crossings(vertices, mesh.faces)
    assert 0 < expected.sum() < len(expected)
    np.testing.assert_array_equal(crossing_faces(vertices, mesh.faces), expected)
