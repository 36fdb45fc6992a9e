"""Bones rounded for what settles on them."""

import numpy as np
import pytest
import trimesh
from conftest import samples
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.rounded import LEAST_SLOPE, ROUNDING, WIDE, RoundedBone, round_bone, rounded_at
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.frames import RestFrame

SPACING = 1.5
BOX = np.array([[-30.0] * 3, [30.0] * 3])


def frame_of(seed=0):
    return RestFrame(np.random.default_rng(seed).normal(size=(50, 3)) * [30.0, 20, 10])


def rounded_of(mesh, region=BOX, **options):
    field = BoneSDF.from_mesh(mesh)
    return round_bone(field, frame_of(), SPACING, region, cache=False, **options)


def asked(rounded, points):
    return np.array([rounded_at(rounded, *point, LEAST_SLOPE) for point in points])


def shell(radius, width, count=500, seed=0):
    rng = np.random.default_rng(seed)
    count = samples(count)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    return way, way * (radius + rng.uniform(-width, width, count))[:, None]


def test_a_rounded_ball_is_a_ball():
    radius = 20.0
    rounded = rounded_of(trimesh.creation.icosphere(4, radius), reach=3.0)
    way, points = shell(radius, 3.0)
    smooth, distance, *gradient = asked(rounded, points).T
    edge = ROUNDING * SPACING
    assert rounded.edge == pytest.approx(edge)
    # Smoothing of a variance of edge² / 3 in each direction raises |x| by edge² / (3 |x|).
    raised = edge**2 / 3.0 / np.linalg.norm(points, axis=1)
    expected = np.linalg.norm(points, axis=1) - radius + raised
    np.testing.assert_allclose(smooth, expected, atol=0.03)  # faceting: 0.024
    np.testing.assert_allclose(distance, expected, atol=0.04)
    np.testing.assert_allclose(np.transpose(gradient), way, atol=5e-3)


def test_the_gradient_is_the_derivative_of_the_smoothed_distance():
    rounded = rounded_of(trimesh.creation.box((20.0, 30.0, 25.0)), reach=3.0)
    points = np.random.default_rng(1).uniform(-12.0, 12.0, (samples(300), 3))
    smooth, distance, *gradient = asked(rounded, points).T
    known = np.isfinite(smooth)
    assert known.mean() > 0.5
    step = 1e-5
    slope = np.stack(
        [
            (asked(rounded, points + move) - asked(rounded, points - move))[:, 0] / (2.0 * step)
            for move in step * np.eye(3)
        ],
        axis=1,
    )
    steep = np.linalg.norm(slope, axis=1)
    known &= np.isfinite(steep)
    turned = np.transpose(gradient)[known] * steep[known, None]
    np.testing.assert_allclose(turned, slope[known], atol=1e-7)
    np.testing.assert_allclose(distance[known] * steep[known], smooth[known], rtol=1e-6, atol=1e-9)
    assert steep[known].max() <= 1.01  # along each axis of the lattice at most 1


def test_a_linear_distance_is_kept_and_each_node_has_its_own_place():
    """Nodes of a linear function, each block by itself: the spline is that function, and over its
    slope of 0.8 the distance.
    """
    normal = np.array([2.0, -3.0, 6.0]) / 7.0
    nodes = np.indices((WIDE, WIDE, WIDE)).reshape(3, -1).T - 1.0
    blocks = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]) - [1, 2, 3]
    values = 0.8 * np.array([(nodes + 4.0 * block) @ normal for block in blocks])
    table = np.full((2, 2, 2), -1, dtype=np.int32)
    table[0, 0, 0], table[0, 0, 1], table[0, 1, 0], table[1, 0, 0] = range(4)
    axes = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    rounded = RoundedBone(0.5, np.array([1.0, 2, 3]), axes, blocks[0], table, values)
    rng = np.random.default_rng(5)
    for block in blocks:
        place = 4.0 * block + rng.uniform(0.0, 4.0, (20, 3))
        answers = asked(rounded, rounded.origin + 0.5 * place @ axes)
        np.testing.assert_allclose(answers[:, 0], 0.4 * place @ normal, atol=1e-12)
        np.testing.assert_allclose(answers[:, 1], 0.5 * place @ normal, atol=1e-12)
        np.testing.assert_allclose(answers[:, 2:], np.tile(normal @ axes, (20, 1)), atol=1e-12)
    # Neither beyond the table nor where it has no block.
    for place in ([6.0, 6, 6], [-100, 0, 0], [2, 2, 100]):
        point = rounded.origin + 0.5 * (4.0 * blocks[0] + place) @ axes
        assert not np.isfinite(rounded_at(rounded, *point, LEAST_SLOPE)).all()


def test_blocks_are_those_near_the_surface_in_the_region():
    mesh = trimesh.creation.icosphere(4, 20.0)
    region = np.array([[5.0, -30, -30], [30, 30, 30]])
    rounded = rounded_of(mesh, region, reach=2.0)
    _, points = shell(20.0, 2.0, 2000)
    known = np.isfinite(asked(rounded, points)[:, 0])
    inside = np.all((points >= region[0]) & (points <= region[1]), axis=1)
    assert known[inside].all()
    far = np.array([[-19.0, 0, 0], [29.9, 29.9, 29.9], [100, 0, 0]])
    assert not np.isfinite(asked(rounded, far)).any()


def test_a_thin_plate_keeps_its_thickness():
    plate = trimesh.creation.box((30.0, 30.0, 1.0))
    rounded = rounded_of(plate, reach=1.0)
    assert rounded.edge <= 1.0 + 1e-9
    points = np.column_stack(
        [*np.random.default_rng(0).uniform(-8, 8, (2, 100)), np.full(100, 2.0)]
    )
    for side in (1.0, -1.0):
        answers = asked(rounded, points * [1.0, 1.0, side])
        np.testing.assert_allclose(answers[:, 1], 1.5, atol=1e-9)
        np.testing.assert_allclose(answers[:, 4], side, atol=1e-9)


def test_rounding_moves_and_turns_with_the_scene_and_is_kept_on_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    mesh, cloud = trimesh.creation.box((20.0, 30.0, 25.0)), frame_of().local
    turn = trimesh.transformations.rotation_matrix(0.9, [1.0, -2.0, 0.3])
    turn[:3, 3] = 100.0, 50.0, -20.0
    moved, points = mesh.copy().apply_transform(turn), shell(12.0, 3.0)[1]
    answers = []
    for each, at, there in ((mesh, cloud, points), (moved, cloud, points)):
        if each is moved:
            at = at @ turn[:3, :3].T + turn[:3, 3]
            there = points @ turn[:3, :3].T + turn[:3, 3]
        field = BoneSDF.from_mesh(each)
        region = np.array([there.min(axis=0) - 30.0, there.max(axis=0) + 30.0])
        rounded = round_bone(field, RestFrame(at), SPACING, region, reach=3.0)
        again = round_bone(field, RestFrame(at), SPACING, region, reach=3.0)
        np.testing.assert_array_equal(again.nodes, rounded.nodes)
        np.testing.assert_array_equal(again.table, rounded.table)
        answers.append(asked(rounded, there)[:, :2])
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-9)
