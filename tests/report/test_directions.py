"""Which way is up: every picture of a body shows its head above its feet, however the data lie."""

import numpy as np
import pytest

import rbfmuscle as rm
from rbfmuscle.importers.guess.orientation import orient_scene
from rbfmuscle.output.appearance import VIEWS, motion_direction, view_axes
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.render import aim
from rbfmuscle.run import stream_run
from rbfmuscle.scene.phantom import phantom_scene

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
    np.testing.assert_allclose(scene.body, turn.T, atol=1e-12)  # scans lie along axes, which are taken
    femur, plain = scene.bone("femur").mesh.vertices, phantom_scene(spacing=6.0).bone("femur").mesh.vertices
    head, condyles = femur[plain[:, 2].argmax()], femur[plain[:, 2].argmin()]
    for view in ("front", "back", "left", "right"):
        camera = aim(view_axes(VIEWS[view], scene.body), np.asarray(femur), (300, 400))
        (_, above, _), (_, below, _) = camera.project(np.stack([head, condyles]))
        assert above < 60 and below > 340  # pixels count downwards
    left, posterior, superior = turn.T
    towards = {"front": -posterior, "back": posterior, "left": left, "right": -left, "top": superior}
    for view, direction in towards.items():
        axes = view_axes(VIEWS[view], scene.body)
        assert axes[2] @ direction > 0.98
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
    # The body's left is at the right hand of who looks at its front or down on it with anterior up.
    assert view_axes(VIEWS["front"], scene.body)[0] @ left == pytest.approx(1.0)
    assert view_axes(VIEWS["top"], scene.body)[1] @ -posterior == pytest.approx(1.0)


def test_a_motion_is_seen_from_the_same_side_however_the_data_lie():
    from scipy.spatial.transform import Rotation

    swing = Rotation.from_rotvec([-1.0, 0.1, 0.0]).as_matrix()
    for turn in AXES.values():
        poses = [{"femur": np.eye(4)}, {"femur": np.eye(4)}]
        poses[1]["femur"][:3, :3] = turn @ swing @ turn.T
        wanted = np.array([-1.0, 0.1, 0.0]) / np.hypot(1.0, 0.1)
        np.testing.assert_allclose(motion_direction(poses, turn.T), wanted, atol=1e-12)


def test_a_saved_run_knows_the_directions_that_its_bones_showed(tmp_path):
    scene = turned_scene(AXES["y up, as in OpenSim"])
    scene.joints, scene.motion = [], rm.Scene().motion
    stream_run(scene, tmp_path, model="pbd", settings={"output.report": False})
    np.testing.assert_allclose(SavedRun(tmp_path).body, AXES["y up, as in OpenSim"].T, atol=1e-12)
    assert scene.superior is None  # the caller's scene is as it was


def test_without_a_bone_that_shows_it_z_is_up_and_minus_y_in_front():
    scene = phantom_scene(spacing=6.0)
    scene.bones = [scene.bone("pelvis")]
    np.testing.assert_array_equal(orient_scene(scene).body, np.eye(3))
