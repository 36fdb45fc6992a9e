"""Epsilon chosen on a surface: as good as a scan, and closed."""

import warnings

import numpy as np
import pytest
import trimesh

from rbfmuscle.implicit.extraction.sheets import count_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.implicit.selection import SPAN, EpsilonChoice, spacing, surface_miss
from rbfmuscle.implicit.shape_search import Limits
from rbfmuscle.implicit.surface_epsilon import choose_surface_epsilon
from rbfmuscle.implicit.zero_sets import OPEN, look_at_zero_sets
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.validation import NumericalWarning, UsageError


@pytest.fixture(scope="module")
def plate():
    """A thin, bent ellipsoid: mesh, its distance, 60 centres, held-out points."""
    mesh = trimesh.creation.icosphere(subdivisions=4).apply_scale([30.0, 18.0, 4.0])
    vertices = mesh.vertices + np.array([0.0, 0.0, 1.0]) * (mesh.vertices[:, :1] / 12.0) ** 2
    faces = np.asarray(mesh.faces)
    centres = sample_surface(vertices, faces, 60, placement="adaptive")
    held_out = sample_surface(vertices, faces, 600, placement="even").points
    return vertices, faces, MeshDistance(vertices, faces), centres, held_out


def both_ways(plate, kernel, epsilon):
    vertices, _, distance, centres, _ = plate
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        field = RBFField.fit_surface(centres.points, centres.normals, kernel=kernel, epsilon=epsilon)
        try:
            found = extract_surface(field, points=centres.points, resolution=48, search="box")
        except ValueError:
            return np.inf
    if found.components > 1:
        return np.inf  # sheets of its own away from the surface: no field to use
    there = MeshDistance(found.vertices, found.faces, closed=False).unsigned(vertices)
    return np.sqrt(0.5 * ((there**2).mean() + (distance.unsigned(found.vertices) ** 2).mean()))


@pytest.mark.parametrize("kernel", ["inverse_quadratic", "multiquadric", "wendland_c4", "matern_12"])
def test_choice_is_within_a_tenth_of_the_best_of_a_scan(plate, kernel):
    _, _, distance, centres, held_out = plate
    choice = choose_surface_epsilon(
        centres.points, centres.normals, kernel=kernel, held_out=held_out, distance=distance.unsigned
    )
    scan = np.geomspace(*SPAN, 20) / spacing(centres.points).mean()
    best = min(both_ways(plate, kernel, epsilon) for epsilon in scan)
    assert both_ways(plate, kernel, choice.epsilon) < 1.1 * best
    assert choice.objective < 1.3 * both_ways(plate, kernel, choice.epsilon)


@pytest.mark.parametrize("kernel", ["gaussian", "inverse_quadratic"])
def test_an_open_zero_set_is_passed_over(plate, kernel):
    _, _, distance, centres, held_out = plate
    data = {"kernel": kernel, "held_out": held_out}
    blind = choose_surface_epsilon(centres.points, centres.normals, **data)
    seen = choose_surface_epsilon(centres.points, centres.normals, distance=distance.unsigned, **data)
    if seen.broken:  # no gaussian shows one closed sheet here, which is said
        assert kernel == "gaussian" and "sheets at every epsilon" in seen.broken
        return
    assert np.isfinite(both_ways(plate, kernel, seen.epsilon))
    assert both_ways(plate, kernel, seen.epsilon) <= 1.05 * both_ways(plate, kernel, blind.epsilon)


def test_miss_is_the_distance_to_first_order_and_a_flat_field_misses(plate):
    _, _, _, centres, held_out = plate
    h = spacing(centres.points).mean()
    field = RBFField.fit_hermite(centres.points, centres.normals)
    found = extract_surface(field, points=centres.points, resolution=96)
    exact = MeshDistance(found.vertices, found.faces).unsigned(held_out)
    assert surface_miss(field, held_out, h) == pytest.approx(np.sqrt((exact**2).mean()), rel=0.1)
    with pytest.warns(NumericalWarning, match="does not reach"):
        narrow = RBFField.fit_hermite(centres.points, centres.normals, kernel="wendland_c4", epsilon=8.0 / h)
    assert np.sqrt((narrow(held_out) ** 2).mean()) < 0.1 * h  # 0 where it knows nothing
    assert surface_miss(narrow, held_out, h) > 0.5 * h


def test_with_a_ridge_the_whole_range_is_looked_at(plate):
    _, _, _, centres, held_out = plate
    data = {"kernel": "inverse_quadratic", "held_out": held_out}
    limits = Limits(bound=1e8, slow=0, scan=9)
    bounded = choose_surface_epsilon(centres.points, centres.normals, limits=limits, **data)
    h = spacing(centres.points).mean()
    assert (bounded.tried[:, 2] <= 1e8).all() and bounded.tried[0, 0] * h < 1.01 * SPAN[0]
    plain = choose_surface_epsilon(centres.points, centres.normals, limits=Limits(slow=0, scan=9), **data)
    assert plain.tried[0, 0] * h > 2.0 * SPAN[0]  # what is not sound ends the scan


def test_without_other_points_the_centres_choose(plate):
    centres = plate[3]
    alone = choose_surface_epsilon(centres.points, centres.normals, kernel="matern_52")
    assert alone.epsilon > 0
    with pytest.raises(UsageError, match="held_out points"):
        choose_surface_epsilon(centres.points, centres.normals, kernel="matern_52", criterion="held_out")


class Shape:
    """A field made of a function of points that is negative inside."""

    condition = 1.0

    def __init__(self, function):
        self.function = function

    def __call__(self, points):
        return self.function(points)

    def value_and_gradient(self, points):
        step = 1e-5 * np.eye(3)
        slopes = [(self(points + d) - self(points - d)) / 2e-5 for d in step]
        return self(points), np.stack(slopes, axis=1)


def ball(points, centre=0.0, radius=10.0):
    return np.linalg.norm(points - np.array([centre, 0.0, 0.0]), axis=1) - radius


def test_a_slender_bent_tube_is_one_sheet_though_the_coarse_box_cuts_it():
    """The cells of the box are 5 wide, the tube 4; a ball beside it is a sheet of its own at any grid."""

    def tube(points):
        x, y, z = points.T
        across = np.hypot(y - 10.0 * np.sin(x / 20.0), z)
        return np.hypot(across, np.maximum(np.abs(x) - 95.0, 0.0)) - 2.0

    x = np.linspace(-95.0, 95.0, 400)
    points = np.c_[x, 10.0 * np.sin(x / 20.0), 2.0 + 0.0 * x]
    field, alone = Shape(tube), dict(points=points, resolution=40, search="box", keep="all")
    assert extract_surface(field, **alone).components > 1
    assert count_sheets(field, points, field).sound()
    both = Shape(lambda at: np.minimum(tube(at), ball(at - [0.0, 10.0, 0.0], 70.0, 3.0)))
    assert count_sheets(both, np.vstack([points, [[0.0, 14.0, 0.0]]]), field).number > 1


def test_sheets_beyond_the_box_of_a_band_and_open_ones_are_seen():
    """Whatever the cells, the box is the same: a ball 12 off, of radius 1.5, touches none of the surface's cells."""
    points = np.vstack([10.0 * trimesh.creation.icosphere(subdivisions=2).vertices, [[30.0, 0.0, 0.0]]])
    two = Shape(lambda at: np.minimum(ball(at), ball(at, 22.0, 1.5)))
    assert count_sheets(Shape(ball), points, ball).sound()
    assert count_sheets(two, points, ball) == (2, False, 40)
    assert count_sheets(two, points, ball, wanted=2).sound(2)
    halved = Shape(lambda at: np.minimum(ball(at), at[:, 0] - 11.0))
    assert count_sheets(halved, points, ball).is_open
    assert count_sheets(Shape(lambda at: 1.0 + 0.0 * at[:, 0]), points, ball).number == 0


@pytest.fixture
def looked():
    """``looked(tried, fit, limits)``: the choice after its zero sets were looked at, round a ball."""
    points = np.vstack([10.0 * trimesh.creation.icosphere(subdivisions=2).vertices, [[15.0, 0.0, 0.0]]])

    def ask(tried, fit, limits=None):
        limits = limits or Limits()
        limits.start()
        choice = EpsilonChoice(float(tried[0, 0]), 0.1, 1e7, tried)
        miss = lambda field: field.missed  # noqa: E731
        return look_at_zero_sets(choice, limits, fit, miss, points, ball)

    return ask


def shape(function, missed=0.1):
    made = Shape(function)
    made.missed = missed
    return made


def two_balls(at):
    return np.minimum(ball(at), ball(at, 12.6, 2.0))


def test_narrower_kernels_are_looked_at_where_all_flat_ones_have_sheets_of_their_own(looked):
    epsilons = np.geomspace(0.1, 10.0, 9)
    tried = np.c_[epsilons, 0.1 * (1.0 + 0.05 * np.arange(9)), 1e6 / epsilons]
    found = looked(tried, lambda epsilon: shape(two_balls if epsilon < 1.5 else ball))
    assert not found.broken and 1.5 < found.epsilon < 1.6  # halved four times from 1.78


def test_many_alike_that_broke_do_not_use_up_the_looks(looked):
    """Forty of the least error within a factor of 1.5, which all broke, and one that did not."""
    epsilons = np.r_[np.geomspace(1.0, 1.5, 40), 3.0]
    tried = np.c_[epsilons, np.r_[np.full(40, 0.1), 0.2], np.full(41, 1e6)]
    found = looked(tried, lambda epsilon: shape(two_balls if epsilon < 2.5 else ball, 0.2 * epsilon / 3.0))
    assert not found.broken and 2.5 < found.epsilon <= 2.6


def test_what_is_open_in_the_box_broke_and_is_no_error(looked):
    tried = np.c_[[1.0, 2.0, 3.0], [0.1, 0.11, 0.12], [1e6, 1e6, 1e6]]

    def everywhere(at):
        return at[:, 0] - 11.0

    found = looked(tried, lambda epsilon: shape(everywhere))
    assert found.broken == OPEN
    one = looked(tried, lambda epsilon: shape(everywhere if epsilon < 2.5 else ball))
    assert not one.broken and one.epsilon > 2.4


def test_a_better_condition_that_costs_too_much_both_ways_is_given_back_but_for_a_part(looked):
    """To first order all are alike; both ways the error grows with epsilon, as of balls that are larger and larger."""
    epsilons = np.array([0.1, 0.2, 0.4, 0.8])
    tried = np.c_[epsilons, 0.1 * np.array([1.0, 1.005, 1.01, 1.015]), 1e6 / epsilons]

    def grown(epsilon):
        made = shape(lambda at: ball(at, 0.0, 10.05 + 0.06 * ((epsilon - 0.1) / 0.7) ** 2), 0.1)
        made.condition = 1e6 / epsilon
        return made

    found = looked(tried, grown)
    least = looked(tried[:1], grown)
    assert 0.2 < found.epsilon < 0.4  # not the best-conditioned, 0.8, and not the least error alone
    assert found.objective <= 1.02 * least.objective and found.condition < 1e7
    alike = looked(tried, lambda epsilon: shape(ball))
    assert alike.epsilon == 0.8  # where it costs nothing, the best-conditioned


def test_a_sheet_far_from_its_surface_keeps_looks_away(looked):
    """Closed and one, but 0.6 away where the points say 0.1: the next look is not beside it."""
    asked = []

    def fit(epsilon):
        asked.append(epsilon)
        return shape(ball if epsilon > 1.5 else lambda at: ball(at, 0.0, 10.6), 0.1)

    epsilons = np.r_[np.geomspace(1.0, 1.1, 6), 2.0]
    found = looked(np.c_[epsilons, np.linspace(0.1, 0.12, 7), np.full(7, 1e6)], fit)
    assert found.epsilon > 1.5 and len([e for e in asked if e < 1.14]) == 1


def test_a_field_flat_between_its_centres_is_never_looked_at(looked):
    tried = np.array([[1.0, 4.0, 1e3], [2.0, 5.0, 1e3]])  # the centres are 5 apart
    found = looked(tried, lambda epsilon: pytest.fail("looked at"))
    assert found.broken.startswith("the field is flat between the centres")
