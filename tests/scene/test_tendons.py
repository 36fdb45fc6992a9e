"""Tendons against known answers: straight, around a pulley, of kept length, the same by every
path."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from tendon_scene import END, arm
from toy_scene import held

import rbfmuscle as rm
from rbfmuscle.geometry.lines import line_length, taut_line
from rbfmuscle.recording import Run
from rbfmuscle.run.appearance import LONGEST_TAPER, TAPER, tendon_mesh
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.options import TENDON_STRAIN
from rbfmuscle.scene.tendons import AT_REST, STIFFNESS_RATIO, Poses, TendonEnd, TendonLine


def placed(scene, bend, turn=0.0):
    poses = bone_poses(scene, {"elbow.bend": math.radians(bend), "elbow.turn": math.radians(turn)})
    return poses[END], poses.tendons[END].points, poses


@pytest.mark.parametrize("joints_last", [False, True])
def test_a_tendon_keeps_off_the_bones_between_its_ends_whenever_their_joints_are_added(joints_last):
    scene = rm.Scene("arm", units="mm")
    for name, middle in (("trunk", 60.0), ("limb", -65.0), ("wedge", 0.0)):
        mesh = trimesh.creation.cylinder(4.0, 8.0 if name == "wedge" else 100.0)
        scene.add_bone(name, mesh.apply_translation([0.0, 0.0, middle]))
    joints = [("upper", "trunk", "wedge"), ("lower", "wedge", "limb")]
    belly = trimesh.creation.capsule(70.0, 9.0).apply_translation([0.0, -20.0, 15.0])
    z = belly.vertices[:, 2]
    attach = held(trunk=z > z.max() - 6.0, limb=z < z.min() + 6.0)
    attach[1]["tendon"] = {"to": [0.0, -8.0, -70.0]}
    steps = [
        lambda: [scene.add_joint(*names, type="weld") for names in joints],
        lambda: scene.add_muscle("strap", belly, attach=attach),
    ]
    for step in reversed(steps) if joints_last else steps:
        step()
    (end,) = scene.muscles[0].tendons
    assert [bone.name for bone in end.obstacles] == ["trunk", "limb", "wedge"]


def test_a_bent_joint_takes_the_end_along_the_straight_line_at_the_tendons_length():
    scene = arm()
    np.testing.assert_allclose(placed(scene, 0.0)[0], np.eye(4), atol=1e-12)
    end = scene.muscles[0].tendons[0]
    assert end.length == pytest.approx(np.linalg.norm(end.middle - [0.0, -8.0, -70.0]), rel=1e-12)
    for bend in (0.0, 20.0, 50.0, 80.0):
        pose, line, poses = placed(scene, bend)
        middle = pose[:3, :3] @ end.middle + pose[:3, 3]
        insertion = (poses["limb"] @ [0.0, -8.0, -70.0, 1.0])[:3]
        np.testing.assert_allclose(line[[0, -1]], [middle, insertion], atol=1e-9)
        # The strap becomes slack: its belly takes up all of that.
        assert line_length(line) == pytest.approx(end.length, rel=1e-9)
        assert np.linalg.norm(middle - insertion) == pytest.approx(end.length, rel=1e-9)


def test_a_pulled_tendon_takes_its_share_of_the_stretch_and_never_more_than_its_limit():
    scene = arm()
    end = scene.muscles[0].tendons[0]
    start = np.asarray(end.other[0][1])
    away = np.array([0.0, -8.0, -70.0]) - start
    belly = np.linalg.norm(away) - end.length
    for longer in (-10.0, 5.0, 30.0, 500.0):
        pulled = np.eye(4)
        pulled[:3, 3] = longer * away / np.linalg.norm(away)
        line, _ = end.place({"trunk": np.eye(4), "limb": pulled})
        strain = line_length(line.points) / end.length - 1.0
        springs = longer * STIFFNESS_RATIO / (belly + STIFFNESS_RATIO * end.length)
        # The end lies 5 mm beside the string, whose length at rest is therefore not quite belly and
        # tendon.
        assert strain == pytest.approx(min(max(springs, 0.0), TENDON_STRAIN), rel=0.01, abs=1e-9)


def test_a_taut_line_around_a_cylinder_is_two_tangents_and_an_arc():
    radius = 20.0
    far = 60.0
    height = 10.0
    angles = np.linspace(0.0, 2.0 * np.pi, 721)[:-1]
    ring = radius * np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1)
    points = np.concatenate([ring + [0.0, y, 0.0] for y in np.linspace(-9, 9, 19)])
    ends = np.array([[-far, 0.0, height - 5.0], [far, 0.0, height - 5.0]])
    line = taut_line(*ends, np.array([0.3, 0.0, 1.0]), [(np.eye(4), points)], 5.0)
    away = math.hypot(far, height - 5.0)
    tangent = math.sqrt(away**2 - radius**2)
    turned = 2.0 * (math.asin(far / away) - math.acos(radius / away))
    # A ring of 720 points: its arc is short by 3e-6 of itself.
    assert line_length(line) == pytest.approx(2.0 * tangent + radius * turned, rel=1e-5)
    assert np.linalg.norm(line[:, [0, 2]], axis=1).min() > radius - 1e-3
    straight = taut_line(
        *ends, np.array([0.0, 0.0, -1.0]), [(np.eye(4), points + [0, 0, 50.0])], 5.0
    )
    np.testing.assert_array_equal(straight, ends)


def test_a_string_passes_bones_on_the_side_of_the_bellys_end():
    scene = rm.Scene("head and post", units="mm")
    turn = trimesh.transformations.rotation_matrix(0.5 * np.pi, [0.0, 1.0, 0.0])
    scene.add_bone("head", trimesh.creation.cylinder(20.0, 100.0, sections=360, transform=turn))
    post = trimesh.creation.cylinder(2.0, 30.0).apply_translation([8.0, -30.0, 0.0])
    scene.add_bone("post", post)
    middle = np.array([0.0, -30.0, 0.0])
    end = TendonEnd(
        name="end",
        patch=middle[None],
        middle=middle,
        radii=(1.0, 1.0),
        line=[("head", np.array([0.0, 0.0, -60.0]))],
        other=[("post", np.array([0.0, 0.0, 80.0]))],
        obstacles=scene.bones,
    )
    # The post is nearer, but out of it the string would go around the flat end of the head.
    (string,) = end._string(AT_REST)
    tangents = math.sqrt(80.0**2 - 20.0**2) + math.sqrt(60.0**2 - 20.0**2)
    turned = math.asin(20.0 / 80.0) + math.asin(20.0 / 60.0)
    # Points of the head are up to 1 mm beside the string's plane, and count as 0.5 mm lower.
    assert line_length(string) == pytest.approx(tangents + 20.0 * turned, rel=5e-3)
    assert string[:, 1].min() == pytest.approx(-20.0, abs=0.5)
    np.testing.assert_allclose(string[:, 0], 0.0, atol=1e-9)


def test_a_tendon_between_two_bones_passes_beside_one_not_through_the_other():
    radius = 15.0
    scene = rm.Scene("condyle and plateau", units="mm")
    scene.add_bone("condyle", trimesh.creation.icosphere(subdivisions=4, radius=radius))
    plateau = trimesh.creation.box((50.0, 60.0, 20.0))
    for _ in range(4):
        plateau = plateau.subdivide()
    scene.add_bone("plateau", plateau.apply_translation([5.0, 0.0, -27.0]))
    middle, via, insertion = np.array([[-24.0, 4, -30], [-24.0, 8, -12], [15.5, 8, -3]])
    end = TendonEnd(
        name="end",
        patch=middle[None],
        middle=middle,
        radii=(3.0, 1.0),
        line=[("plateau", via), ("condyle", insertion)],
        other=[("plateau", np.array([-24.0, 0.0, -90.0]))],
        obstacles=scene.bones,
    )
    line = end.place(AT_REST)[0].points
    # Out of the condyle, which is nearest, the string would go through the plateau.
    for bone in scene.bones:
        assert bone.exact.depth(line).max() < 1e-9
    away = [float(np.linalg.norm(point)) for point in (via, insertion)]
    turned = math.acos(via @ insertion / math.prod(away)) - sum(
        math.acos(radius / one) for one in away
    )
    shortest = sum(math.sqrt(one**2 - radius**2) for one in away) + radius * turned
    past_via = line_length(line) - np.linalg.norm(via - middle)
    # It lies in a plane, of 16 about its chord.
    assert shortest - 1e-6 < past_via < 1.04 * shortest


def test_the_end_of_a_limb_bent_backwards_goes_around_the_joint_continuously():
    scene = arm()
    end = scene.muscles[0].tendons[0]
    middles = []
    for bend in np.arange(20.0, -60.0, -1.0):
        pose, line, poses = placed(scene, bend)
        middles.append(pose[:3, :3] @ end.middle + pose[:3, 3])
        inverse = np.linalg.inv(poses["limb"])
        local = line @ inverse[:3, :3].T + inverse[:3, 3]
        inside = np.hypot(local[:, 0], local[:, 1])[(local[:, 2] < -5.0) & (local[:, 2] > -125.0)]
        # The line passes points of the surface that are 2 mm apart.
        assert inside.min() > 8.0 - 0.3
        assert line_length(line) <= end.length * (1.0 + TENDON_STRAIN) * (1.0 + 1e-6)
    steps = np.linalg.norm(np.diff(middles, axis=0), axis=1)
    # The insertion moves by 1.2 mm in a step of one degree.
    assert steps.max() < 3.0


def test_a_motion_of_all_bones_together_moves_the_end_with_them():
    scene = arm()
    poses = bone_poses(scene, {"elbow.bend": -0.6, "elbow.turn": 0.4})
    motion = trimesh.transformations.rotation_matrix(1.1, [1.0, 2.0, 0.5], [30.0, -5.0, 7.0])
    motion[:3, 3] += [5.0, 6.0, -7.0]
    moved = (
        scene.muscles[0]
        .tendons[0]
        .place({name: motion @ poses[name] for name in ("trunk", "limb")})[1]
    )
    np.testing.assert_allclose(moved, motion @ poses[END], atol=1e-9)


def test_a_twist_of_the_limb_turns_the_end_by_its_place_along_the_string():
    scene = arm()
    end = scene.muscles[0].tendons[0]
    turn = math.radians(30.0)
    start, axis = end.other[0][1], np.array([0.0, 0.0, 1.0])
    twisted = trimesh.transformations.rotation_matrix(turn, axis, [0.0, -8.0, 0.0])
    pose = end.place({"trunk": np.eye(4), "limb": twisted})[1]
    near = np.linalg.norm(end.middle - start)
    share = near / (near + np.linalg.norm(end.middle - [0.0, -8.0, -70.0]))
    found = math.acos(0.5 * (np.trace(pose[:3, :3]) - 1.0))
    # The string leans by 6 degrees against the axis of the twist.
    assert found == pytest.approx(share * turn, rel=0.02)
    # A via point of the trunk lets no twist of the limb through.
    led = arm(via=[{"bone": "trunk", "point": [0.0, -14.0, -45.0]}]).muscles[0].tendons[0]
    assert np.allclose(
        led.place({"trunk": np.eye(4), "limb": twisted})[1][:3, :3], np.eye(3), atol=1e-9
    )


@pytest.mark.parametrize("model", ["pbd", "rbf"])
def test_both_models_carry_the_end_and_measure_the_tendon(model):
    name = {"name": "rbf", "centres": 60} if model == "rbf" else model
    stops = [{"elbow.bend": 0}, {"elbow.bend": 30}, {"elbow.bend": 0}]
    scene = arm(name).set_motion(waypoints=stops, step=15)
    run = rm.simulate(scene)
    vertices = np.asarray(scene.muscles[0].mesh.vertices)[scene.muscles[0].attachments[1].vertices]
    for frame in run.frames:
        pose = frame.poses[END]
        patch = vertices @ pose[:3, :3].T + pose[:3, 3]
        shown = frame.surfaces["strap"]
        away = trimesh.proximity.signed_distance(
            trimesh.Trimesh(shown.vertices, shown.faces), patch
        )
        # The surface of 60 centres is fitted to the patch, that of the mesh is the patch.
        assert np.abs(away).max() < (1.5 if model == "rbf" else 1e-6)
    np.testing.assert_allclose(run.frames[-1].poses[END], run.frames[0].poses[END], atol=1e-12)
    rows = {(row.frame, row.quantity): row.value for row in run.metrics}
    end = scene.muscles[0].tendons[0]
    # The centreline of the fitted surface bends a little.
    belly = np.linalg.norm(end.middle - end.other[0][1])
    assert rows[0, "length"] == pytest.approx(belly + end.length, abs=0.5)
    assert rows[0, "end_gap"] < 10.0 < np.linalg.norm(end.middle - [0.0, -8.0, -70.0])


@pytest.mark.parametrize(("length", "taper"), [(100.0, 4.0 * TAPER), (10.0, 10.0 * LONGEST_TAPER)])
def test_a_drawn_tendon_tapers_smoothly_from_the_belly_to_its_own_radius(length, taper):
    line = TendonLine(np.linspace([5.0, 0.0, 0.0], [5.0, 0.0, length], 101), (4.0, 1.0))
    muscle = SimpleNamespace(tendons=[SimpleNamespace(name="one"), SimpleNamespace(name="absent")])
    vertices, _ = tendon_mesh(muscle, {"one": line})
    share = np.clip(vertices[:-2, 2] / taper, 0.0, 1.0)
    radii = np.hypot(vertices[:-2, 0] - 5.0, vertices[:-2, 1])
    np.testing.assert_allclose(radii, 4.0 - 3.0 * (3.0 * share**2 - 2.0 * share**3), rtol=1e-9)


def test_a_notebook_shows_a_run_with_tendons(tmp_path):
    run = rm.simulate(arm())
    run.save(tmp_path, pictures=False)
    assert Run.load(tmp_path).tendons and list(tmp_path.glob("surfaces/*tendon*"))
    for shown in (run, rm.Run.load(tmp_path)):
        assert "data:image/webp;base64," in shown._repr_html_()


def test_a_belly_between_two_tendons_keeps_both():
    scene = arm()
    z = scene.muscles[0].mesh.vertices[:, 2]
    attach = held(trunk=z > z.max() - 6.0, limb=z < z.min() + 6.0)
    for entry, height in zip(attach, (110.0, -70.0)):
        entry["tendon"] = {"to": [0.0, -8.0, height]}
    scene.muscles = []
    scene.add_muscle("strap", arm().muscles[0].mesh, attach=attach)
    poses = bone_poses(scene, {"elbow.bend": 0.7})
    for end in scene.muscles[0].tendons:
        assert poses[end.name].shape == (4, 4)
        assert line_length(poses.tendons[end.name].points) == pytest.approx(end.length, rel=1e-6)


def test_via_points_of_another_bone_hold_the_line():
    scene = arm(via=[{"bone": "trunk", "point": [0.0, -12.0, 5.0]}])
    _, line, _ = placed(scene, 40.0)
    assert np.linalg.norm(line - [0.0, -12.0, 5.0], axis=1).min() < 1e-9
    for wrong in ({"via": [{"bone": "trunc", "point": [0.0, 0.0, 0.0]}]}, {"to": [0.0, 0.0]}):
        with pytest.raises(rm.SceneError, match="tendon"):
            arm(**wrong)


def test_a_tendon_that_does_not_come_to_its_length_is_an_event(monkeypatch):
    def actions():
        scene = arm().set_motion(waypoints=[{"elbow.bend": 0}, {"elbow.bend": 20}], step=10)
        return [(e.frame, e.action) for e in rm.simulate(scene, "pbd").events]

    assert all(action != "iteration_cap" for _, action in actions())
    # No difference is small enough.
    monkeypatch.setattr("rbfmuscle.scene.tendons.TOLERANCE", -1.0)
    assert (2, "iteration_cap") in actions()


def test_ends_that_touch_each_other_stay_side_by_side_where_a_bone_lifts_one():
    scene = rm.Scene("block under two ends", units="mm")
    block = trimesh.creation.box((20.0, 40.0, 40.0)).apply_translation([-13.0, 0.0, 0.0])
    scene.add_bone("block", block)

    def end(name, x):
        return TendonEnd(
            name=name,
            patch=np.array([x, 0.0, 0.0]) + 2.0 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0]]),
            middle=np.array([x, 0.0, 0.0]),
            radii=(2.5, 1.0),
            line=[("limb", np.array([x + 3.0, 0.0, -60.0]))],
            other=[("trunk", np.array([x + 3.0, 0.0, 60.0]))],
            obstacles=scene.bones,
        )

    ends = [end("under", 0.0), end("on it", 4.0), end("apart", 12.0)]
    pushed = np.eye(4)
    pushed[0, 3] = 4.0  # its side goes from -3 to 1, and the lowest point of the ends is at -2
    for order in (ends, ends[::-1]):
        bones = {"block": pushed, "limb": np.eye(4), "trunk": np.eye(4)}
        poses = Poses(bones, {end.name: end for end in order})
        shifts = [poses[end.name][0, 3] for end in ends]
        np.testing.assert_allclose(shifts, [3.0, 3.0, 0.0], atol=1e-6)
        for tendon_end in ends:
            tendon = poses.tendons[tendon_end.name]
            assert tendon.settled
            assert line_length(tendon.points) == pytest.approx(tendon_end.length, rel=1e-6)


def test_an_end_goes_straight_to_its_via_point_when_a_corner_of_bone_comes_before_it(leg_data):
    scene = rm.Scene.load(leg_data / "tendons" / "squat.toml")
    (end,) = scene.muscle("obturator_internus").tendons
    poses = [bone_poses(scene, frame)[end.name] for frame in scene.motion.frames]
    places = np.array([pose[:3, :3] @ end.middle + pose[:3, 3] for pose in poses])
    jumps = np.linalg.norm(np.diff(places, 2, axis=0), axis=1)
    # mm: 0.3; 3.3 along the tendon, whose first piece turns when it meets the corner.
    assert len(jumps) > 30 and jumps.max() < 1.0
