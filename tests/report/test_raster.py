"""Pictures from the depth buffer: what is where, what hides what, and that the whole subject is in the picture."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.output.appearance import motion_direction, view_axes
from rbfmuscle.report.render import Solid, aim, draw_solids, fitted_size

RED, BLUE = "#ff0000", "#0000ff"
FRONT = view_axes((0, -1, 0), np.eye(3))


def ball(radius=10.0, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def test_ball_covers_the_area_of_its_circle():
    vertices, faces = ball()
    image = draw_solids([Solid(vertices, faces, RED)], aim(FRONT, vertices, (200, 200)))
    covered = (image[..., 1] < 200).mean()
    # The ball's diameter takes nine tenths of the picture; 642 vertices lose 1 % of the circle.
    assert covered == pytest.approx(np.pi / 4 * 0.9**2, rel=0.02)


def test_what_is_nearer_hides_what_is_behind_whatever_the_order():
    near, far = ball(5.0, (0, -20, 0)), ball(10.0, (0, 20, 0))
    camera = aim(FRONT, far[0], (100, 100))
    solids = [Solid(*near, RED), Solid(*far, BLUE)]
    image = draw_solids(solids, camera).astype(int)
    np.testing.assert_array_equal(image, draw_solids(solids[::-1], camera))
    assert image[50, 50, 0] > image[50, 50, 2] and image[50, 15, 2] > image[50, 15, 0]


def test_veil_lets_a_solid_behind_it_show_and_not_one_before_it():
    plain, veil = ball(10.0), ball(5.0, (0, -30, 0))
    camera = aim(FRONT, plain[0], (80, 80))
    through = draw_solids([Solid(*plain, BLUE), Solid(*veil, RED, 0.4)], camera)[40, 40].astype(int)
    assert min(through[0], through[2]) > 40
    behind = draw_solids([Solid(*plain, BLUE), Solid(veil[0] + [0, 60, 0], veil[1], RED, 0.4)], camera)
    np.testing.assert_array_equal(behind, draw_solids([Solid(*plain, BLUE)], camera))


@pytest.mark.parametrize("direction", [(0, -1, 0.12), (-1, -0.12, 0.12), (0.6, 0.8, 0.0)])
def test_subject_is_whole_upright_and_fills_the_picture(direction):
    points = np.random.default_rng(3).normal(size=(400, 3)) * [10.0, 30.0, 80.0] + [300.0, -50.0, 7.0]
    axes = view_axes(direction, np.eye(3))
    size = fitted_size(axes, points, 40_000)
    camera = aim(axes, points, size)
    seen = camera.project(points)
    assert (seen[:, :2] > 0).all() and (seen[:, :2] < size).all()
    assert max(np.ptp(seen[:, 0]) / size[0], np.ptp(seen[:, 1]) / size[1]) == pytest.approx(0.9)
    up = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert up[1, 1] < up[0, 1] and up[1, 0] == pytest.approx(up[0, 0])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def turned(axis, degrees):
    pose = np.eye(4)
    angle = np.radians(degrees)
    skew = np.cross(np.eye(3), np.asarray(axis, dtype=float) / np.linalg.norm(axis)).T
    pose[:3, :3] = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    return pose


def test_motion_is_seen_along_the_axis_of_the_bone_that_turns_most():
    frames = [{"femur": turned((-1, 0.2, 0), a), "tibia": turned((0, 1, 0), 0.3 * a)} for a in (0, 20, 70)]
    wanted = np.array([-1, 0.2, 0]) / np.hypot(1, 0.2)
    np.testing.assert_allclose(motion_direction(frames, np.eye(3)), wanted, atol=1e-12)
    np.testing.assert_allclose(
        motion_direction(frames[::-1], np.eye(3)), wanted, atol=1e-12
    )  # from outside, either way
    upright = [{"femur": turned((0, 0, 1), a)} for a in (0, 40)]
    for poses in (upright, frames[:1]):
        np.testing.assert_array_equal(motion_direction(poses, np.eye(3)), (-1.0, -0.12, 0.12))
