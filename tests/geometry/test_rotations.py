"""Rotations as quaternions against those of SciPy, and the step towards the nearest rotation."""

import numpy as np
import pytest
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.frames import (
    cross,
    dot,
    quaternion_matrix,
    rotate,
    turn_towards,
    turned_quaternions,
)

# About each axis by half a turn, so that each of the four numbers is once the greatest.
TURNS = [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)]
TURNS += [Rotation.from_rotvec([0.3, -0.5, 0.2]), Rotation.from_rotvec([-1.9, 1.1, 0.7])]


def quaternion_of(turn):
    """(w, x, y, z); SciPy has w last."""
    return tuple(np.roll(turn.as_quat(), 1).tolist())


@pytest.mark.parametrize("turn", TURNS)
def test_matrix_and_quaternion_are_of_one_rotation(turn):
    found = np.array(quaternion_matrix(quaternion_of(turn)))
    np.testing.assert_allclose(found, turn.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("turn", TURNS)
def test_a_vector_is_rotated_as_by_the_matrix(turn):
    quaternion = np.array(quaternion_of(turn))
    for vector in np.vstack([np.eye(3), [[0.4, -2.0, 3.0]]]):
        np.testing.assert_allclose(rotate(quaternion, vector), turn.apply(vector), atol=1e-14)


def test_a_further_rotation_comes_after_the_ones_before():
    before = np.array([quaternion_of(turn) for turn in TURNS])
    for after in TURNS:
        found = turned_quaternions(before, after.as_matrix())
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-15)
        for one, turn in zip(found, TURNS, strict=True):
            wanted = (after * turn).as_matrix()
            np.testing.assert_allclose(np.array(quaternion_matrix(one)), wanted, atol=1e-14)


def test_products_of_vectors():
    u, v = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.5])
    assert dot(u, v) == u @ v
    assert cross(u, v) == tuple(np.cross(u, v))


@pytest.mark.parametrize("seed", range(6))
def test_steps_towards_a_matrix_end_at_its_polar_rotation(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    stretch = np.eye(3) + 0.4 * rng.uniform(-1.0, 1.0, (3, 3))
    matrix = turn @ (stretch @ stretch.T)
    wanted = polar(matrix)[0]
    rows = tuple(map(tuple, matrix))
    start = Rotation.from_matrix(wanted) * Rotation.from_rotvec(0.3 * rng.uniform(-1.0, 1.0, 3))
    quaternion = quaternion_of(start)
    errors = []
    for _ in range(4):
        errors.append(np.abs(np.array(quaternion_matrix(quaternion)) - wanted).max())
        quaternion = turn_towards(rows, quaternion)
    # Newton's method: the error after a step is about the square of that before.
    assert errors[1] < 2.0 * errors[0] ** 2 and errors[3] < 1e-10
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-15)


def test_a_step_is_bounded_and_the_solution_is_reached_from_far_off():
    matrix = np.diag([3.0, 2.0, 1.0])
    rows = tuple(map(tuple, matrix))
    for axis in np.eye(3):
        quaternion = quaternion_of(Rotation.from_rotvec(3.0 * axis))
        for _ in range(30):
            before, quaternion = np.array(quaternion), turn_towards(rows, quaternion)
            turned = 2.0 * np.arccos(min(abs(before @ np.array(quaternion)), 1.0))
            assert turned < 1.0
        np.testing.assert_allclose(np.array(quaternion_matrix(quaternion)), np.eye(3), atol=1e-9)
