"""The shortest path over bones between a muscle's ends, and bowing, against closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.lines import line_length, tube_mesh
from rbfmuscle.metrics.centreline import NODES, Centreline, resampled, shortest_path
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.objects import Attachment

RADIUS, FAR = 10.0, 25.0


def ball():
    return BoneDistance("ball", trimesh.creation.icosphere(5, RADIUS))


def pulley():
    return BoneDistance("ball", trimesh.creation.cylinder(RADIUS, 80.0, sections=256))


def over_the_ball(height):
    """Points from one side of the ball to the other, over it for a positive height."""
    x = np.linspace(-FAR, FAR, 20)
    return np.stack([x, np.zeros(20), height * (1 - (x / FAR) ** 2)], axis=1)


@pytest.mark.parametrize("clearance", [0.0, 4.0])
@pytest.mark.parametrize("height", [20.0, -20.0, 14.5])
def test_string_over_a_ball_is_two_tangents_and_an_arc(height, clearance):
    motion = np.eye(4)  # of the whole scene
    motion[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    motion[:3, 3] = 3.0, -7.0, 11.0
    line = trimesh.transform_points(over_the_ball(height), motion)
    kept_off = np.full(NODES, clearance)
    path, settled = shortest_path(line, [ball()], {"ball": motion}, clearance=kept_off)
    assert settled
    path = trimesh.transform_points(path, np.linalg.inv(motion))
    radius = RADIUS + clearance
    tangent = np.sqrt(FAR**2 - radius**2)
    wrapped = 2 * tangent + radius * (np.pi - 2 * np.arctan2(tangent, radius))
    # 33 nodes cut the arc's corners, and the ball has facets: a thousandth of the length.
    assert line_length(path) == pytest.approx(wrapped, rel=1e-3)
    assert np.sign(path[len(path) // 2, 2]) == np.sign(height)
    assert np.linalg.norm(path[1:-1], axis=1).min() > 0.995 * radius
    away = np.eye(4)  # with nothing between it is straight
    away[:3, 3] = 0.0, 40.0, 0.0
    for probes, poses in (([], {}), ([ball()], {"ball": away})):
        path, _ = shortest_path(over_the_ball(height), probes, poses, clearance=kept_off)
        assert line_length(path) == pytest.approx(2 * FAR, rel=1e-6)


def test_path_is_the_same_in_any_unit_and_is_at_rest_where_it_was(monkeypatch):
    line, still = over_the_ball(20.0), {"ball": np.eye(4)}
    path, _ = shortest_path(line, [ball()], still, clearance=np.full(NODES, 2.0))
    small = BoneDistance("ball", trimesh.creation.icosphere(5, 1e-4 * RADIUS))
    found, _ = shortest_path(1e-4 * line, [small], still, clearance=np.full(NODES, 2e-4))
    np.testing.assert_allclose(1e4 * found, path, atol=1e-6)
    monkeypatch.setattr("rbfmuscle.metrics.centreline.ROUNDS", 2)
    given = line, [ball()], still, np.full(NODES, 2.0)
    again, settled = shortest_path(*given, path - resampled(line, NODES - 1))
    assert settled and np.abs(again - path).max() < 1e-3 * FAR
    assert not shortest_path(*given)[1]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_path_keeps_its_clearance_from_a_bone_beside_its_box(side):
    plate = trimesh.creation.box((20.0, 20.0, 4.0)).apply_translation([0.0, 0.0, -side * 3.0])
    probe = BoneDistance("plate", plate.subdivide().subdivide())
    line = np.linspace([-30.0, 0.0, 0.0], [30.0, 0.0, 0.0], 20)
    path, _ = shortest_path(line, [probe], {"plate": np.eye(4)}, clearance=np.full(NODES, 3.0))
    # One unit of way to the plate's face, two more to keep.
    assert side * path[len(path) // 2, 2] == pytest.approx(2.0, abs=0.01)
    assert line_length(path) == pytest.approx(2 * (10.0 + np.hypot(20.0, 2.0)), rel=0.01)


def test_path_goes_through_the_patches_via_bones():
    """A bent tube that a third bone holds at its bend: as long as the path through the bend."""
    bend = np.array([0.0, 0.0, 30.0])
    line = np.concatenate(
        [np.linspace([-40.0, 0, 0], bend, 20), np.linspace(bend, [40.0, 0, 0], 20)[1:]]
    )
    mesh = trimesh.Trimesh(*tube_mesh(line, np.full(len(line), 3.0)), process=False)
    rings = np.arange(len(mesh.vertices) - 2).reshape(len(line), -1)
    held = [Attachment("a", rings[0]), Attachment("b", rings[-1])]
    joints = [SimpleNamespace(name="j", parent="a", child="b", coordinates=("x",))]
    poses = {name: np.eye(4) for name in "abc"}
    measured = {}
    for via in ([], [Attachment("c", rings[19], via=True)]):
        muscle = SimpleNamespace(mesh=mesh, attachments=held + via)
        centreline = Centreline(muscle, joints, mesh.vertices, mesh.faces)
        measured[len(via)] = centreline.measure(mesh.vertices, poses, [])
    assert list(centreline.via) == [NODES // 2]  # the node at the bend, in the middle
    # The centroids of slices cut the corner at the bend, by less than the tube's radius.
    assert measured[1][0] == measured[0][0] == pytest.approx(100.0, abs=3.0)
    assert measured[0][1] == pytest.approx(measured[0][0] / 80.0, rel=1e-6)
    # The outer side of the bend has the larger triangles, which draw the ring's middle there.
    assert measured[1][1] == pytest.approx(measured[0][0] / 100.0, rel=0.02)
    path, settled = shortest_path(
        over_the_ball(20.0),
        [ball()],
        {"ball": np.eye(4)},
        clearance=np.zeros(NODES),
        via={16: bend},
    )
    assert settled and path[16] == pytest.approx(bend)
    assert line_length(path) == pytest.approx(2 * np.hypot(FAR, 30.0), rel=1e-3)


LENGTH = 90.0  # of a strip
HALF = 4.0  # its thickness
STRAIGHT = 25.0  # of its free ends


def strip():
    """A bar along x, thick along y, with its two ends as attachments, as the metric takes it."""
    mesh = trimesh.creation.box((LENGTH, 2 * HALF, 2 * HALF))
    while mesh.edges_unique_length.max() > 4.0:
        mesh = mesh.subdivide()
    x = mesh.vertices[:, 0]
    ends = [
        Attachment("trunk", np.flatnonzero(x < x.min() + 1e-6)),
        Attachment("limb", np.flatnonzero(x > x.max() - 1e-6)),
    ]
    muscle = SimpleNamespace(name="strip", mesh=mesh, attachments=ends)
    joint = SimpleNamespace(name="joint", parent="trunk", child="limb", coordinates={})
    return Centreline(muscle, [joint], np.array(mesh.vertices), np.array(mesh.faces)), mesh


def wrapped(points, radius):
    """Points (n, 3) of the strip with its middle bent about z on a circle between straight ends."""
    x = points[:, 0]
    bent = 0.5 * LENGTH - STRAIGHT
    angle = np.clip(x, -bent, bent) / radius
    beyond = x - np.clip(x, -bent, bent)
    r = radius + points[:, 1]
    return np.stack(
        [
            r * np.sin(angle) + beyond * np.cos(angle),
            r * np.cos(angle) - beyond * np.sin(angle),
            points[:, 2],
        ],
        axis=1,
    )


def end_pose(line, k, radius):
    """The rigid motion (4, 4) that takes an end of the straight strip to where it is wrapped."""
    middle = sum(areas @ points for _, points, areas in line.ends[k])
    middle /= sum(areas.sum() for *_, areas in line.ends[k])
    frame = np.vstack([middle, middle + np.eye(3)])
    placed = wrapped(frame, radius)
    pose = np.eye(4)
    pose[:3, :3] = (placed[1:] - placed[0]).T
    # Along x the strip is cut off at its end, so the direction is taken across it.
    pose[:3, 0] = np.cross(pose[:3, 1], pose[:3, 2])
    pose[:3, 3] = placed[0] - pose[:3, :3] @ middle
    return pose


def bowing(bone, radius):
    line, mesh = strip()
    poses = {"trunk": end_pose(line, 0, radius), "limb": end_pose(line, 1, radius)}
    vertices = wrapped(np.array(mesh.vertices), radius)
    return line.measure(vertices, {**poses, "ball": np.eye(4)}, [bone] if bone else [])[1]


@pytest.mark.parametrize("bone", [pulley, ball], ids=["cylinder", "sphere"])
def test_thick_strip_on_a_bone_does_not_bow_and_one_that_stands_off_does(bone):
    # Wrapped by 160 degrees, so that the straight line between its ends meets no bone. Sixteen
    # slices cut the corners of the arc by 0.003 of the length, 33 nodes by 0.001.
    assert bowing(bone(), RADIUS + HALF) == pytest.approx(1.0, abs=4e-3)
    # Off the bone by 4 mm more.
    radius = RADIUS + HALF + 4.0
    end = wrapped(np.array([[0.5 * LENGTH, 0.0, 0.0]]), radius)[0]
    far = np.hypot(end[0], end[1])
    apart = 2 * np.arctan2(end[0], end[1])
    tangent = np.sqrt(far**2 - (RADIUS + HALF) ** 2)
    arc = apart - 2 * np.arctan2(tangent, RADIUS + HALF)
    shortest = 2 * tangent + arc * (RADIUS + HALF)
    assert bowing(bone(), radius) == pytest.approx(LENGTH / shortest, abs=4e-3)
    assert LENGTH / shortest > 1.03  # the limit


def test_straight_strip_whose_ends_approach_bows_by_arc_over_chord():
    radius = 40.0
    end = wrapped(np.array([[0.5 * LENGTH, 0.0, 0.0]]), radius)[0]
    assert bowing(None, radius) == pytest.approx(LENGTH / (2 * end[0]), abs=2e-3)  # of the slices
    assert bowing(None, 1e6) == pytest.approx(1.0, abs=1e-6)


def test_a_path_that_does_not_come_to_rest_is_counted(monkeypatch):
    line, mesh = strip()
    radius = RADIUS + HALF
    poses = {"trunk": end_pose(line, 0, radius), "limb": end_pose(line, 1, radius)}
    given = wrapped(np.array(mesh.vertices), radius), {**poses, "ball": np.eye(4)}, [pulley()]
    line.measure(*given)
    assert line.unsettled == 0
    monkeypatch.setattr("rbfmuscle.metrics.centreline.ROUNDS", 1)
    line, _ = strip()
    line.measure(*given)
    assert line.unsettled == 1
