"""Level sets to closed meshes: band, marching cubes, volume, cut."""

import inspect
import os
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.extraction import surface as extraction
from rbfmuscle.implicit.extraction.marching import Band, Grid
from rbfmuscle.implicit.extraction.obstacles import PointGrid
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.sampling import sample_surface

HIP = Path(os.environ.get("RBFMUSCLE_DATA", Path(__file__).parents[3] / "shared" / "data")) / "hip"
MUSCLES = ("gluteus_maximus", "gluteus_medius", "iliacus", "adductor_brevis")
needs_hip = pytest.mark.skipif(not HIP.exists(), reason="real hip not present (RBFMUSCLE_DATA)")
CENTRE = np.array([1.0, 2.0, 3.0])


class Formula:
    """A field or a cut from a formula for its values; gradients are central differences."""

    def __init__(self, formula, step=2e-4):
        self.formula, self.step = formula, step

    def __call__(self, points):
        return self.formula(points)

    def value_and_gradient(self, points):
        offsets = self.step * np.vstack([np.eye(3), -np.eye(3)])
        around = self.formula((points[None] + offsets[:, None]).reshape(-1, 3)).reshape(6, -1)
        return self.formula(points), ((around[:3] - around[3:]) / (2.0 * self.step)).T

    def value_and_gradient_below(self, points, limit):
        value, gradient = self.formula(points), np.zeros_like(points)
        rows = np.flatnonzero(value < limit)
        if len(rows):
            value[rows], gradient[rows] = self.value_and_gradient(points[rows])
        return value, gradient


def extract_surface(field, *, cut=None, **options):
    """The library's, of formulas too."""
    field, cut = (Formula(part) if inspect.isfunction(part) else part for part in (field, cut))
    return extraction.extract_surface(field, cut=cut, **options)


def sphere(radius=50.0, centre=CENTRE):
    return lambda x: np.linalg.norm(x - centre, axis=1) - radius


def on_sphere(radius=50.0, centre=CENTRE):
    return trimesh.creation.icosphere(2, radius=radius).vertices + centre


def torus(x):
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 30.0, x[:, 2]) - 10.0


ON_TORUS = trimesh.creation.torus(30.0, 10.0).vertices


def check_closed(surface, euler=2):
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert np.isfinite(surface.vertices).all()
    directed = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert (np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)[1] == 2).all()
    valence = np.bincount(directed[:, 0], minlength=len(mesh.vertices))
    fans = trimesh.graph.connected_components(mesh.edges_unique, min_len=1)
    assert valence.min() >= 3
    assert len(fans) == 1
    assert mesh.volume > 0
    if euler is not None:
        assert mesh.euler_number == euler
    return mesh


def test_sphere_is_closed_exact_and_outward():
    surface = extract_surface(sphere(), points=on_sphere())
    mesh = check_closed(surface)
    np.testing.assert_allclose(sphere()(surface.vertices), 0.0, atol=1e-9)
    assert surface.volume == pytest.approx(mesh.volume, rel=1e-12)
    # Chords of a sphere at 48 cells leave 0.1 % of its volume out.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 50.0**3, rel=2e-3)
    assert surface.components == 1


def test_torus_keeps_its_hole():
    check_closed(extract_surface(torus, points=ON_TORUS, resolution=32), euler=0)


@pytest.mark.parametrize("seed", range(4))
def test_any_pattern_of_signs_gives_a_closed_manifold(seed):
    rng = np.random.default_rng(seed)
    grid = Grid(np.zeros(3), 1.0, (9, 10, 11), np.eye(3))
    values = np.ones(grid.shape)
    values[1:-1, 1:-1, 1:-1] = rng.normal(size=(7, 8, 9))
    band = Band(grid, lambda x: values[tuple(np.rint(x).astype(int).T)])
    band.visit_all()
    vertices, faces, on_border, _ = band.march(0.0)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert (np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)[1] == 2).all()
    neighbours = np.bincount(np.unique(directed, axis=0)[:, 0], minlength=len(vertices))
    np.testing.assert_array_equal(neighbours, np.bincount(faces.ravel(), minlength=len(vertices)))
    assert not on_border.any()
    assert mesh_volume(vertices, faces) > 0


def test_band_follows_the_surface_from_a_single_point_and_evaluates_little():
    few = np.vstack([on_sphere().min(axis=0), on_sphere().max(axis=0), CENTRE + [50.0, 0, 0]])
    asked = []

    class Counted(Formula):
        def __init__(self):
            super().__init__(sphere())

        def __call__(self, points):
            asked.append(len(points))
            return self.formula(points)

    surface = extraction.extract_surface(Counted(), points=few)
    whole = extract_surface(sphere(), points=on_sphere())
    np.testing.assert_allclose(np.sort(surface.vertices, axis=0), np.sort(whole.vertices, axis=0), atol=1e-9)
    assert sum(asked) < 0.2 * np.prod(Grid.around(few, resolution=48).shape)


def test_band_finds_a_surface_that_predicted_points_miss():
    surface = extract_surface(sphere(40.0), points=on_sphere(50.0))
    check_closed(surface)
    np.testing.assert_allclose(sphere(40.0)(surface.vertices), 0.0, atol=1e-9)


@pytest.mark.parametrize("cut", [None, sphere(20.0, CENTRE + [45.0, 0, 0])])
@pytest.mark.parametrize("factor", [0.9, 1.0, 1.3])
def test_mesh_gets_the_wanted_volume(factor, cut):
    wanted = factor * 4 / 3 * np.pi * 50.0**3
    surface = extract_surface(sphere(), points=on_sphere(), volume=wanted, cut=cut)
    mesh = check_closed(surface)
    assert mesh.volume == pytest.approx(wanted, rel=1e-9)
    value = sphere()(surface.vertices) - surface.level
    if cut is not None:
        value = np.maximum(value, -cut(surface.vertices))
    # The last shift is taken to first order: 1e-5 of the radius.
    np.testing.assert_allclose(value, 0.0, atol=5e-4)


def test_volume_does_not_depend_on_the_scale_of_the_field():
    wanted = 1.2 * 4 / 3 * np.pi * 50.0**3
    plain = extract_surface(sphere(), points=on_sphere(), volume=wanted)
    steep = extract_surface(lambda x: 100 * sphere()(x), points=on_sphere(), volume=wanted)
    assert steep.level == pytest.approx(100 * plain.level, rel=1e-4)


def test_cut_leaves_nothing_inside_the_bone():
    bone = sphere(20.0, CENTRE + [45.0, 0, 0])
    surface = extract_surface(sphere(), points=on_sphere(), cut=bone)
    check_closed(surface)
    assert bone(surface.vertices).min() > -1e-6
    # Both parts of the surface are there.
    assert (np.abs(bone(surface.vertices)) < 1e-6).sum() > 50
    assert (np.abs(sphere()(surface.vertices)) < 1e-6).sum() > 1000


def test_a_cut_that_answers_only_below_a_limit_gives_the_same_mesh():
    middle = CENTRE + [45.0, 0, 0]
    bone = sphere(20.0, middle)

    class Limited:
        def __call__(self, points):
            return bone(points)

        def value_and_gradient_below(self, points, limit):
            value = bone(points)
            gradient = (points - middle) / np.linalg.norm(points - middle, axis=1)[:, None]
            value[value >= limit] = np.inf
            return value, gradient

    plain = extract_surface(sphere(), points=on_sphere(), volume=5e5, cut=bone)
    surface = extract_surface(sphere(), points=on_sphere(), volume=5e5, cut=Limited())
    assert np.array_equal(surface.faces, plain.faces)
    assert np.abs(surface.vertices - plain.vertices).max() < 1e-6 * plain.spacing


def test_chords_do_not_cut_across_a_convex_bone():
    ball = trimesh.creation.icosphere(4, radius=15.0).apply_translation(CENTRE + [50.0, 0, 0])
    bone = sphere(15.0, CENTRE + [50.0, 0, 0])
    depths = []
    for obstacles in (None, [(PointGrid(np.array(ball.vertices)), np.eye(4))]):
        surface = extract_surface(
            sphere(), points=on_sphere(), cut=bone, obstacles=obstacles, volume=5e5, resolution=32
        )
        mesh = check_closed(surface)
        assert mesh.volume == pytest.approx(5e5, rel=1e-9)
        assert bone(surface.vertices).min() > -0.1
        distance = igl.signed_distance(
            np.array(ball.vertices), surface.vertices, surface.faces,
            sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
        )[0]  # fmt: skip
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


def test_surface_that_outgrows_the_box_is_still_closed():
    surface = extract_surface(sphere(50.0), points=on_sphere(50.0)[:40] * 0.8, resolution=24)
    check_closed(surface)


def test_empty_and_open_level_sets_are_refused():
    with pytest.raises(ValueError, match="empty"):
        extract_surface(lambda x: np.ones(len(x)), points=on_sphere(), resolution=12)
    with pytest.raises(ValueError, match="open"):
        extract_surface(lambda x: x[:, 2] - 1.0, points=on_sphere(), resolution=12)


def test_nan_is_never_silent():
    def broken(x):
        values = sphere()(x)
        values[x[:, 0] > 40] = np.nan
        return values

    with pytest.raises(ValueError, match="NaN"):
        extract_surface(broken, points=on_sphere(), resolution=12)


@pytest.mark.parametrize("bad", [{"volume": -1.0}, {"resolution": 2}, {"axes": np.ones((3, 3))}])
def test_bad_arguments_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        extract_surface(sphere(), points=on_sphere(), **bad)


def test_volume_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="volume"):
        extract_surface(lambda x: np.tanh(sphere()(x)), points=on_sphere(), volume=1e9, resolution=12)


def test_mesh_moves_rigidly_with_the_grid_axes():
    rotation = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    offset = np.array([1e4, -2e3, 5e2])
    # Turned by little, so that no point lies on the border of two cells.
    turn = trimesh.transformations.rotation_matrix(0.1, [3, 1, 2])[:3, :3]
    ellipsoid = trimesh.creation.icosphere(3).vertices @ turn * [40.0, 20.0, 10.0]

    def field(x):
        return np.linalg.norm(x / [40.0, 20.0, 10.0], axis=1) - 1

    rest = extract_surface(field, points=ellipsoid, volume=30000.0)
    moved = extract_surface(
        lambda x: field((x - offset) @ rotation),
        points=ellipsoid @ rotation.T + offset,
        volume=30000.0,
        axes=rotation.T,
    )
    np.testing.assert_array_equal(moved.faces, rest.faces)
    np.testing.assert_allclose(moved.vertices, rest.vertices @ rotation.T + offset, atol=1e-7)


@needs_hip
@pytest.mark.parametrize("muscle", MUSCLES)
def test_real_muscles_come_out_closed_with_their_volume(muscle):
    mesh = trimesh.load(HIP / f"{muscle}.ply", process=False)
    sample = sample_surface(mesh.vertices, mesh.faces, 300)
    field = RBFField.fit_hermite(sample.points, sample.normals)
    surface = extract_surface(field, points=sample.points, resolution=48, volume=mesh.volume)
    check_closed(surface)
    assert surface.volume == pytest.approx(mesh.volume, rel=1e-9)
    assert surface.components == 1
    np.testing.assert_allclose(field(surface.vertices), surface.level, atol=0.02)
