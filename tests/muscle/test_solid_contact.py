"""Bones with rounded facets, on which the solid of a muscle settles, and contact points outside of
the bones.
"""

import numpy as np
import pytest
import trimesh

from rbfmuscle.bones.obstacles import stack_bones
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.models import build_models
from rbfmuscle.muscle.rounded_bones import (
    FULLEST,
    ROUNDING,
    grown,
    no_scratch,
    round_bones,
    rounded_distance,
)
from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame_loop import FrameLoop

RADIUS, EDGE = 20.0, 2.0


@pytest.fixture(scope="module")
def ball():
    """A ball of flat facets, rounded over a cell, at a pose."""
    mesh = trimesh.creation.icosphere(2, RADIUS)
    field = BoneSDF.from_mesh(mesh)
    pose = rotation_about([1, 2, 3], 0.7, np.array([5.0, -2.0, 1.0]))
    arrays = stack_bones([field])
    frame = RestFrame(np.asarray(mesh.vertices))

    def rounded(points):
        bones = grown(grown(round_bones({"ball": field}, frame, EDGE / ROUNDING, {}, 0)))
        normal, gap = np.empty_like(points), np.empty(len(points))
        for i, point in enumerate(points):
            scratch = no_scratch()
            scratch.local[:] = (point - pose[:3, 3]) @ pose[:3, :3]
            gap[i] = rounded_distance(bones, arrays, 0, scratch)
            normal[i] = pose[:3, :3] @ scratch.gradient
        return gap, normal

    return field, rounded, pose


def around(pose, count=400, away=RADIUS):
    """World points about a ball at a pose, and their directions from its middle."""
    way = np.random.default_rng(0).normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return (away * way) @ pose[:3, :3].T + pose[:3, 3], way @ pose[:3, :3].T


def test_rounded_distance_is_near_the_exact_one_and_its_direction_nearer_to_the_ball(ball):
    field, rounded, pose = ball
    points, way = around(pose)
    exact, normal = field.distance_and_gradient(points, pose)
    distance, direction = rounded(points)
    assert np.abs(distance - exact).max() < 0.3  # facets stand off the ball by 0.5
    assert np.linalg.norm(direction, axis=1) == pytest.approx(np.ones(len(points)))
    turned = [
        np.degrees(np.arccos(np.clip((n * way).sum(axis=1), -1, 1))) for n in (normal, direction)
    ]
    assert np.sqrt((turned[1] ** 2).mean()) < 0.6 * np.sqrt((turned[0] ** 2).mean())


def test_where_the_rounded_distance_is_flat_it_says_so(ball):
    field, rounded, pose = ball
    middle = trimesh.transform_points(field.bounds.mean(axis=0)[None], pose)
    assert np.isnan(rounded(middle)[0])


def test_blocks_are_filled_once_kept_when_the_table_grows_and_refused_when_it_is_full(ball):
    field, _, pose = ball
    arrays = stack_bones([field])
    frame = RestFrame(np.asarray(trimesh.creation.icosphere(2, RADIUS).vertices))
    bones = round_bones({"ball": field}, frame, 0.2 / ROUNDING, {}, 0)
    points, _ = around(pose)

    def ask(table):
        found, scratch = [], no_scratch()
        for point in (points - pose[:3, 3]) @ pose[:3, :3]:
            scratch.local[:] = point
            found.append(rounded_distance(table, arrays, 0, scratch))
        return found

    few = np.array(ask(bones))
    full = int(np.ceil(FULLEST * len(bones.keys)))
    assert bones.filled[0] == full and full <= np.isfinite(few).sum() < len(points)
    assert not np.isnan(few).any()
    more = grown(grown(bones))
    assert more.filled[0] == full
    every = np.array(ask(more))
    known = np.isfinite(few)
    assert np.isfinite(every).all() and np.array_equal(every[known], few[known])


def test_direction_is_the_slope_of_the_distance(ball):
    _, rounded, pose = ball
    points, _ = around(pose)
    # On the rounded surface itself.
    for _ in range(5):
        distance, direction = rounded(points)
        points = points - distance[:, None] * direction
    step = np.random.default_rng(1).normal(size=points.shape) * 1e-4
    there, back = (rounded(points + sign * step)[0] for sign in (1, -1))
    assert np.abs((there - back) / 2 - (direction * step).sum(axis=1)).max() < 1e-3 * 1e-4 * 4


def test_no_contact_point_stays_in_a_bone():
    scene = phantom_scene()
    scene.muscles = [scene.muscle("extensor")]
    scene.set_motion(ramp={"hip.flexion": {"from": 0, "to": 60, "step": 10}})
    (model,) = build_models(scene)
    loop = FrameLoop(scene, [model], surfaces=False)
    for coordinates in scene.motion.frames:
        loop.skip(coordinates)
        assert loop.steppers[0].contacts.depth(model.contact_points()) < 0.02  # mm


def test_smoothed_distance_moves_by_no_more_than_the_point_does(ball):
    field, _, _ = ball
    frame = RestFrame(np.asarray(trimesh.creation.icosphere(2, RADIUS).vertices))
    bones = grown(grown(round_bones({"ball": field}, frame, EDGE / ROUNDING, {}, 0)))
    rng, scratch = np.random.default_rng(5), no_scratch()
    points = rng.normal(size=(60, 3)) * 0.6 * RADIUS
    points[1::2] = points[::2] + rng.normal(size=(30, 3))
    smooth = []
    for point in points:
        scratch.local[:] = point
        rounded_distance(bones, stack_bones([field]), 0, scratch)
        smooth.append(scratch.smooth[0])
    change = np.abs(np.array(smooth[1::2]) - smooth[::2])
    # The field of a bone errs by less than a thousandth of the ball's radius.
    assert (change <= np.linalg.norm(points[1::2] - points[::2], axis=1) + 1e-3 * RADIUS).all()
    assert change.max() > 0.5
