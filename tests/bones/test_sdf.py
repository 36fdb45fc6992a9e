"""Distances to bones: gradients, poses, reach."""

import numpy as np
import pytest
import trimesh
from conftest import samples
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.recording import simulate
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.validation import UsageError

SHAPES = {
    "sphere": lambda: trimesh.creation.icosphere(4, 20.0),
    "box": lambda: trimesh.creation.box((20.0, 30.0, 40.0)),
    "torus": lambda: trimesh.creation.torus(20.0, 5.0),
    "thin plate": lambda: trimesh.creation.box((40.0, 30.0, 0.5)),
}


@pytest.fixture(scope="module", params=SHAPES)
def shape(request):
    mesh = SHAPES[request.param]()
    return mesh, BoneSDF.from_mesh(mesh)


def _near(mesh, width, count=20000, seed=0):
    count = samples(count)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    rng = np.random.default_rng(seed)
    return points + mesh.face_normals[faces] * rng.uniform(-width, width, (count, 1))


def test_gradient_is_that_of_the_distance(shape):
    mesh, field = shape
    points = _near(mesh, 1.0, 3000, seed=4)
    steps = 1e-4 * np.eye(3)
    change = [field.distance(points + step) - field.distance(points - step) for step in steps]
    slope = np.stack(change, axis=1) / 2e-4
    gradient = field.gradient(points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    difference = np.linalg.norm(slope - gradient, axis=1)
    # Curvature over a step of 1e-4; creases are left out.
    assert np.mean(difference < 1e-4) > 0.97


def test_pose_moves_points_and_turns_gradients(shape):
    mesh, field = shape
    points = _near(mesh, 3.0, 5000)
    pose = trimesh.transformations.rotation_matrix(1.1, [1.0, -2.0, 0.5])
    pose[:3, 3] = [100.0, -40.0, 7.0]
    moved = trimesh.transform_points(points, pose)
    distance, gradient = field.distance_and_gradient(points)
    there, turned = field.distance_and_gradient(moved, pose)
    np.testing.assert_allclose(there, distance, atol=1e-12)
    same = np.linalg.norm(turned - gradient @ pose[:3, :3].T, axis=1) < 1e-3
    assert same.mean() > 0.999  # a point on a crease may take either side
    np.testing.assert_array_equal(field.distance(moved, pose), there)


def test_reach_of_each_point(shape):
    mesh, field = shape
    points = np.concatenate([_near(mesh, 2.0, 3000), _near(mesh, 40.0, 3000)])
    reach = np.random.default_rng(4).uniform(-2.0, 30.0, len(points))
    whole, slope = field.distance_and_gradient(points)
    found, gradient = field.distance_and_gradient(points, reach=reach)
    near = whole <= reach
    np.testing.assert_array_equal(found[near], whole[near])
    np.testing.assert_array_equal(gradient[near], slope[near])
    assert np.all(found[~near] > reach[~near])
    assert np.all(found <= whole + 1e-12)


def test_bad_points_and_poses_are_refused():
    field = BoneSDF.from_mesh(SHAPES["box"]())
    nan = np.full((4, 4), np.nan)
    cases = (nan[:, :3], None), ([0, 0, 0], None), ([[0, 0, 0]], np.eye(3)), ([[0, 0, 0]], nan)
    for points, pose in cases:
        with pytest.raises(ValueError, match="points" if pose is None else "pose must be"):
            field.distance(points, pose=pose)
    assert field.distance(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("name", "turn", "scale"),
    [
        ("torus", [0.4, -1.0, 2.0], 1.0),
        ("sphere", [0.0, 0.0, 0.0], 1e-3),
        ("box", [3.0, 0.1, 0.0], 10.0),
    ],
)
def test_a_moved_turned_or_scaled_bone_has_the_same_field(name, turn, scale):
    mesh = SHAPES[name]()
    points = _near(mesh, 2.0, 2000)
    rotation, shift = Rotation.from_rotvec(turn).as_matrix(), np.array([300.0, -100.0, 50.0])
    other = BoneSDF.from_mesh((scale * mesh.vertices @ rotation.T + shift, mesh.faces))
    distance, gradient = BoneSDF.from_mesh(mesh).distance_and_gradient(points)
    moved, turned = other.distance_and_gradient(scale * points @ rotation.T + shift)
    # Coordinates of 300 are rounded.
    np.testing.assert_allclose(moved / scale, distance, rtol=0, atol=3e-13 / scale)
    assert np.median(np.abs(turned @ rotation - gradient)) < 1e-9


def test_fields_of_a_run_name_each_bone():
    scene = phantom_scene(model="pbd", end=20.0, step=20.0, spacing=6.0)
    with pytest.raises(UsageError, match="bone_sdfs must name each bone"):
        simulate(scene, bone_sdfs={"pelvis": BoneSDF.from_mesh(scene.bone("pelvis").mesh)})
