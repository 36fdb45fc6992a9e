"""Gap, normal and place of points by the field at rest: known answers under affine maps."""

import numpy as np
import pytest
from shown_ball import CENTRES, PARTS, X

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.surface.gap import find_gap, trim

A = np.array([[1.3, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.2, 0.0, 1.1]])
SHIFT = np.array([4.0, -2.0, 1.0])


def affine(places):
    return places @ A.T + SHIFT, np.broadcast_to(A, (len(places), 3, 3))


def plane(places):
    """A half-space, whose distance is exact."""
    normal = np.array([0.6, 0.0, 0.8])
    return places @ normal - 0.5, np.broadcast_to(normal, places.shape)


def ball(places):
    radius = np.linalg.norm(places, axis=1)
    return radius - 1.0, places / radius[:, None]


def test_a_half_space_under_an_affine_map_has_its_exact_distance():
    points = np.random.default_rng(0).normal(size=(50, 3)) + SHIFT
    found = find_gap(points, np.zeros_like(points), affine, plane, reach=0.5)
    normal = np.linalg.solve(A.T, [0.6, 0.0, 0.8])
    length = np.linalg.norm(normal)
    there = np.linalg.solve(A, (points - SHIFT).T).T
    np.testing.assert_allclose(found.place, there, atol=1e-9)
    np.testing.assert_allclose(found.gap, (there @ [0.6, 0.0, 0.8] - 0.5) / length, atol=1e-9)
    np.testing.assert_allclose(found.normal, np.tile(normal / length, (50, 1)), atol=1e-12)


def test_a_ball_that_became_an_ellipsoid_has_the_distance_to_first_order():
    at = X[::7]
    surface = affine(at)[0]
    inverse = np.linalg.inv(A)
    outward = at @ inverse
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    on = find_gap(surface, at, affine, ball, reach=0.5)
    np.testing.assert_allclose(on.gap, 0.0, atol=1e-10)
    np.testing.assert_allclose(on.normal, outward, atol=1e-10)
    for height in (1e-3, -1e-3):
        found = find_gap(surface + height * outward, at, affine, ball, reach=0.5)
        # Of second order in the height over the radius of curvature, at least 0.4.
        np.testing.assert_allclose(found.gap, height, atol=2.5 * height**2)


def test_the_gradient_is_the_derivative_of_the_value_in_the_world():
    def bend(places):
        x, y, z = places.T
        there = np.column_stack([x + 0.1 * y**2, y, z + 0.2 * x * y])
        slopes = np.tile(np.eye(3), (len(places), 1, 1))
        slopes[:, 0, 1] = 0.2 * y
        slopes[:, 2, 0] = 0.2 * y
        slopes[:, 2, 1] = 0.2 * x
        return there, slopes

    field = RBFField.fit_hermite(CENTRES, CENTRES, parts=PARTS).value_and_gradient
    points = bend(1.02 * X[::9])[0]
    found = find_gap(points, X[::9].copy(), bend, field, reach=0.5)
    np.testing.assert_allclose(found.place, 1.02 * X[::9], atol=1e-8)
    value, _ = field(found.place)
    length = value / found.gap
    for axis, step in enumerate(6e-6 * np.eye(3)):
        ends = [
            field(find_gap(points + sign * step, found.place, bend, field, reach=0.5).place)[0]
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / 1.2e-5
        np.testing.assert_allclose(found.normal[:, axis] * length, slope, atol=1e-5)


def test_no_gap_is_told_where_the_material_is_folded():
    def folded(places):
        return places * [1.0, 1.0, -1.0], np.broadcast_to(np.diag([1.0, 1.0, -1.0]), (1, 3, 3))

    found = find_gap(np.ones((1, 3)), np.ones((1, 3)), folded, ball, reach=0.5)
    assert np.isnan(found.gap[0]) and not found.normal.any()


@pytest.mark.parametrize("most", [1.0, 0.05])
def test_two_balls_that_overlap_are_trimmed_to_the_plane_between_them(most):
    shift = np.array([1.8, 0.0, 0.0])

    def moved(places):
        return places + shift, np.broadcast_to(np.eye(3), (len(places), 3, 3))

    near = X[X[:, 0] > 0.8]
    gap = find_gap(near, near - shift, moved, ball, reach=0.5)
    way = trim(gap, np.zeros(len(near)), most=most)
    inside = gap.gap < 0.0
    assert inside.sum() > 20 and not way[~inside].any()
    assert np.linalg.norm(way, axis=1).max() <= most + 1e-12
    for _ in range(4):
        place = near + way
        gap = find_gap(place, place - shift, moved, ball, reach=0.5)
        way += trim(gap, ball(place)[0], most=most)
    if most == 1.0:
        np.testing.assert_allclose((near + way)[inside][:, 0], 0.9, atol=2e-3)
