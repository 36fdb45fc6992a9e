"""Other fields of bones, with the interface of BoneSDF: their accuracy, and a whole run by each."""

import numpy as np
import pytest
import trimesh
from peers.detectors import TreeDetector, VoxelDetector
from peers.serendipity import SerendipityField
from peers.spline import SplineField

import rbfmuscle as rm
from rbfmuscle.bones.errors import measure_field
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.validation import UsageError

RADIUS = 0.7
# Fields of a mesh, largest error at 3 from a ball of 20, least cosine of the direction. A voxel's edge is 1.2.
FIELDS = {
    "sdf": (lambda mesh: BoneSDF.from_mesh(mesh, cache=False), 0.03, 0.99),
    "bvh": (TreeDetector.from_mesh, 0.03, 0.99),
    "spline": (lambda mesh: SplineField.from_mesh(mesh, nodes=60_000), 0.05, 0.95),
    "serendipity": (lambda mesh: SerendipityField.from_mesh(mesh, cells=20), 0.05, 0.95),
    "voxel": (lambda mesh: VoxelDetector.from_mesh(mesh, resolution=40), 1.3, 0.3),
}


def _sphere(points):
    return np.linalg.norm(points, axis=1) - RADIUS


def _directions(count, seed=0):
    unit = np.random.default_rng(seed).normal(size=(count, 3))
    return unit / np.linalg.norm(unit, axis=1, keepdims=True)


# Largest errors within 0.1 of a sphere of 0.7 in [-1, 1]^3, from docs/sdf.md; fourth order.
@pytest.mark.parametrize(("cells", "error"), [(8, 5.9e-4), (16, 4.3e-5), (32, 3.2e-6), (64, 2.0e-7)])
def test_serendipity_cells_are_of_fourth_order_on_a_sphere(cells, error):
    field = SerendipityField(_sphere, [-1.0] * 3, [1.0] * 3, cells)
    points = _directions(100_000) * (RADIUS + np.random.default_rng(1).uniform(-0.1, 0.1, (100_000, 1)))
    found = np.abs(field.distance(points) - _sphere(points)).max()
    assert error / 3 < found <= error


@pytest.mark.parametrize("name", FIELDS)
def test_detectors_agree_on_a_ball_in_any_pose(name):
    ball = trimesh.creation.icosphere(4, 20.0)
    build, error, cosine = FIELDS[name]
    detector = build(ball)
    pose = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0])
    pose[:3, 3] = [30.0, -10.0, 5.0]
    unit = _directions(3000)
    offset = np.random.default_rng(2).uniform(-3.0, 3.0, len(unit))
    points = unit * (20.0 + offset)[:, None]
    distance, gradient = detector.distance_and_gradient(trimesh.transform_points(points, pose), pose)
    assert np.abs(distance - offset).max() < error
    assert np.einsum("ni,ni->n", gradient @ pose[:3, :3], unit).min() > cosine
    np.testing.assert_array_equal(distance, detector.distance(trimesh.transform_points(points, pose), pose))
    assert detector.memory > 1000


def test_measured_errors_are_those_of_the_field():
    field = BoneSDF.from_mesh(trimesh.creation.icosphere(3, 20.0), cache=False)

    class Shifted:
        vertices, faces, closed = field.vertices, field.faces, True

        def distance_and_gradient(self, points):
            distance, gradient = field.distance_and_gradient(points)
            return distance + 0.1, -gradient

        def distance(self, points):
            return field.distance(points) + 0.1

    found = measure_field(Shifted(), count=5000)
    assert found["error_rms"] == pytest.approx(0.1, rel=0.01)
    assert found["sign_wrong"] > 0.01 and found["angle_median"] > 179.0


def test_fields_of_a_run_name_each_bone():
    scene = rm.phantom_scene(model="pbd", end=20.0, step=20.0, spacing=6.0)
    bone = scene.bones[0]
    with pytest.raises(UsageError, match="fields must name each bone"):
        rm.simulate(scene, fields={bone.name: TreeDetector.from_mesh(bone.mesh)})
