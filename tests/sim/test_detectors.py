"""The fields and detectors that stand beside BoneSDF."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.sim.distance.detectors import DETECTOR_NAMES, build_detector
from rbfmuscle.sim.distance.errors import measure_field
from rbfmuscle.sim.distance.serendipity import SerendipityField
from rbfmuscle.sim.distance.spline import SplineField
from rbfmuscle.validation import UsageError

RADIUS = 0.7
OPTIONS = {
    "spline": {"nodes": 60_000},
    "serendipity": {"cells": 20},
    "voxel": {"resolution": 40},
    "sdf": {"cache": False},
}
# Largest error at 3 from a ball of 20 and least cosine of the direction; a voxel's edge is 1.2.
EXPECTED = {
    "sdf": (0.03, 0.99),
    "bvh": (0.03, 0.99),
    "spline": (0.05, 0.95),
    "serendipity": (0.05, 0.95),
    "voxel": (1.3, 0.3),
}


def _sphere(points):
    return np.linalg.norm(points, axis=1) - RADIUS


def _directions(count, seed=0):
    unit = np.random.default_rng(seed).normal(size=(count, 3))
    return unit / np.linalg.norm(unit, axis=1, keepdims=True)


def _band(count=100_000):
    offset = np.random.default_rng(1).uniform(-0.1, 0.1, (count, 1))
    return _directions(count) * (RADIUS + offset)


# Largest errors within 0.1 of a sphere of 0.7 in [-1, 1]^3, from docs/sdf.md; fourth order.
@pytest.mark.parametrize(("cells", "error"), [(8, 5.9e-4), (16, 4.3e-5), (32, 3.2e-6), (64, 2.0e-7)])
def test_serendipity_cells_are_of_fourth_order_on_a_sphere(cells, error):
    field = SerendipityField(_sphere, [-1.0] * 3, [1.0] * 3, cells)
    points = _band()
    found = np.abs(field.distance(points) - _sphere(points)).max()
    assert error / 3 < found <= error


def test_spline_is_of_fourth_order_on_a_sphere():
    points = _band()
    errors = [
        np.abs(SplineField(_sphere, [-1.0] * 3, [1.0] * 3, 2.0 / n).distance(points) - _sphere(points)).max()
        for n in (16, 32, 64)
    ]
    assert errors[0] / errors[1] > 12
    assert errors[1] / errors[2] > 12


def test_serendipity_cells_and_splines_hold_cubics():
    def cubic(points):
        x, y, z = points.T
        return x**3 - 2 * y**3 + z**3 + x * y * z + x * x * y - z * z * x + y - 0.3

    points = np.random.default_rng(0).uniform(-0.99, 0.99, (2000, 3))
    serendipity = SerendipityField(cubic, [-1.0] * 3, [1.0] * 3, 2)
    np.testing.assert_allclose(serendipity.distance(points), cubic(points), atol=1e-12)


@pytest.mark.parametrize("kind", ["serendipity", "spline"])
def test_gradients_are_those_of_the_values(kind):
    field = {
        "serendipity": lambda: SerendipityField(_sphere, [-1.0] * 3, [1.0] * 3, (9, 10, 11)),
        "spline": lambda: SplineField(_sphere, [-1.0] * 3, [1.0] * 3, 0.21),
    }[kind]()
    points, step = _band(500), 6e-6
    slope = np.stack(
        [field.distance(points + step * e) - field.distance(points - step * e) for e in np.eye(3)], 1
    )
    np.testing.assert_allclose(field.gradient(points), slope / (2 * step), atol=1e-7)


@pytest.mark.parametrize("name", DETECTOR_NAMES)
def test_detectors_agree_on_a_ball_in_any_pose(name):
    ball = trimesh.creation.icosphere(4, 20.0)
    detector = build_detector(name, ball, **OPTIONS.get(name, {}))
    pose = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0])
    pose[:3, 3] = [30.0, -10.0, 5.0]
    unit = _directions(3000)
    offset = np.random.default_rng(2).uniform(-3.0, 3.0, len(unit))
    points = unit * (20.0 + offset)[:, None]
    distance, gradient = detector.distance_and_gradient(trimesh.transform_points(points, pose), pose)
    error, cosine = EXPECTED[name]
    assert np.abs(distance - offset).max() < error
    assert np.einsum("ni,ni->n", gradient @ pose[:3, :3], unit).min() > cosine
    np.testing.assert_array_equal(distance, detector.distance(trimesh.transform_points(points, pose), pose))
    assert detector.memory > 1000
    assert np.abs(np.linalg.norm(detector.closest_point(points), axis=1) - 20.0).max() < 2 * error


@pytest.mark.parametrize("name", ["voxel", "bvh"])
def test_detectors_are_right_far_away(name):
    detector = build_detector(name, trimesh.creation.icosphere(3, 20.0), **OPTIONS.get(name, {}))
    assert detector.distance(np.array([[320.0, 0.0, 0.0]]))[0] == pytest.approx(300.0, rel=0.01)


def test_unknown_detector_is_refused():
    with pytest.raises(UsageError, match="no detector is called 'fog'"):
        build_detector("fog", trimesh.creation.box())


def test_errors_of_a_ring_are_small():
    found = measure_field(build_detector("sdf", trimesh.creation.torus(20.0, 5.0), cache=False))
    assert found["error_rms"] < 0.01 and found["sign_wrong"] < 1e-3 and found["angle_median"] < 0.5


def test_measure_sees_a_wrong_field():
    field = build_detector("sdf", trimesh.creation.icosphere(3, 20.0), cache=False)

    class Shifted:
        vertices, faces, closed = field.vertices, field.faces, True

        def distance_and_gradient(self, points):
            distance, gradient = field.distance_and_gradient(points)
            return distance + 0.1, -gradient

        def distance(self, points):
            return field.distance(points) + 0.1

    found = measure_field(Shifted(), count=5000)
    assert found["error_rms"] == pytest.approx(0.1, rel=0.01)
    assert found["sign_wrong"] > 0.01
    assert found["angle_median"] > 179.0
