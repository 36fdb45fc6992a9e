"""A mesh of the material on level sets: known shapes, one topology, nothing that crosses, whatever
the field does.
"""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.crossing import FaceTree, crossing_faces
from rbfmuscle.geometry.surfaces import mesh_volume, vertex_normals
from rbfmuscle.implicit.extraction.material import project_to_level_set
from rbfmuscle.implicit.extraction.material_mesh import (
    LEAST_ANGLE,
    MaterialMesh,
    flip_edges,
    mend_slivers,
    triangle_quality,
)
from rbfmuscle.implicit.extraction.obstacles import BESIDE, PointGrid, near_triangles
from rbfmuscle.implicit.extraction.projection import CutBounds

BALL = trimesh.creation.icosphere(3)
VOLUME = 4.0 / 3.0 * np.pi


class Sphere:
    """Signed distance to a sphere."""

    def __init__(self, radius=1.0, centre=(0.0, 0.0, 0.0)):
        self.radius, self.centre = radius, np.asarray(centre)

    def __call__(self, points):
        return np.linalg.norm(points - self.centre, axis=1) - self.radius

    def value_and_gradient(self, points):
        offset = points - self.centre
        return self(points), offset / np.linalg.norm(offset, axis=1, keepdims=True)


class Two:
    """Two balls that grow together: the smaller of their distances."""

    def __init__(self, apart):
        self.parts = Sphere(1.0, (-apart, 0, 0)), Sphere(1.0, (apart, 0, 0))

    def __call__(self, points):
        return np.minimum(*(part(points) for part in self.parts))

    def value_and_gradient(self, points):
        (f, df), (g, dg) = (part.value_and_gradient(points) for part in self.parts)
        return np.minimum(f, g), np.where((f < g)[:, None], df, dg)


class Bone(Sphere):
    """A cut: outside of a sphere, exact everywhere."""

    def value_and_gradient_below(self, points, limit):
        return self.value_and_gradient(points)


def mesh_of(ball=BALL):
    return MaterialMesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def test_vertices_come_to_lie_on_the_level_that_gives_the_volume():
    noise = np.random.default_rng(1).normal(size=(len(BALL.vertices), 1))
    carried = BALL.vertices * (1.0 + 0.05 * noise)
    found = project_to_level_set(mesh_of(), carried, Sphere(), volume=1.5 * VOLUME)
    assert mesh_volume(found.vertices, found.faces) == pytest.approx(1.5 * VOLUME, rel=1e-12)
    assert np.ptp(np.linalg.norm(found.vertices, axis=1)) < 1e-8
    # The inscribed polyhedron is smaller than its ball by some thousandths.
    assert found.level == pytest.approx(1.5 ** (1 / 3) - 1.0, abs=0.005)
    np.testing.assert_array_equal(found.faces, BALL.faces)
    assert (found.left, found.crossing) == (0, 0)


def test_what_the_cut_takes_away_lies_on_it():
    cut = Bone(5.0, (5.5, 0.0, 0.0))
    found = project_to_level_set(
        mesh_of(), np.asarray(BALL.vertices), Sphere(), cut=cut, volume=0.8 * VOLUME
    )
    assert cut(found.vertices).min() > -1e-5
    on_cut = np.abs(cut(found.vertices)) < 1e-4
    assert on_cut.sum() > 50
    # A level's last step is of first order.
    assert np.ptp(np.linalg.norm(found.vertices[~on_cut], axis=1)) < 1e-4
    assert not crossing_faces(found.vertices, found.faces).any()


def test_bone_vertices_end_up_outside():
    edge = mesh_of().edge(np.asarray(BALL.vertices))
    middle = BALL.triangles_center[0] * 0.97 ** (1 / 3)
    spike = (middle - 0.1 * edge * BALL.face_normals[0])[None]
    asked = {"volume": 0.97 * VOLUME, "obstacles": [(PointGrid(spike), np.eye(4))]}
    found = project_to_level_set(mesh_of(), np.asarray(BALL.vertices), Sphere(), **asked)
    depth = trimesh.proximity.signed_distance(trimesh.Trimesh(found.vertices, found.faces), spike)
    # A hundredth of an edge is the tolerance; 0.12 without being pushed.
    assert depth[0] <= 0.01 * edge
    assert mesh_volume(found.vertices, found.faces) == pytest.approx(0.97 * VOLUME, rel=1e-12)


def test_sheets_that_met_do_not_pull_vertices_off_the_material():
    mesh = mesh_of()
    mesh.slope = np.ones(len(BALL.vertices))
    x = np.asarray(BALL.vertices)
    carried = np.column_stack(
        [1.9 * x[:, 0], x[:, 1] * (0.4 + x[:, 0] ** 2), x[:, 2] * (0.4 + x[:, 0] ** 2)]
    )
    found = project_to_level_set(mesh, carried, Two(0.9), volume=mesh_volume(carried, mesh.faces))
    away = np.linalg.norm(found.vertices - carried, axis=1)
    assert away.max() <= 1.0 * mesh.edge(carried) + 1e-12
    assert found.left > 0 and found.crossing == 0


@pytest.mark.parametrize(("radius", "seed"), [(0.0, 5), (0.75, 2), (0.9, 1), (0.9, 3)])
def test_tangled_triangles_are_smoothed_until_none_cross(radius, seed):
    """Beside a bone the step to the volume made 5 to 13 triangles cross that did not before it."""
    rng = np.random.default_rng(seed)
    cut, share = (Bone(radius, (0.9, 0.1 * seed, 0.0)), 0.8) if radius else (None, 1.0)
    carried = BALL.vertices + 0.06 * rng.normal(size=BALL.vertices.shape)
    assert crossing_faces(carried, BALL.faces).sum() > 50
    found = project_to_level_set(mesh_of(), carried, Sphere(), volume=share * VOLUME, cut=cut)
    assert not crossing_faces(found.vertices, found.faces).any() and found.crossing == 0
    assert cut is None or cut(found.vertices).min() > -1e-3
    assert mesh_volume(found.vertices, found.faces) == pytest.approx(share * VOLUME, rel=1e-12)


@pytest.mark.parametrize("cut", [None, Bone(0.5, (1.3, 0.0, 0.0)), Bone(0.9, (0.0, 0.0, 0.9))])
@pytest.mark.parametrize("noise", [0.0, 0.15])
def test_a_carried_surface_keeps_volume_and_leaves_the_bone(cut, noise):
    """Vertices that were smoothed stay when the level changes: with much noise nothing else was
    left to be blown up.
    """
    carried = BALL.vertices + noise * np.random.default_rng(5).normal(size=BALL.vertices.shape)
    found = project_to_level_set(mesh_of(), carried, None, volume=VOLUME, cut=cut)
    assert found.left == len(BALL.vertices) and found.crossing == 0
    assert cut is None or cut(found.vertices).min() > -1e-3
    assert mesh_volume(found.vertices, found.faces) == pytest.approx(VOLUME, rel=1e-12)


def test_a_volume_that_no_level_reaches_is_an_error():
    flat = Sphere()
    flat.value_and_gradient = lambda p: (np.tanh(Sphere()(p)), Sphere().value_and_gradient(p)[1])
    with pytest.raises(ValueError, match="no level gives a volume"):
        project_to_level_set(mesh_of(), np.asarray(BALL.vertices), flat, volume=1e4)


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
    assert tree.closed and quick.any() == (noise != 0.0)
    np.testing.assert_array_equal(quick, crossing_faces(moved, faces))
    some = quick & (np.cumsum(quick) == 1)
    assert tree.crossing(moved, some)[some].all()
    tree.closed = False  # every pair that shares a corner is tested
    np.testing.assert_array_equal(quick, tree.crossing(moved))
    for other in (faces[1:], np.vstack([faces, faces[:1]])):
        assert not FaceTree(points, other).closed


@pytest.mark.parametrize("shift", [0.0, 0.1, -0.2])
def test_what_is_known_of_the_cut_changes_nothing(shift, monkeypatch):
    cut, carried = Bone(5.0, (5.6, 0.0, 0.0)), np.asarray(BALL.vertices) + [shift, 0.0, 0.0]
    spike = PointGrid(np.array([[0.6 + 1e-3, 0.0, 0.0], [0.62, 0.02, 0.01]]))
    given, found = {"volume": VOLUME, "cut": cut, "obstacles": [(spike, np.eye(4))]}, []
    for _ in range(2):
        found.append(project_to_level_set(mesh_of(), carried, Sphere(), **given).vertices)
        monkeypatch.setattr(
            CutBounds, "below", lambda _, places, rows=None: np.full(len(places), -np.inf)
        )
    np.testing.assert_allclose(*found, rtol=0, atol=1e-12)
    assert np.abs(cut(found[0])).min() < 1e-3


def test_points_near_triangles_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=5.0)
    vertices, faces = (
        np.asarray(ball.vertices),
        np.asarray(ball.faces)[ball.triangles_center[:, 0] > 0.0],
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    points = rng.uniform(-8.0, 8.0, (700, 3))
    grids = [(PointGrid(points), pose), (PointGrid(points[:0]), pose)]
    found = near_triangles(grids, vertices, faces, margin=0.8)
    corners = ((vertices - pose[:3, 3]) @ pose[:3, :3])[faces]
    inside = np.zeros((len(points), len(faces)), dtype=bool)
    for f, (a, b, c) in enumerate(corners):
        normal = np.cross(b - a, c - a)
        frame = np.column_stack([b - a, c - a, normal / np.linalg.norm(normal)])
        along = np.linalg.solve(frame, (points - a).T)
        beside = np.minimum(np.minimum(along[0], along[1]), 1.0 - along[0] - along[1])
        low, high = corners[f].min(axis=0) - 0.8, corners[f].max(axis=0) + 0.8
        boxed = ((points >= low) & (points <= high)).all(axis=1)
        inside[:, f] = boxed & (np.abs(along[2]) <= 0.8) & (beside >= -BESIDE)
    rows = np.flatnonzero(inside.any(axis=1))
    assert 30 < len(rows) < 400
    world = points @ pose[:3, :3].T + pose[:3, 3]
    order = [int(np.argmin(np.linalg.norm(world[rows] - point, axis=1))) for point in found.points]
    np.testing.assert_allclose(found.points, world[rows][order], atol=1e-12)
    for p, row in enumerate(rows[order]):
        near = found.faces[found.first[p] : found.first[p + 1]]
        np.testing.assert_array_equal(near, np.flatnonzero(inside[row]))


def onto_ball(mesh, vertices):
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True)


def planted(seed, count=12):
    """A ball some of whose vertices lie on or beyond a neighbour's far edge."""
    points, faces = np.array(BALL.vertices), np.array(BALL.faces)
    chosen = np.random.default_rng(seed).choice(len(faces), count, replace=False)
    for a, b, c in faces[chosen]:
        points[a] = (
            0.45 * (points[b] + points[c]) + 0.02 * (points[b] - points[a]) - 0.05 * points[a]
        )
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
