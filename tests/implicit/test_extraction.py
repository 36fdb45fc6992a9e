"""Level sets to closed meshes by marching cubes: topology, volume, cut."""

import inspect

import igl
import numpy as np
import pytest
import trimesh
from toy_scene import Formula

from rbfmuscle.geometry.point_grid import PointGrid
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit import extraction
from rbfmuscle.implicit.extraction import Grid, LevelSet

CENTRE = np.array([1.0, 2.0, 3.0])


def extract_surface(field, *, cut=None, **options):
    """The library's, of formulas too."""
    field = Formula(field) if inspect.isfunction(field) else field
    cut = None if cut is None else Formula(cut).value_and_gradient_below
    return extraction.extract_surface(field, cut=cut, **options)


def sphere(radius=50.0, centre=CENTRE):
    return lambda x: np.linalg.norm(x - centre, axis=1) - radius


def on_sphere(radius=50.0, centre=CENTRE):
    return trimesh.creation.icosphere(2, radius=radius).vertices + centre


def torus(x):
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 30.0, x[:, 2]) - 10.0


ON_TORUS = trimesh.creation.torus(30.0, 10.0).vertices


def check_manifold(vertices, faces):
    """Closed, consistently oriented, one fan of triangles at every vertex, outward."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh_volume(vertices, faces) > 0
    neighbours = np.bincount(mesh.edges_unique.ravel(), minlength=len(vertices))
    np.testing.assert_array_equal(neighbours, np.bincount(faces.ravel(), minlength=len(vertices)))
    return mesh


def check_closed(surface, euler=2):
    assert np.isfinite(surface.vertices).all()
    mesh = check_manifold(surface.vertices, surface.faces)
    assert mesh.body_count == 1 and mesh.euler_number == euler
    return mesh


@pytest.mark.parametrize(("radius", "box"), [(50.0, 50.0), (40.0, 50.0), (50.0, 40.0)])
def test_sphere_is_closed_exact_and_outward(radius, box):
    surface = extract_surface(sphere(radius), points=on_sphere(box))
    mesh = check_closed(surface)
    np.testing.assert_allclose(sphere(radius)(surface.vertices), 0.0, atol=1e-9)
    assert surface.volume == pytest.approx(mesh.volume, rel=1e-12)
    # Chords of a sphere at 48 cells leave 0.1 % of its volume out.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=2e-3)
    assert surface.components == 1


def test_torus_keeps_its_hole():
    check_closed(extract_surface(torus, points=ON_TORUS, resolution=32), euler=0)


@pytest.mark.parametrize("seed", range(4))
def test_any_pattern_of_signs_gives_a_closed_manifold(seed):
    rng = np.random.default_rng(seed)
    grid = Grid(np.zeros(3), 1.0, (9, 10, 11), np.eye(3))
    values = np.ones(grid.shape)
    values[1:-1, 1:-1, 1:-1] = rng.normal(size=(7, 8, 9))
    level_set = LevelSet(grid, lambda x: values[tuple(np.rint(x).astype(int).T)])
    vertices, faces = level_set.march(0.0)
    check_manifold(vertices, faces)
    assert not level_set.on_border(vertices).any()


@pytest.mark.parametrize("cut", [None, sphere(20.0, CENTRE + [45.0, 0, 0])])
@pytest.mark.parametrize("factor", [0.9, 1.0, 1.3])
def test_mesh_gets_the_wanted_volume(factor, cut):
    wanted = factor * 4 / 3 * np.pi * 50.0**3
    surface = extract_surface(sphere(), points=on_sphere(), volume=wanted, cut=cut)
    mesh = check_closed(surface)
    assert mesh.volume == pytest.approx(wanted, rel=1e-9)
    value = sphere()(surface.vertices) - surface.level
    if cut is not None:
        assert cut(surface.vertices).min() > -1e-6
        assert (np.abs(cut(surface.vertices)) < 1e-6).sum() > 50
        value = np.maximum(value, -cut(surface.vertices))
    # The last shift is taken to first order: 1e-5 of the radius.
    np.testing.assert_allclose(value, 0.0, atol=5e-4)
    if cut is None:  # with one the corner where both meet is cut otherwise
        steep = extract_surface(lambda x: 100 * sphere()(x), points=on_sphere(), volume=wanted)
        assert steep.level == pytest.approx(100 * surface.level, rel=1e-4)


def test_chords_do_not_cut_across_a_convex_bone():
    ball = trimesh.creation.icosphere(4, radius=15.0).apply_translation(CENTRE + [50.0, 0, 0])
    bone = sphere(15.0, CENTRE + [50.0, 0, 0])
    depths = []
    for obstacles in (None, [(PointGrid.of(np.array(ball.vertices)), np.eye(4))]):
        options = {"cut": bone, "obstacles": obstacles, "volume": 5e5, "resolution": 32}
        surface = extract_surface(sphere(), points=on_sphere(), **options)
        assert check_closed(surface).volume == pytest.approx(5e5, rel=1e-9)
        assert bone(surface.vertices).min() > -0.1
        distance = igl.signed_distance(np.array(ball.vertices), surface.vertices, surface.faces)[0]
        depths.append(-distance.min())
    # Cells of 3.1: the sagitta of a chord on the bone, and what may stay.
    assert depths[0] > 0.15
    assert depths[1] < 0.1


def test_spurious_sheets_are_counted_and_left_out():
    def two(x):
        return np.minimum(sphere(20.0)(x), sphere(6.0, CENTRE + [30.0, 0, 0])(x))

    points = np.vstack([on_sphere(20.0), CENTRE + [24.0, 0.2, 0.3]])
    # The small sphere leaves the points' box: an open sheet beside the muscle is no reason to fail.
    surface = extract_surface(two, points=points)
    check_closed(surface)
    assert surface.components == 2
    assert surface.vertices[:, 0].max() < CENTRE[0] + 20.1
    wide = np.vstack([points, CENTRE + [36.0, 0, 0]])
    assert extract_surface(two, points=wide).components == 2


@pytest.mark.parametrize(
    ("word", "field", "options"),
    [
        ("empty", lambda x: np.ones(len(x)), {}),
        ("open", lambda x: x[:, 2] - 1.0, {}),
        ("NaN", lambda x: np.where(x[:, 0] > 40, np.nan, sphere()(x)), {}),
        ("volume", lambda x: np.tanh(sphere()(x)), {"volume": 1e9}),
        ("volume", sphere(), {"volume": -1.0}),
        ("resolution", sphere(), {"resolution": 2}),
        ("axes", sphere(), {"axes": np.ones((3, 3))}),
    ],
)
def test_what_gives_no_surface_is_refused(word, field, options):
    with pytest.raises(ValueError, match=word):
        extract_surface(field, points=on_sphere(), **{"resolution": 12, **options})
