"""The partition of unity: a dense fit's field near the surface, exact at its points, smooth, linear in memory."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.partition import COVERED, PartitionField, fit_points_with_normals
from rbfmuscle.validation import UsageError

AXES = np.array([3.0, 2.0, 1.0])


def ellipsoid(count, seed=0):
    """Points and normals, jittered golden spiral."""
    rng = np.random.default_rng(seed)
    i = np.arange(count) + rng.uniform(0.2, 0.8, count)
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    unit = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    normals = unit / AXES
    return unit * AXES, normals / np.linalg.norm(normals, axis=1)[:, None]


@pytest.fixture(scope="module")
def parts():
    return PartitionField.fit_hermite(*ellipsoid(900))


def test_values_and_gradients_at_the_points_are_those_asked_for():
    points, normals = ellipsoid(300)
    field = PartitionField.fit_hermite(points, normals)
    value, gradient = field.value_and_gradient(points)
    # 1e-7: the digits that the local fits have
    assert np.abs(value).max() < 1e-7 and np.abs(gradient - normals).max() < 1e-6
    assert field.parts >= 8 and np.isfinite(field.condition)


def test_gradient_equals_central_differences_near_the_surface_where_the_balls_end_and_far_away(parts):
    points, normals = ellipsoid(40, seed=3)
    at = np.concatenate([points + s * normals for s in (0.0, 0.05, 0.25, 0.4, 0.6, 2.0)])
    _, gradient = parts.value_and_gradient(at)
    step = 6e-6
    for axis in range(3):
        move = np.eye(3)[axis] * step
        difference = (parts(at + move) - parts(at - move)) / (2 * step)
        assert np.abs(difference - gradient[:, axis]).max() < 1e-5


def test_the_coarse_field_counts_nowhere_on_the_points(parts):
    sums = np.zeros((len(parts.centres), 2))
    from rbfmuscle.implicit.partition import _evaluate_loop

    _evaluate_loop(parts.centres, parts._balls, False, sums)
    assert sums[:, 1].min() > COVERED


def test_surface_is_as_near_as_that_of_a_dense_fit(parts):
    dense = RBFField.fit_hermite(*ellipsoid(900))
    points, _ = ellipsoid(4000, seed=9)
    error = []
    for field in (parts, dense):
        value, gradient = field.value_and_gradient(points)
        error.append(np.sqrt(((value / np.linalg.norm(gradient, axis=1)) ** 2).mean()))
    assert error[0] < 1.2 * error[1]


def test_one_closed_sheet_and_inside_is_negative(parts):
    mesh = parts.surface(resolution=40)
    assert mesh.is_watertight and mesh.body_count == 1
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 6, rel=5e-3)  # chords of 40 cells
    rng = np.random.default_rng(0)
    at = rng.uniform(-4, 4, (4000, 3))
    inside = ((at / AXES) ** 2).sum(axis=1)
    clear = np.abs(inside - 1) > 0.1
    assert ((parts(at) < 0) == (inside < 1))[clear].all()


def test_memory_and_work_grow_in_proportion_to_the_points(parts):
    """Numbers kept a point, and kernels met by a value, are the same for twice as many points."""
    more = PartitionField.fit_hermite(*ellipsoid(1800))
    kept = [sum(np.size(a) for a in f._balls) / len(f.centres) for f in (parts, more)]
    assert kept[1] < 1.3 * kept[0]
    met = [len(f._balls.points) / len(f.centres) for f in (parts, more)]
    assert met[1] < 1.3 * met[0] < 8.0


def test_the_number_of_points_chooses(parts):
    points, normals = ellipsoid(300)
    assert isinstance(fit_points_with_normals(points, normals), RBFField)
    assert isinstance(fit_points_with_normals(points, normals, most=200), PartitionField)


def test_wrong_requests_are_answered():
    points, normals = ellipsoid(300)
    with pytest.raises(UsageError, match="at least 20 points, got 10"):
        PartitionField.fit_hermite(points[:10], normals[:10])


def test_a_box_with_flat_sides_is_fitted():
    """Points of flat sides lie in a plane: a local fit still has its linear part, from the normals."""
    mesh = trimesh.creation.box([4.0, 3.0, 2.0])
    points, faces = trimesh.sample.sample_surface_even(mesh, 800, seed=1)
    field = PartitionField.fit_hermite(points, mesh.face_normals[faces])
    assert field.surface(resolution=24).volume == pytest.approx(24.0, rel=0.05)
