"""Bone distance fields: accuracy, sign, gradients, poses, regions."""

import numba
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.run import simulate
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.validation import MeshError, UsageError

SHAPES = {
    "sphere": lambda: trimesh.creation.icosphere(4, 20.0),
    "box": lambda: trimesh.creation.box((20.0, 30.0, 40.0)),
    "torus": lambda: trimesh.creation.torus(20.0, 5.0),
    "thin plate": lambda: trimesh.creation.box((40.0, 30.0, 0.5)),
}


@pytest.fixture(scope="module", params=SHAPES)
def shape(request):
    mesh = SHAPES[request.param]()
    return mesh, BoneSDF.from_mesh(mesh, cache=False)


def _near(mesh, width, count=20000, seed=0):
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    rng = np.random.default_rng(seed)
    return points + mesh.face_normals[faces] * rng.uniform(-width, width, (count, 1))


def test_band_meets_the_promised_accuracy(shape):
    mesh, field = shape
    points = _near(mesh, 1.0)
    exact, closest, _, _ = field.exact.nearest(points)
    error = field.distance(points) - exact
    assert np.sqrt(np.mean(error**2)) <= 0.01
    assert np.abs(error).max() <= 0.3
    assert np.mean(field.distance(points) * exact < 0.0) <= 1e-4
    away = np.abs(exact) > 0.02
    outward = (points[away] - closest[away]) / exact[away, None]
    cosine = np.einsum("ni,ni->n", field.gradient(points[away]), outward)
    assert np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))) <= 0.5


def test_distances_far_from_the_bone_are_right(shape):
    _, field = shape
    rng = np.random.default_rng(1)
    points = rng.normal(size=(2000, 3)) * 300.0
    exact = field.exact.signed_distance(points)
    error = np.abs(field.distance(points) - exact)
    # Far away the triangles tested are those nearest to 200 directions.
    assert (error / np.maximum(np.abs(exact), 20.0)).max() < 0.02


def test_gradient_is_that_of_the_distance(shape):
    mesh, field = shape
    points = _near(mesh, 1.0, 3000, seed=4)
    steps = 1e-4 * np.eye(3)
    change = [field.distance(points + step) - field.distance(points - step) for step in steps]
    slope = np.stack(change, axis=1) / 2e-4
    gradient = field.gradient(points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)  # single precision
    difference = np.linalg.norm(slope - gradient, axis=1)
    # Records are held in single precision, 2e-6 at these sizes, over a step of 1e-4; creases are
    # left out.
    assert np.mean(difference < 0.05) > 0.97


def test_pose_moves_points_and_turns_gradients(shape):
    mesh, field = shape
    points = _near(mesh, 3.0, 5000)
    pose = trimesh.transformations.rotation_matrix(1.1, [1.0, -2.0, 0.5])
    pose[:3, 3] = [100.0, -40.0, 7.0]
    moved = trimesh.transform_points(points, pose)
    distance, gradient = field.distance_and_gradient(points)
    there, turned = field.distance_and_gradient(moved, pose)
    np.testing.assert_allclose(there, distance, atol=1e-5)  # single precision
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
    assert np.all(found <= whole + 1e-6)


def test_same_field_from_any_number_of_threads():
    mesh = SHAPES["torus"]()
    before, fields = numba.get_num_threads(), []
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            fields.append(BoneSDF.from_mesh(mesh, cache=False))
    finally:
        numba.set_num_threads(before)
    for one, other in zip(fields[0].data, fields[-1].data):
        np.testing.assert_array_equal(one, other)


def test_region_is_fine_inside_and_right_outside():
    mesh = SHAPES["torus"]()
    region = np.array([[5.0, -30.0, -10.0], [30.0, 30.0, 10.0]])
    part, whole = (
        BoneSDF.from_mesh(mesh, region=region, cache=False),
        BoneSDF.from_mesh(mesh, cache=False),
    )
    points = _near(mesh, 1.0)
    inside = np.all((points > region[0]) & (points < region[1]), axis=1)
    exact = whole.exact.signed_distance(points)
    error = np.abs(part.distance(points) - exact)
    assert part.memory < 0.8 * whole.memory
    assert np.sqrt(np.mean(error[inside] ** 2)) < 0.01
    # Outside, coarse cells of 16 times the edge answer.
    assert error.max() < 0.3 * 16 * part.spacing
    assert np.mean((part.distance(points) * exact < 0.0) & (np.abs(exact) > 0.5)) < 0.01


def test_smaller_tolerance_gives_smaller_errors():
    mesh = trimesh.creation.icosphere(3, 20.0)
    mesh.vertices *= np.random.default_rng(0).uniform(0.9, 1.1, (len(mesh.vertices), 1))
    points = _near(mesh, 1.0)
    errors, sizes = [], []
    for tolerance in (0.3, 2e-4, 2e-5):
        field = BoneSDF.from_mesh(mesh, tolerance=tolerance, cache=False)
        assert field.error <= tolerance
        errors.append(
            np.sqrt(np.mean((field.distance(points) - field.exact.signed_distance(points)) ** 2))
        )
        sizes.append(field.memory)
    assert errors == sorted(errors, reverse=True) and sizes == sorted(sizes)
    with pytest.raises(MeshError, match=r"tib: a tolerance .* needs about .* MB.*memory limit"):
        BoneSDF.from_mesh(mesh, tolerance=1e-9, memory_limit=3_000_000, cache=False, name="tib")


def test_bad_points_and_poses_are_refused():
    field = BoneSDF.from_mesh(SHAPES["box"](), cache=False)
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
    other = BoneSDF.from_mesh((scale * mesh.vertices @ rotation.T + shift, mesh.faces), cache=False)
    distance, gradient = BoneSDF.from_mesh(mesh, cache=False).distance_and_gradient(points)
    moved, turned = other.distance_and_gradient(scale * points @ rotation.T + shift)
    # A vertex rounded the other way (1e-8 of the size) moves single-precision records by their last
    # digit.
    np.testing.assert_allclose(moved / scale, distance, rtol=0, atol=1e-7 * np.ptp(mesh.vertices))
    assert np.median(np.abs(turned @ rotation - gradient)) < 1e-6


def test_fields_of_a_run_name_each_bone():
    scene = phantom_scene(model="pbd", end=20.0, step=20.0, spacing=6.0)
    with pytest.raises(UsageError, match="bone_sdfs must name each bone"):
        simulate(scene, bone_sdfs={"pelvis": BoneSDF.from_mesh(scene.bone("pelvis").mesh)})
