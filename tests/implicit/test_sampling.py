"""Centres on closed meshes: cover, normals, control triangulation."""

import numpy as np
import pytest
import trimesh
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import even_points
from rbfmuscle.implicit import placement
from rbfmuscle.implicit.field import RBFField, off_surface_points
from rbfmuscle.implicit.placement import contract_clusters, sample_surface
from rbfmuscle.validation import MeshError

SHAPES = {
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=4, radius=10.0),
    "ellipsoid": lambda: trimesh.creation.icosphere(subdivisions=4).apply_scale([30.0, 10.0, 5.0]),
    "torus": lambda: trimesh.creation.torus(20.0, 6.0, major_sections=80, minor_sections=40),
    "plate": lambda: trimesh.creation.box((60.0, 40.0, 1.0)),
    "box of 12 triangles": lambda: trimesh.creation.box((10.0, 20.0, 30.0)),
    "two spheres": lambda: trimesh.util.concatenate(
        [trimesh.creation.icosphere(3), trimesh.creation.icosphere(3).apply_translation([5, 0, 0])]
    ),
}


def check_control(mesh, sample, count):
    control = trimesh.Trimesh(sample.points, sample.control_faces, process=False)
    assert control.is_watertight and control.is_winding_consistent and control.volume > 0
    assert control.euler_number == mesh.euler_number
    assert len(np.unique(sample.control_faces)) == count == len(sample.points)
    # One fan of triangles at every vertex: as many faces as distinct neighbours.
    valence = np.bincount(control.edges_unique.ravel(), minlength=count)
    np.testing.assert_array_equal(
        valence, np.bincount(sample.control_faces.ravel(), minlength=count)
    )


@pytest.mark.parametrize(("count", "placement"), [(60, "even"), (300, "adaptive"), (100, "greedy")])
@pytest.mark.parametrize("shape", SHAPES)
def test_points_lie_on_the_surface_in_a_manifold_of_the_same_genus(shape, count, placement):
    mesh = SHAPES[shape]()
    sample = sample_surface(mesh.vertices, mesh.faces, count, placement=placement)
    check_control(mesh, sample, count)
    # No two points may meet, or the fit is singular.
    gaps = trimesh.proximity.cKDTree(sample.points).query(sample.points, k=2)[0][:, 1]
    assert gaps.min() > 0.1 * np.sqrt(mesh.area / count)
    np.testing.assert_allclose(np.linalg.norm(sample.normals, axis=1), 1.0, rtol=1e-12)
    distance = ExactDistance(mesh.vertices, mesh.faces).signed_distance(sample.points)
    np.testing.assert_allclose(distance, 0.0, atol=1e-9 * mesh.scale)


def test_sphere_is_covered_evenly_with_radial_normals():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    sample = sample_surface(mesh.vertices, mesh.faces, 300, placement="even")
    # Area nearest to each point, by many points spread evenly.
    points = even_points(mesh.vertices, mesh.faces, 40_000)[0]
    share = np.bincount(trimesh.proximity.cKDTree(sample.points).query(points)[1], minlength=300)
    assert share.std() / share.mean() < 0.12  # 0.09 of it by the 130 points that measure a cell
    gaps = trimesh.proximity.cKDTree(sample.points).query(sample.points, k=2)[0][:, 1]
    # Hexagonal packing would give 2.2; clusters of mesh vertices come within a third of it.
    assert gaps.min() > 0.67 * np.sqrt(2 / np.sqrt(3) * mesh.area / 300)
    radial = sample.points / np.linalg.norm(sample.points, axis=1)[:, None]
    # A facet of this sphere leans by up to 2 degrees.
    assert (radial * sample.normals).sum(axis=1).min() > np.cos(np.radians(2))


def test_scrambled_clusters_still_contract_to_a_manifold():
    mesh = trimesh.creation.torus(20.0, 6.0, major_sections=40, minor_sections=20)
    labels = np.random.default_rng(3).integers(0, 40, len(mesh.vertices))
    final, control = contract_clusters(mesh.faces, labels, np.ones(len(labels)), 40)
    assert set(final) == set(range(40))
    mesh_of_points = trimesh.Trimesh(mesh.vertices[:40], control, process=False)
    assert mesh_of_points.is_watertight
    assert mesh_of_points.euler_number == 0


def test_greedy_cells_start_from_adaptive_ones_and_only_gain():
    """Misses are counted where the cells were chosen by: at vertices of an unsplit mesh."""
    mesh = trimesh.creation.icosphere(subdivisions=4).apply_scale([30.0, 10.0, 2.0])

    def miss(placement):
        sample = sample_surface(mesh.vertices, mesh.faces, 60, placement=placement)
        off = np.abs(RBFField.fit_hermite(sample.points, sample.normals)(mesh.vertices))
        return np.sqrt((off**2).mean()) + 0.2 * off.max()

    assert miss("greedy") < miss("adaptive")


@pytest.mark.parametrize("placement", ["even", "adaptive", "greedy"])
def test_sheets_that_meet_in_a_vertex_are_sampled_as_if_apart(placement):
    mesh = trimesh.creation.icosphere(3, 10.0)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    upper, lower = vertices[:, 2].argmax(), vertices[:, 2].argmin()
    vertices[[upper, lower]] = 0.0
    joined = np.where(faces == lower, upper, faces)
    sample = sample_surface(vertices, joined, 60, placement=placement)
    check_control(mesh, sample, 60)


@pytest.mark.parametrize(
    ("error", "words", "count", "placement", "dropped"),
    [
        (MeshError, "closed", 20, "even", 1),
        (MeshError, "topology", 5, "even", 0),
        (ValueError, "at least 4", 3, "even", 0),
        (ValueError, "placement", 20, "evn", 0),
    ],
)
def test_what_cannot_be_sampled_is_refused(error, words, count, placement, dropped):
    mesh = SHAPES["torus"]()
    with pytest.raises(error, match=words):
        sample_surface(mesh.vertices, mesh.faces[dropped:], count, placement=placement)


def test_off_surface_points_stay_nearest_to_their_own_point():
    """Two sheets 0.8 apart: half the distance to the nearest point outside, a quarter of the gap
    inside.
    """
    sheet = np.stack(np.meshgrid(*[np.arange(5.0)] * 2), axis=-1).reshape(-1, 2)
    points = np.vstack([np.c_[sheet, np.zeros(25)], np.c_[sheet, np.full(25, 0.8)]])
    normals = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], 25, axis=0)
    where, values = off_surface_points(points, normals)
    np.testing.assert_allclose(values, np.repeat([0.0, 0.4, -0.2], 50), atol=1e-12)
    distance, owner = trimesh.proximity.cKDTree(points).query(where)
    np.testing.assert_allclose(distance, np.abs(values), atol=1e-12)
    np.testing.assert_array_equal(owner, np.tile(np.arange(50), 3))


def test_cells_are_those_from_which_no_vertex_wants_to_go(monkeypatch):
    """Once more over the edges moves nothing, as the loop only ends there."""
    loop, seen = placement._equalise_loop, []

    def twice(*given):
        loop(*given)
        labels = given[3].copy()
        loop(*given)
        seen.append(np.array_equal(labels, given[3]))

    monkeypatch.setattr(placement, "_equalise_loop", twice)
    mesh = SHAPES["ellipsoid"]()
    sample_surface(mesh.vertices, mesh.faces, 40, placement="even")
    assert seen == [True]


def test_cells_start_from_farthest_points():
    """Against a search of all vertices by shortest paths from all points so far."""
    mesh = trimesh.creation.icosphere(2, 10.0)
    vertices = mesh.vertices * np.random.default_rng(4).uniform(0.7, 1.3, (len(mesh.vertices), 1))
    fine = placement.refine_mesh(vertices, np.asarray(mesh.faces), 60)
    count = len(fine.vertices)
    # Shortest paths of the least SciPy take indices of 32 bits alone.
    start, other = fine.start.astype(np.int32), fine.other.astype(np.int32)
    graph = csr_array((fine.length, other, start), shape=(count, count))
    labels = np.full(count, -1)
    placement._farthest_loop(fine.start, fine.other, fine.length, 5, 40, labels)
    chosen = [5]
    while len(chosen) < 40:
        chosen.append(int(np.argmax(dijkstra(graph, indices=chosen, min_only=True))))
    wanted = np.argmin(dijkstra(graph, indices=chosen), axis=0)
    np.testing.assert_array_equal(labels, wanted)
