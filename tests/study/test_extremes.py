"""The extremes: right within a bound, or a warning or error that says why. Never silently wrong."""

import warnings

import numpy as np
import pytest

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import KERNELS
from rbfmuscle.study.experiment import extremes
from rbfmuscle.study.experiment.extremes import extremes_matrix, study_extremes, write_extremes
from rbfmuscle.validation import NumericalWarning

WITH_EPSILON = [name for name, kernel in KERNELS.items() if kernel.has_epsilon]
HERMITE = [name for name, kernel in KERNELS.items() if kernel.hermite]


def sphere(count, radius=1.0):
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return radius * np.c_[ring * np.cos(angle), ring * np.sin(angle), z]


def watched(call):
    """Result and whether anything was said."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            return call(), bool(heard)
        except np.linalg.LinAlgError as error:
            assert "singular fit" in str(error)
            return None, True


@pytest.mark.parametrize("kernel", WITH_EPSILON)
@pytest.mark.parametrize("epsilon", [1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3])
@pytest.mark.parametrize("hermite", [True, False])
def test_conditions_are_met_for_any_epsilon_or_a_warning_says_so(kernel, epsilon, hermite):
    points = sphere(100) * [1.0, 0.8, 0.5]
    if hermite and not KERNELS[kernel].hermite:
        return
    values = points[:, 0] ** 2
    if hermite:
        field, said = watched(
            lambda: RBFField.fit_hermite(points, sphere(100), kernel=kernel, epsilon=epsilon)
        )
        residual = 0.0 if field is None else np.abs(field(points)).max()
    else:
        field, said = watched(lambda: RBFField.fit(points, values, kernel=kernel, epsilon=epsilon))
        residual = 0.0 if field is None else np.abs(field(points) - values).max()
    # 1e13 is the condition above which a warning is given: sixteen digits less thirteen, relative to the size
    assert said or residual < 2e-3
    if field is not None:
        assert np.isfinite(field(points)).all()
        # A Hermite fit also says when its kernel does not reach from centre to centre.
        assert said == (field.condition >= 1e13) or (said and hermite and epsilon >= 10.0)


@pytest.mark.parametrize("kernel", ["cubic", "thin_plate_spline", "wendland_c2", "matern_52"])
@pytest.mark.parametrize("size, shift", [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e6), (1e-3, 1e3)])
def test_size_and_place_do_not_matter(kernel, size, shift):
    points, where = sphere(80), 1.1 * sphere(33)
    values = points[:, 0] * points[:, 1]
    plain = RBFField.fit(points, values, kernel=kernel, epsilon=0.5)(where)
    moved = RBFField.fit(points * size + shift, values, kernel=kernel, epsilon=0.5 / size)
    rounding = 2.3e-16 * max(shift / size, 1)
    assert np.abs(moved(where * size + shift) - plain).max() < 1e4 * rounding


@pytest.mark.parametrize("kernel", ["cubic", "gaussian", "wendland_c4", "linear"])
def test_centres_almost_in_one_place(kernel):
    points = sphere(60)
    points[10] = points[20] + [1e-12, 0, 0]
    values = points[:, 2] + 1
    field, said = watched(lambda: RBFField.fit(points, values, kernel=kernel, epsilon=3.0))
    assert said or np.abs(field(points) - values).max() < 1e-6


def test_almost_coinciding_centres_are_named():
    points = sphere(60)
    points[10] = points[20] + [1e-12, 0, 0]
    with pytest.warns(NumericalWarning, match="centres 10 and 20"):
        RBFField.fit(points, points[:, 2], kernel="wendland_c4", epsilon=3.0)


@pytest.mark.parametrize("kernel", HERMITE)
def test_coplanar_and_collinear_centres_of_a_hermite_fit(kernel):
    up = np.tile([0.0, 0, 1], (25, 1))
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0]), axis=-1).reshape(-1, 3)
    line = np.arange(25.0)[:, None] * [1.0, 0, 0]
    for points in (grid, line):
        field, said = watched(lambda p=points: RBFField.fit_hermite(p, up, kernel=kernel, epsilon=0.2))
        assert said or np.abs(field(points)).max() < 1e-6


@pytest.mark.parametrize("count", [4, 30, 4000])
def test_few_and_many_centres(count):
    points = sphere(count)
    field = RBFField.fit_hermite(points[:1000], points[:1000], derivatives="normal")
    many = RBFField.fit(points, points[:, 0], kernel="wendland_c2", epsilon=2.0)
    assert np.abs(field(points[:1000])).max() < 1e-8
    assert np.abs(many(points) - points[:, 0]).max() < 1e-8


def test_thin_plate_keeps_two_sides():
    axis = np.linspace(0, 50, 12)
    side = np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)
    points = np.vstack([side, side + [0, 0, 0.1]])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], len(side), axis=0)
    field = RBFField.fit_hermite(points, normals)
    middle = side + [0, 0, 0.05]
    assert (field(middle) < 0).all() and (field(middle + [0, 0, 0.2]) > 0).all()


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_noisy_normals_move_the_surface_little(noise):
    points = sphere(200)
    normals = points + noise * np.random.default_rng(0).normal(size=points.shape)
    field = RBFField.fit_hermite(points, normals)
    # between centres a slope error acts over half a spacing, about 0.12 of the radius
    assert np.sqrt((field(sphere(999)) ** 2).mean()) < 0.12 * noise


def test_single_precision_input_is_computed_in_double():
    points = sphere(50).astype(np.float32)
    field = RBFField.fit_hermite(points, points)
    assert np.abs(field(points)).max() < 1e-12 and field(points).dtype == np.float64


def test_nothing_is_wrong_without_a_word(tmp_path, monkeypatch):
    # Fits of thousands of centres take most of the time of the study; the test above makes one.
    monkeypatch.setattr(extremes, "COUNTS", (4, 10, 50, 300))
    monkeypatch.setattr(extremes, "MOST_VALUES", 900)
    rows = study_extremes(kernels=["cubic", "inverse_multiquadric", "matern_12", "wendland_c2"])
    outcomes = {(row["case"], row["kernel"]): row["outcome"] for row in rows}
    assert "silent" not in outcomes.values()
    for row in rows:
        if row["outcome"] == "right":
            assert row["error"] <= row["bound"]
        else:
            assert len(row["said"]) > 20
    assert outcomes["1e6 from the origin", "cubic"] == "right"
    assert outcomes["two centres in one place", "cubic"] == "refused"
    assert outcomes["epsilon h = 1000", "wendland_c2"] == "warned"
    write_extremes(rows, tmp_path)
    assert (tmp_path / "extremes.md").read_text() == extremes_matrix(rows)
    assert (tmp_path / "extremes.csv").read_text().count("\n") >= len(rows)


def test_a_kernel_that_does_not_reach_its_neighbours_says_so():
    points = sphere(200)
    with pytest.warns(NumericalWarning, match="does not reach from centre to centre.*lower epsilon"):
        RBFField.fit_hermite(points, points, kernel="wendland_c2", epsilon=10.0)


@pytest.mark.parametrize("steep", [0.5, 1.0, 5.0])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_field_is_judged_by_the_way_to_its_surface_whatever_its_slope(steep, size):
    judge = extremes._ellipsoid(10, size=size)[2]

    class Off:
        """A field whose surface lies 1 % of the shortest half axis below an ellipsoid, or that falls outwards."""

        def __init__(self, sign):
            self.sign = sign

        def value_and_gradient(self, points):
            normals = points / size / np.array([3.0, 2.0, 1.0]) ** 2
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            return np.full(len(points), steep * 0.01 * size), self.sign * steep * normals

    assert judge(Off(1.0)) == pytest.approx(0.01)
    assert judge(Off(-1.0)) == pytest.approx(1.0)
