"""Distances to meshes, and what lies inside them, against libigl and closed forms."""

import igl
import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.mesh_distance import Columns, MeshDistance

EYE = np.eye(4)


def arrays(mesh):
    return np.array(mesh.vertices), np.array(mesh.faces)


@pytest.fixture(scope="module")
def blob():
    """A bumpy closed surface, so that nothing is symmetric by chance."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    v = np.array(mesh.vertices)
    bump = (
        1 + 0.2 * np.sin(0.7 * v[:, 0]) * np.cos(0.5 * v[:, 1] + 0.3) + 0.1 * np.sin(0.9 * v[:, 2])
    )
    return trimesh.Trimesh(v * bump[:, None] * [1.6, 1.0, 0.7], mesh.faces, process=False)


class TestColumns:
    @pytest.mark.parametrize("along", [0, 1, 2])  # the axis on which the mesh is shortest
    @pytest.mark.parametrize(("turn", "scale"), [(0.0, 1.0), (0.4, 2.0**-10), (2.0, 1.0)])
    def test_inside_is_where_the_winding_number_says_so_in_any_pose_and_unit(
        self, blob, along, turn, scale
    ):
        vertices, faces = arrays(blob)
        vertices = np.roll(vertices, along + 1, axis=1)
        assert np.argmin(np.ptp(vertices, axis=0)) == along
        pose = trimesh.transformations.rotation_matrix(turn, (1, 2, 3), (1, 2, 3))
        bounds = 1.4 * np.array([vertices.min(axis=0), vertices.max(axis=0)])
        points = np.random.default_rng(1).uniform(*bounds, size=(4000, 3))
        expected = igl.winding_number(vertices, faces, trimesh.transform_points(points, pose)) > 0.5
        assert 300 < expected.sum() < 3500
        pose[:3, 3] *= scale
        found = Columns(scale * vertices, faces).inside(scale * points, pose)
        np.testing.assert_array_equal(found, expected)

    def test_lines_through_edges_and_corners_are_counted_once(self):
        box = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
        axis = np.linspace(
            -1.5, 1.5, 7
        )  # every line runs through a corner or an edge of the triangles
        points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        away = np.abs(np.abs(points).max(axis=1) - 1.0) > 1e-9
        found = Columns(*arrays(box)).inside(points, EYE)
        np.testing.assert_array_equal(found[away], np.abs(points[away]).max(axis=1) < 1.0)

    def test_a_mesh_wound_twice_is_inside_where_either_is(self):
        ball = trimesh.creation.icosphere(subdivisions=3)
        both = trimesh.util.concatenate([ball, ball.copy().apply_translation([1.0, 0, 0])])
        points = np.array([[0.5, 0, 0], [-0.5, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [0.5, 0, 0.95]])
        found = Columns(*arrays(both)).inside(points, EYE)
        assert found.tolist() == [True, True, True, False, False]


class TestMeshDistance:
    @pytest.mark.parametrize("spread", [1e-6, 0.1, 3.0])
    def test_equals_libigl(self, blob, spread):
        noise = np.random.default_rng(3).normal(scale=spread, size=blob.vertices.shape)
        points = np.array(blob.vertices) + noise
        expected = igl.signed_distance(points, *arrays(blob))[
            0
        ]  # near zero both round a squared distance
        np.testing.assert_allclose(MeshDistance(*arrays(blob)).signed(points), expected, atol=1e-9)

    @pytest.mark.parametrize("spread", [1e-6, 0.1, 3.0])
    def test_sides_of_a_simple_surface_are_those_by_winding(self, blob, spread):
        noise = np.random.default_rng(3).normal(scale=spread, size=blob.vertices.shape)
        points, distance = np.array(blob.vertices) + noise, MeshDistance(*arrays(blob))
        np.testing.assert_array_equal(distance.signed(points, simple=True), distance.signed(points))

    def test_triangles_near_from_the_frame_before_change_no_distance(self, blob):
        vertices, faces = arrays(blob)
        points = vertices + np.random.default_rng(5).normal(scale=0.3, size=vertices.shape)
        before, near = MeshDistance(vertices, faces), np.full(len(points), -1)
        before.unsigned(points, near=near)
        moved = vertices * [1.1, 0.9, 1.0] + [0.5, 0.0, 0.0]
        later = MeshDistance(moved, faces, layout=before.layout)
        anew = MeshDistance(moved, faces).unsigned(points)
        np.testing.assert_array_equal(later.unsigned(points, near=near), anew)

    def test_deepest_point_is_not_believed_at_a_fold(self):
        # A flap folded flat onto the outside: the layers above it look like the inside from one
        # face.
        box = trimesh.creation.box((2, 2, 2))
        vertices, faces = arrays(box)
        top = np.flatnonzero((vertices[faces][:, :, 2] > 0).all(axis=1))[0]
        a, b, c = faces[top]
        extra = np.array([[0.3, 0.3, 1.0], [-0.3, 0.3, 1.0]]) + vertices[[a, b, c]].mean(axis=0) * [
            1,
            1,
            0,
        ]
        vertices = np.vstack([vertices, extra])
        p, q = len(vertices) - 2, len(vertices) - 1
        folded = [[a, b, p], [b, q, p], [b, c, q], [c, p, q], [c, a, p]]
        faces = np.vstack([np.delete(faces, top, axis=0), folded])
        above = np.random.default_rng(4).uniform([-1, -1, 1.01], [1, 1, 1.6], size=(300, 3))
        assert MeshDistance(vertices, faces).depth(above).max() == 0.0

    def test_open_bone_is_judged_by_winding_number(self):
        sphere = trimesh.creation.icosphere(subdivisions=4)
        hole = sphere.triangles_center[:, 2] > 0.97
        vertices, faces = np.array(sphere.vertices), np.array(sphere.faces)[~hole]
        distance = MeshDistance(vertices, faces, closed=False)
        assert distance.signed([[0, 0, -0.5]])[0] == pytest.approx(
            -0.5, abs=5e-3
        )  # polyhedron, not sphere
        assert distance.signed([[0, 0, -1.5]])[0] == pytest.approx(0.5, abs=5e-3)
