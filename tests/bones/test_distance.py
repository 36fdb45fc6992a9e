"""Exact distances to one bone from loops, against libigl and known answers."""

import igl
import numpy as np
import pytest
import trimesh
from conftest import samples

from rbfmuscle.bones.distance import STACK, Memory, bone_arrays, distance_loop, winding_number
from rbfmuscle.geometry.exact_distance import ExactDistance

ROUGH = trimesh.creation.icosphere(2, 10.0)
ROUGH.vertices *= np.random.default_rng(3).uniform(0.8, 1.2, (len(ROUGH.vertices), 1))
SHAPES = {
    "sphere": trimesh.creation.icosphere(3, 10.0),
    "box": trimesh.creation.box((20.0, 30.0, 40.0)),
    "torus": trimesh.creation.torus(20.0, 5.0),
    "thin plate": trimesh.creation.box((40.0, 30.0, 0.5)),
    "rough": ROUGH,
}


def arrays_of(mesh, *, closed=True):
    return bone_arrays(ExactDistance(mesh.vertices, mesh.faces), closed=closed)


def ask(bone, points, *, reach=np.inf, memory=None, pose=None):
    count = len(points)
    memory = Memory.of(count) if memory is None else memory
    distance, gradient = np.empty(count), np.empty((count, 3))
    pose = np.eye(4) if pose is None else pose
    limit = np.full(count, float(reach))
    distance_loop(bone, pose, np.array(points, float), limit, *memory, distance, gradient)
    return distance, gradient


def points_about(mesh, count=3000, seed=0):
    count, rng = samples(count), np.random.default_rng(seed)
    near = mesh.vertices[rng.integers(len(mesh.vertices), size=count)]
    low, high = mesh.bounds
    return np.concatenate(
        [near + rng.normal(0.0, 2.0, near.shape), rng.uniform(low - 20, high + 20, near.shape)]
    )


def some_pose():
    pose = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, -0.5])
    pose[:3, 3] = 30.0, -20.0, 10.0
    return pose


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_distances_in_a_pose_are_those_of_libigl_and_gradients_lead_to_the_surface(shape, closed):
    points, pose = points_about(shape), some_pose()
    vertices, faces = np.array(shape.vertices), np.array(shape.faces)
    expected, _, nearest, _ = igl.signed_distance(
        points, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    )
    world = points @ pose[:3, :3].T + pose[:3, 3]
    distance, gradient = ask(arrays_of(shape, closed=closed), world, pose=pose)
    np.testing.assert_allclose(distance, expected, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    foot = (world - distance[:, None] * gradient - pose[:3, 3]) @ pose[:3, :3]
    # On the skeleton of a shape two points are equally near.
    same = np.linalg.norm(foot - nearest, axis=1) < 1e-9
    assert same.mean() > 0.99
    again = igl.signed_distance(foot, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    np.testing.assert_allclose(again, 0.0, atol=1e-11)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_what_is_remembered_changes_no_answer(shape):
    bone, points = arrays_of(shape), points_about(shape)
    rng, memory = np.random.default_rng(1), Memory.of(len(points))
    for step in range(5):
        distance, gradient = ask(bone, points)
        known, slope = ask(bone, points, memory=memory)
        np.testing.assert_array_equal(known, distance)
        np.testing.assert_array_equal(slope, gradient)
        for reach in (3.0, 0.0, -0.5):
            some, slope = ask(bone, points, reach=reach, memory=memory)
            far = (slope == 0.0).all(axis=1)
            np.testing.assert_array_equal(some[~far], distance[~far])
            np.testing.assert_array_equal(slope[~far], gradient[~far])
            # Left out is only what is beyond reach, with a bound that is one.
            assert np.all(distance[far] > reach)
            assert np.all(some[far] > reach)
            assert np.all(some[far] <= distance[far] + 1e-12)
        if step > 0:
            assert far.mean() > 0.3
        points = points + rng.normal(0.0, 0.3, points.shape)


def test_on_the_surface_gradients_are_unit_normals_of_a_face_there():
    box = SHAPES["box"]
    middles = box.vertices[box.edges_unique].mean(axis=1)
    points = np.concatenate([box.vertices, middles, box.triangles_center])
    distance, gradient = ask(arrays_of(box), points)
    np.testing.assert_allclose(distance, 0.0, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    # Vertices may be moved by 1e-12 of the size, and normals turned by as much.
    on_face = np.abs(np.abs(points) - [10.0, 15.0, 20.0]) < 1e-9
    # In the cone of the faces' normals: along none of the other axes, and outward.
    np.testing.assert_allclose(gradient[~on_face], 0.0, atol=1e-10)
    assert np.all((gradient * np.sign(points))[on_face] >= -1e-10)


def test_sides_are_right_at_sharp_edges_and_corners():
    """A thin wedge: beside its sharp edges and corners a face's own normal tells the wrong side."""
    wedge = trimesh.convex.convex_hull([[0.0, 0, 0], [30, 0, 0], [15, 40, 0.5], [15, 10, 3]])
    rng = np.random.default_rng(2)
    close = wedge.vertices[rng.integers(4, size=samples(4000))]
    close += rng.normal(0.0, 0.5, close.shape)
    distance, _ = ask(arrays_of(wedge), close)
    planes = (close[:, None] - wedge.triangles[:, 0]) @ wedge.face_normals.T
    inside = np.diagonal(planes, axis1=1, axis2=2).max(axis=1) < 0.0
    assert 0 < inside.sum() < len(close)
    np.testing.assert_array_equal(distance < 0.0, inside)


def test_open_and_crossed_meshes_are_signed_by_their_winding_number():
    ball = trimesh.creation.icosphere(3, 10.0)
    hole = np.linalg.norm(ball.triangles_center - [10.0, 0, 0], axis=1) < 3.0
    torn = trimesh.Trimesh(ball.vertices, ball.faces[~hole], process=False)
    two = trimesh.util.concatenate(ball, ball.copy().apply_translation([9.0, 0, 0]))
    points = np.random.default_rng(4).uniform(-15, 25, (samples(3000), 3))
    for mesh in (torn, two):
        bone = arrays_of(mesh, closed=False)
        winding = igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces), points)
        stack = np.empty(STACK, np.int64)
        found = np.array([winding_number(bone, *point, stack) for point in points])
        np.testing.assert_allclose(found, winding, atol=0.05)  # dipoles from two radii on
        distance, _ = ask(bone, points)
        clear = np.abs(winding - 0.5) > 0.05
        np.testing.assert_array_equal(distance[clear] < 0.0, winding[clear] > 0.5)
    # A point that comes in through the hole is found inside, whatever was known of it.
    bone, memory = arrays_of(torn, closed=False), Memory.of(1)
    assert ask(bone, [[13.0, 0, 0]], reach=0.5, memory=memory)[0] > 0.5
    assert ask(bone, [[5.0, 0, 0]], reach=0.5, memory=memory)[0] < -3.0
