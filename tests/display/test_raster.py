"""Pictures from the depth buffer: what is where, what hides what, and that the whole subject is in
the picture.
"""

import numpy as np
import pytest
import trimesh

import rbfmuscle as rm
from rbfmuscle.anatomy.bones import orient_scene
from rbfmuscle.display.pictures import Solid, aim, draw_solids, fitted_size
from rbfmuscle.recording import Run, stream_run
from rbfmuscle.run.appearance import VIEWS, motion_direction, view_axes
from rbfmuscle.scene.objects import body_axes
from rbfmuscle.scene.phantom import phantom_scene

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
    behind = draw_solids(
        [Solid(*plain, BLUE), Solid(veil[0] + [0, 60, 0], veil[1], RED, 0.4)], camera
    )
    np.testing.assert_array_equal(behind, draw_solids([Solid(*plain, BLUE)], camera))


@pytest.mark.parametrize("direction", [(0, -1, 0.12), (-1, -0.12, 0.12), (0.6, 0.8, 0.0)])
def test_subject_is_whole_upright_and_fills_the_picture(direction):
    points = np.random.default_rng(3).normal(size=(400, 3)) * [10.0, 30.0, 80.0] + [
        300.0,
        -50.0,
        7.0,
    ]
    axes = view_axes(direction, np.eye(3))
    size = fitted_size(axes, points, 40_000)
    camera = aim(axes, points, size)
    seen = camera.project(points)
    assert (seen[:, :2] > 0).all() and (seen[:, :2] < size).all()
    assert max(np.ptp(seen[:, 0]) / size[0], np.ptp(seen[:, 1]) / size[1]) == pytest.approx(0.9)
    up = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert up[1, 1] < up[0, 1] and up[1, 0] == pytest.approx(up[0, 0])


# Columns: where x, y and z of the phantom (left, posterior, superior) lie in the data.
AXES = {
    "z up": np.eye(3),
    "y up, as in OpenSim": np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
    "upside down": np.diag([1.0, -1.0, -1.0]),
    "y down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def turned_scene(turn):
    """The phantom's bones and muscles, turned; nothing says which way is up."""
    scene, pose = phantom_scene(spacing=6.0), np.eye(4)
    pose[:3, :3] = turn
    for item in scene.bones + scene.muscles:
        item.mesh = item.mesh.copy()
        item.mesh.apply_transform(pose)
    for muscle in scene.muscles:
        muscle.fibres = None
    return scene


@pytest.mark.parametrize("name", AXES)
def test_every_view_shows_the_head_of_the_femur_above_its_condyles(name):
    turn = AXES[name]
    scene = orient_scene(turned_scene(turn))
    body = body_axes(scene.superior, scene.anterior)
    # Scans lie along axes, which are taken.
    np.testing.assert_allclose(body, turn.T, atol=1e-12)
    femur, plain = (
        scene.bone("femur").mesh.vertices,
        phantom_scene(spacing=6.0).bone("femur").mesh.vertices,
    )
    head, condyles = femur[plain[:, 2].argmax()], femur[plain[:, 2].argmin()]
    for view in ("front", "back", "left", "right"):
        camera = aim(view_axes(VIEWS[view], body), np.asarray(femur), (300, 400))
        (_, above, _), (_, below, _) = camera.project(np.stack([head, condyles]))
        assert above < 60 and below > 340  # pixels count downwards
    left, posterior, superior = turn.T
    towards = {
        "front": -posterior,
        "back": posterior,
        "left": left,
        "right": -left,
        "top": superior,
    }
    for view, direction in towards.items():
        axes = view_axes(VIEWS[view], body)
        assert axes[2] @ direction > 0.98
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
    # The body's left is at the right hand of who looks at its front or down on it with anterior up.
    assert view_axes(VIEWS["front"], body)[0] @ left == pytest.approx(1.0)
    assert view_axes(VIEWS["top"], body)[1] @ -posterior == pytest.approx(1.0)


def test_motion_is_seen_along_the_axis_of_the_bone_that_turns_most():
    wanted = np.array([-1.0, 0.2, 0.0]) / np.hypot(1.0, 0.2)

    def turned(axis, degrees):
        return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)

    for axes in AXES.values():  # however the data lie
        most, less = axes @ wanted, axes @ [0.0, 1.0, 0.0]
        frames = [{"femur": turned(most, a), "tibia": turned(less, 0.3 * a)} for a in (0, 20, 70)]
        for poses in (frames, frames[::-1]):  # from outside, either way
            np.testing.assert_allclose(motion_direction(poses, axes.T), wanted, atol=1e-12)
    upright = [{"femur": turned((0, 0, 1), a)} for a in (0, 40)]
    for poses in (upright, frames[:1]):
        np.testing.assert_array_equal(motion_direction(poses, np.eye(3)), (-1.0, -0.12, 0.12))


def test_a_saved_run_knows_the_directions_that_its_bones_showed(tmp_path):
    scene = turned_scene(AXES["y up, as in OpenSim"])
    scene.joints, scene.motion = [], rm.Scene().motion
    stream_run(scene, tmp_path, model="pbd", settings={"output.report": False})
    np.testing.assert_allclose(Run.load(tmp_path).body, AXES["y up, as in OpenSim"].T, atol=1e-12)
    assert scene.superior is None  # the caller's scene is as it was


def test_without_a_bone_that_shows_it_z_is_up_and_minus_y_in_front():
    scene = phantom_scene(spacing=6.0)
    scene.bones = [scene.bone("pelvis")]
    oriented = orient_scene(scene)
    assert (oriented.superior, oriented.anterior) == (None, None)
    np.testing.assert_array_equal(body_axes(None, None), np.eye(3))
