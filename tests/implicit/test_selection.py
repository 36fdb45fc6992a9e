"""Epsilon chosen on a surface: as good as a scan, closed, in one sheet; and how sheets are
counted."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from toy_scene import Formula

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.implicit.extraction import extract_surface, find_sheets
from rbfmuscle.implicit.field import FieldFit, RBFField
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.implicit.placement import sample_surface
from rbfmuscle.implicit.selection import BOUND, SPAN, choose_epsilon, spacing, surface_error
from rbfmuscle.validation import NumericalWarning, UsageError


def fit_of(kernel, condition=BOUND):
    return FieldFit(get_kernel(kernel), 1.0, condition)


@pytest.fixture(scope="module")
def plate():
    """A thin, bent ellipsoid: mesh, its distance, 60 centres, held-out points."""
    mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([30.0, 18.0, 4.0])
    vertices = mesh.vertices + np.array([0.0, 0.0, 1.0]) * (mesh.vertices[:, :1] / 12.0) ** 2
    faces = np.asarray(mesh.faces)
    centres = sample_surface(vertices, faces, 60, placement="adaptive")
    held_out = sample_surface(vertices, faces, 600, placement="even").points
    return vertices, faces, MeshDistance(vertices, faces), centres, held_out


def both_ways(plate, kernel, epsilon):
    vertices, _, distance, centres, _ = plate
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        field = replace(fit_of(kernel), epsilon=epsilon).fit(centres.points, centres.normals)
        if not find_sheets(field, centres.points, distance.unsigned).sound():
            return np.inf  # sheets of its own away from the surface: no field to use
        found = extract_surface(field, points=centres.points, resolution=40)
    there = MeshDistance(found.vertices, found.faces, closed=False).unsigned(vertices)
    return np.sqrt(0.5 * ((there**2).mean() + (distance.unsigned(found.vertices) ** 2).mean()))


@pytest.mark.parametrize(
    "kernel", ["inverse_quadratic", "multiquadric", "wendland_c4", "matern_12"]
)
def test_choice_is_within_a_tenth_of_the_best_of_a_scan(plate, kernel):
    _, _, distance, centres, held_out = plate
    given = centres.points, centres.normals, fit_of(kernel)
    choice = choose_epsilon(*given, held_out=held_out, distance=distance.unsigned)
    scan = np.geomspace(*SPAN, 10) / spacing(centres.points).mean()
    best = min(both_ways(plate, kernel, epsilon) for epsilon in scan)
    assert both_ways(plate, kernel, choice.epsilon) < 1.1 * best
    assert choice.error < 1.3 * both_ways(plate, kernel, choice.epsilon)


@pytest.mark.parametrize("kernel", ["gaussian", "inverse_quadratic"])
def test_a_zero_set_in_several_sheets_is_passed_over(plate, kernel):
    _, _, distance, centres, held_out = plate
    given = centres.points, centres.normals, fit_of(kernel)
    blind = choose_epsilon(*given, held_out=held_out)
    seen = choose_epsilon(*given, held_out=held_out, distance=distance.unsigned)
    assert seen.broken or np.isfinite(both_ways(plate, kernel, seen.epsilon))
    if not seen.broken:
        assert both_ways(plate, kernel, seen.epsilon) <= 1.05 * both_ways(
            plate, kernel, blind.epsilon
        )


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_epsilon_scales_with_the_unit(plate, size):
    _, _, _, centres, held_out = plate
    points, given = centres.points, (centres.normals, fit_of("wendland_c2"))
    plain = choose_epsilon(points, *given, held_out=held_out)
    other = choose_epsilon(size * points, *given, held_out=size * held_out)
    # golden sections compare errors that differ by rounding; the minimum itself is flat
    assert other.epsilon * size == pytest.approx(plain.epsilon, rel=1e-3)
    assert other.error == pytest.approx(size * plain.error, rel=1e-6)


def test_wrong_requests_are_answered(plate):
    centres = plate[3]
    with pytest.raises(UsageError, match="no shape parameter"):
        choose_epsilon(centres.points, centres.normals, fit_of("cubic"), held_out=plate[4])
    for count, words in ((3, "coincides"), (1, "at least 2 points, got 1")):
        with pytest.raises(UsageError, match=words):
            spacing(np.zeros((count, 3)))


def test_miss_is_the_distance_to_first_order_and_a_flat_field_misses(plate):
    _, _, _, centres, held_out = plate
    h = spacing(centres.points).mean()
    field = RBFField.fit_hermite(centres.points, centres.normals)
    found = extract_surface(field, points=centres.points, resolution=96)
    exact = MeshDistance(found.vertices, found.faces).unsigned(held_out)
    assert surface_error(field, held_out, h) == pytest.approx(np.sqrt((exact**2).mean()), rel=0.1)
    with pytest.warns(NumericalWarning, match="does not reach"):
        narrow = RBFField.fit_hermite(
            centres.points, centres.normals, kernel="wendland_c4", epsilon=8.0 / h
        )
    assert np.sqrt((narrow(held_out) ** 2).mean()) < 0.1 * h  # 0 where it knows nothing
    assert surface_error(narrow, held_out, h) > 0.5 * h


def ball(points, centre=0.0, radius=10.0):
    return np.linalg.norm(points - np.array([centre, 0.0, 0.0]), axis=1) - radius


def test_a_slender_bent_tube_is_sound_though_the_cells_cut_it():
    """The cells are 3 wide, the tube 2; a ball beside it is a stray sheet at any grid."""

    def tube(points):
        x, y, z = points.T
        across = np.hypot(y - 10.0 * np.sin(x / 20.0), z)
        return np.hypot(across, np.maximum(np.abs(x) - 95.0, 0.0)) - 1.0

    x = np.linspace(-95.0, 95.0, 400)
    points = np.c_[x, 10.0 * np.sin(x / 20.0), 1.0 + 0.0 * x]
    field = Formula(tube)
    assert extract_surface(field, points=points, resolution=64).components > 1
    assert find_sheets(field, points, field).sound()
    both = Formula(lambda at: np.minimum(tube(at), ball(at - [0.0, 10.0, 0.0], 70.0, 4.0)))
    assert find_sheets(both, np.vstack([points, [[0.0, 14.0, 0.0]]]), field).stray == 1


def test_stray_and_open_sheets_in_the_box_are_seen():
    points = np.vstack(
        [10.0 * trimesh.creation.icosphere(subdivisions=2).vertices, [[30.0, 0.0, 0.0]]]
    )
    two = Formula(lambda at: np.minimum(ball(at), ball(at, 22.0, 1.5)))
    assert find_sheets(Formula(ball), points, ball) == (0, False, True)
    assert find_sheets(two, points, ball) == (1, False, True)
    halved = Formula(lambda at: np.minimum(ball(at), at[:, 0] - 11.0))
    assert find_sheets(halved, points, ball).is_open
    assert not find_sheets(Formula(lambda at: 1.0 + 0.0 * at[:, 0]), points, ball).found
