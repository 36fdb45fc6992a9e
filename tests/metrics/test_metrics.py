"""Metrics against known answers: spheres, boxes, cylinders, a string over a pulley."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.centreline import Centreline, split_ends
from rbfmuscle.metrics.metrics import MuscleMeasures, SurfaceForm, euler_characteristic
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.metrics.rows import (
    _roughness,
    _smoothness,
    bone_depth,
    moment_arm_rows,
    moment_arms,
    surface_depth,
)
from rbfmuscle.recording import simulate
from rbfmuscle.scene.bone import Bone, BoneDistance
from rbfmuscle.scene.joints import Coordinate
from rbfmuscle.scene.objects import Attachment, Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame, ModelSurface

EYE = np.eye(4)


def arrays(mesh):
    return np.array(mesh.vertices), np.array(mesh.faces)


def turned(angle, axis, centre=(0, 0, 0)):
    return trimesh.transformations.rotation_matrix(angle, axis, centre)


class TestPenetration:
    def test_bone_corner_in_a_muscle_that_no_muscle_vertex_shows(self):
        block = trimesh.creation.box((40, 40, 10))
        spike = trimesh.creation.cone(radius=1.0, height=6.0)  # apex at z = 6
        pose = np.eye(4)
        pose[:3, 3] = [3.3, 4.1, -9.0]  # apex at z = -3, that is 2 above the block's lower face
        probes = [BoneDistance("spike", spike)]
        assert surface_depth(np.array(block.vertices), probes, {"spike": pose}).max() == 0
        depth = bone_depth(MeshDistance(*arrays(block)), probes, {"spike": pose})
        assert depth == pytest.approx(2.0, abs=1e-9)
        assert bone_depth(MeshDistance(*arrays(block)), [], {}) == 0.0


class TestMeshMeasures:
    def test_form_is_looked_for_again_where_it_can_have_changed(self):
        ball = trimesh.creation.icosphere(subdivisions=2)
        one = ModelSurface(np.array(ball.vertices), np.array(ball.faces))
        folded = ModelSurface(
            one.vertices * np.where(one.vertices[:, :1] > 0.3, -1.0, 1.0), one.faces
        )
        torus = trimesh.creation.torus(3.0, 1.0)
        other = ModelSurface(np.array(torus.vertices), np.array(torus.faces))
        moved = ModelSurface(folded.vertices + 5.0, one.faces, origin=(folded, np.eye(4)))
        form = SurfaceForm()
        found = [form.measure(s, same_faces=s is not other) for s in (one, folded, moved, other)]
        assert [m["euler_characteristic"] for m in found] == [2, 2, 2, 0]
        assert found[0]["self_crossings"] == 0 < found[1]["self_crossings"]
        assert found[2] == found[1]
        assert found[3]["self_crossings"] == 0


def rod(length=100.0, radius=8.0, rings=60, around=24):
    """A closed cylinder along x from 0 to ``length``, with many rings, as a Trimesh."""
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0))
    profile = [(0, 0), *((radius, z) for z in np.linspace(0, length, rings)), (0, length)]
    mesh = trimesh.creation.revolve(profile, sections=around).apply_transform(turn)
    mesh.vertices[:, 0] = mesh.vertices[:, 0].round(9)
    return mesh


def rod_muscle(mesh, length=100.0):
    ends = [("trunk", mesh.vertices[:, 0] == 0), ("limb", mesh.vertices[:, 0] == length)]
    attachments = [Attachment(bone, np.flatnonzero(where)) for bone, where in ends]
    return SimpleNamespace(
        name="rod", mesh=mesh, attachments=attachments, contraction=None, tendons=[]
    )


BEND = {"bend": Coordinate()}
JOINTS = [
    SimpleNamespace(
        name="joint", parent="trunk", child="limb", coordinates=BEND, centre=np.zeros(3)
    )
]


class TestLength:
    def test_bent_cylinder_has_its_arc(self):
        mesh, radius = rod(), 60.0
        line = Centreline(rod_muscle(mesh), JOINTS, *arrays(mesh))
        v = np.array(mesh.vertices)
        angle = v[:, 0] / radius
        bent = np.stack(
            [(radius + v[:, 1]) * np.sin(angle), (radius + v[:, 1]) * np.cos(angle), v[:, 2]], 1
        )
        pose = turned(-100 / radius, (0, 0, 1))
        pose[:3, 3] = [radius * np.sin(100 / radius), radius * np.cos(100 / radius), 0]
        pose[:3, 3] -= pose[:3, :3] @ [100, 0, 0]
        start = np.eye(4)
        start[1, 3] = radius
        # 17 chords of an arc of 95 degrees are 0.04 % short.
        assert line.length(bent, {"trunk": start, "limb": pose}) == pytest.approx(100, rel=3e-3)

    def test_slices_lie_evenly_along_a_cylinder_from_the_first_of_its_levels_to_the_last(self):
        mesh = rod()
        line = Centreline(rod_muscle(mesh), JOINTS, *arrays(mesh))
        # Of 120 levels between the ends: the field is even along a cylinder.
        place = (line.operator @ mesh.vertices)[:, 0]
        assert place == pytest.approx(np.linspace(100 / 121, 100 * 120 / 121, 16), abs=1e-3)

    def test_bones_whose_joint_rests_are_one_end(self):
        rows = [
            ("tibiofibular", "tibia", "fibula"),
            ("ankle", "tibia", "talus"),
            ("knee", "femur", "tibia"),
        ]
        joints = [SimpleNamespace(name=n, parent=p, child=c, coordinates=BEND) for n, p, c in rows]
        soleus = SimpleNamespace(
            attachments=[
                SimpleNamespace(bone=b, via=b == "heel")
                for b in ("fibula", "tibia", "heel", "talus")
            ]
        )

        def ends(moving):
            return [[a.bone for a in group] for group in split_ends(soleus, joints, moving)]

        assert ends({"ankle"}) == ends({"ankle", "knee"}) == [["fibula", "tibia"], ["talus"]]
        # Where nothing moves its ends against each other, they are those of joints that all might
        # move.
        assert ends({"knee"}) == ends(None) == [["fibula"], ["tibia", "talus"]]


class TestMomentArm:
    def arms(self, angles, lengths, name="joint.bend"):
        return [found.get(name) for found in moment_arms([{name: a} for a in angles], lengths)]

    def test_string_over_a_pulley_has_its_radius_and_a_parabola_its_slope_however_the_steps_are(
        self,
    ):
        angles = np.radians([0, 5, 10, 20, 40])
        assert self.arms(angles, 200 + 23.5 * angles) == pytest.approx([-23.5] * 5)
        angles = np.array([0.1, 0.2, 0.5])
        assert self.arms(angles, 3 * angles**2 - angles)[1] == pytest.approx(-(6 * 0.2 - 1))
        angles = np.cumsum(np.radians([0.0, 1.0, 0.3, 2.0, 0.7, 1.1, 0.2, 3.0, 1.0]))
        assert self.arms(angles, 3 * angles**2 - angles) == pytest.approx(
            -(6 * angles - 1), rel=1e-6
        )

    def test_ripple_of_lengths_is_smoothed_where_frames_are_near(self):
        angles = np.radians(np.arange(41.0))
        ripple = 0.05 * np.random.default_rng(2).normal(size=len(angles))
        arms = np.array(self.arms(angles, 40.0 * np.cos(angles) + ripple))
        plain = -np.gradient(40.0 * np.cos(angles) + ripple, angles)
        away, before = arms - 40.0 * np.sin(angles), plain - 40.0 * np.sin(angles)
        assert np.abs(away[8:-8]).max() < 0.2 * np.abs(before[8:-8]).max()

    def test_legs_of_a_path_have_their_coordinate_and_two_at_once_none(self):
        assert moment_arms([{"a": 0.0, "b": 0.0}, {"a": 0.1, "b": 0.1}], [1.0, 1.2]) == [{}, {}]
        path = [{"a": 0.0}, {"a": 0.3}, {"a": 0.3, "b": 0.3}, {"a": 0.3, "b": 0.6}]
        found = moment_arms(path, [1.0, 1.3, 1.9, 2.8])
        assert found[1:3] == [pytest.approx({"a": -1.0, "b": -1.5}), pytest.approx({"b": -2.5})]

    def test_turning_point_takes_the_way_there_and_unknown_lengths_and_rest_give_none(self):
        assert self.arms([0.2, 0.3, 0.2], [10, 11, 10.4])[1] == pytest.approx(-10)
        assert self.arms([0.0, 0.1, 0.2, 0.2], [1.0, np.nan, 2.0, 2.0]) == [None] * 4

    @pytest.mark.parametrize("step", [1.0, 2.0, 5.0, 8.0])
    def test_error_falls_with_the_square_of_the_step_at_both_ends_too(self, step):
        def worst(step):
            angles = np.radians(np.arange(0.0, 80.0 + step / 2, step))
            off = np.array(self.arms(angles, 40.0 * np.cos(angles))) - 40.0 * np.sin(angles)
            return np.abs(off[[0, 1, -2, -1]]).max()

        # Of a parabola through three points a third of the third derivative times the step squared,
        # of one fitted over a reach a tenth of that squared.
        assert worst(step) < 1.1 * 40.0 * max(np.radians(step) ** 2 / 3, np.radians(8.0) ** 2 / 10)

    def test_over_a_joint_that_another_follows_is_the_total_derivative_in_every_frame(self):
        """A straight muscle over a hip and a patella that tilts by half the flexion, by 5 degrees
        (case 42 of the reference cases).
        """

        def turned(point, centre, angle):
            c, s = np.cos(angle), np.sin(angle)
            return centre + np.array([[c, -s], [s, c]]) @ (point - centre)

        def distance(angle):
            end = turned(np.array([28.0, 15.0]), np.array([0.0, 40.0]), 0.5 * angle)
            end = turned(end, np.array([0.0, 100.0]), angle)
            return float(np.linalg.norm(end - [30.0, 160.0]))

        angles = np.radians(np.arange(-20.0, 31.0, 5.0))
        found = np.array(self.arms(angles, [distance(a) for a in angles]))
        wanted = [-(distance(a + 1e-5) - distance(a - 1e-5)) / 2e-5 for a in angles]
        np.testing.assert_allclose(found, wanted, rtol=0.05)

    def test_is_the_slope_at_one_activation_and_none_while_it_changes(self):
        angles = np.radians(np.arange(0.0, 50.0, 5.0))
        active = np.array([0.0] * 4 + [0.3] + [0.6] * 5)
        lengths = 200.0 - 30.0 * angles - 25.0 * active
        path = [{"joint.bend": angle} for angle in angles]
        found = [arm.get("joint.bend") for arm in moment_arms(path, lengths, None, active)]
        assert found[4] is None
        assert [arm for arm in found if arm is not None] == pytest.approx([30.0] * 9)
        assert max(arm["joint.bend"] for arm in moment_arms(path, lengths)) > 60.0


class TestRows:
    @pytest.fixture
    def scene(self):
        mesh = rod()
        block = trimesh.creation.box((10, 10, 10))
        block.apply_translation([50, 0, -12])
        far = block.copy().apply_translation([500, 0, 0])
        bones = [Bone("trunk", block), Bone("limb", far)]
        frames = [{"joint.bend": a} for a in (0.0, 0.1, 0.2)]
        parts = {"bones": bones, "couplings": [], "joints": JOINTS, "muscles": [rod_muscle(mesh)]}
        parts |= {"guesses": [], "length": lambda millimetres: millimetres / 10.0}
        return SimpleNamespace(units="cm", motion=Motion(frames), **parts)

    def frame(self, scene, index):
        """The rod stretched by 10 cm a radian, the limb going with it."""
        angle = 0.1 * index
        pose = np.eye(4)
        pose[0, 3] = 10 * angle
        mesh = scene.muscles[0].mesh
        vertices = np.array(mesh.vertices) * [1 + 0.1 * angle, 1, 1]
        surface = ModelSurface(vertices, np.array(mesh.faces))
        poses = {"trunk": EYE, "limb": pose}
        carried = {"rod": (vertices, np.array(mesh.faces))}
        return Frame(index, {"joint.bend": angle}, poses, {"rod": surface}, carried, [], {}, 3.0)

    def test_rigid_motion_changes_nothing(self, scene):
        measures = MuscleMeasures(scene, {"rod": arrays(scene.muscles[0].mesh)})
        move = turned(1.1, (1, -2, 0.5), (3, 1, 4))
        move[:3, 3] += [1000, -2000, 500]
        frame = self.frame(scene, 0)
        moved = self.frame(scene, 0)
        moved.poses = {name: move @ pose for name, pose in moved.poses.items()}
        vertices = trimesh.transform_points(frame.surfaces["rod"].vertices, move)
        moved.surfaces = {"rod": ModelSurface(vertices, frame.surfaces["rod"].faces, {})}
        moved.material_meshes = {"rod": (vertices, frame.material_meshes["rod"][1])}
        before, after = (measures.measure(each)["rod"] for each in (frame, moved))
        for name in ("volume", "penetration_max", "penetration_fraction", "length", "components"):
            assert after[name] == pytest.approx(before[name], rel=1e-8)


def test_euler_of_sphere_torus_and_two_spheres():
    sphere, torus = trimesh.creation.icosphere(2), trimesh.creation.torus(3.0, 1.0)
    two = trimesh.util.concatenate([sphere, sphere.copy().apply_translation([5, 0, 0])])
    assert [euler_characteristic(mesh.faces) for mesh in (sphere, torus, two)] == [2, 0, 4]


def literal_crossings(vertices, faces):
    """Every edge against every triangle, one by one."""
    marked = np.zeros(len(faces), dtype=bool)
    volume = lambda a, b, c, d: np.linalg.det([b - a, c - a, d - a])  # noqa: E731
    for f, face in enumerate(faces):
        for g, other in enumerate(faces):
            if f == g or len({*face, *other}) < 5:
                continue
            for k in range(3):
                p, q = face[k], face[(k + 1) % 3]
                if p in other or q in other:
                    continue
                a, b, c, p, q = (vertices[i] for i in (*other, p, q))
                if volume(a, b, c, p) * volume(a, b, c, q) >= 0:
                    continue
                sides = {np.sign(volume(p, q, *pair)) for pair in ((a, b), (b, c), (c, a))}
                if sides in ({1.0}, {-1.0}):
                    marked[f] = marked[g] = True
    return marked


def test_crossings_are_those_of_a_literal_search():
    mesh = trimesh.creation.icosphere(1)
    rng = np.random.default_rng(3)
    vertices = mesh.vertices + 0.35 * rng.normal(size=mesh.vertices.shape)
    expected = literal_crossings(vertices, mesh.faces)
    assert 0 < expected.sum() < len(expected)
    np.testing.assert_array_equal(crossing_faces(vertices, mesh.faces), expected)


@pytest.mark.slow  # sixteen poses of the real hip, solved anew
def test_moment_arms_of_the_real_hip_have_the_right_signs_and_sum(hip_scene):
    """Gluteus maximus and medius extend, the iliacus flexes; the adductor brevis flexes first, then
    extends.
    """
    wanted = dict.fromkeys(("gluteus_maximus", "gluteus_medius"), (-1, -1))
    wanted |= {"iliacus": (1, 1), "adductor_brevis": (1, -1)}
    scene = hip_scene.with_options()
    scene.muscles = [scene.muscle(name) for name in wanted]
    made = simulate(scene, settings={"output.surfaces": False}, frames="0:46:3")
    angle = np.array([frame.coordinates["hip.flexion"] for frame in made.frames])
    for muscle, signs in wanted.items():
        length, arm = made.values(muscle, "length"), made.values(muscle, "moment_arm")
        assert tuple(np.sign([arm[0], arm[-1]])) == signs
        change = -np.cumsum(0.5 * (arm[1:] + arm[:-1]) * np.diff(angle))
        # By trapezia of 6 degrees.
        assert np.abs(length[1:] - length[0] - change).max() <= 0.01 * length[0]


def _arms(angles, values):
    return [
        Row(k, "knee", float(a), "m", "moment_arm", float(v), "mm")
        for k, (a, v) in enumerate(zip(angles, values))
    ]


@pytest.mark.parametrize("step", [1.0, 2.0, 10.0])
def test_a_moment_arm_jumps_where_its_slope_does_not_where_it_is_steep(step):
    angles = np.arange(0.0, 91.0, step)
    steep = _smoothness(_arms(angles, 60.0 - 2.0 * angles), guessed=False)
    assert {row.quantity for row in steep} == {"moment_arm_jump"}
    assert max(row.value for row in steep) == pytest.approx(0.0, abs=1e-9)
    # A kink of 3 mm per degree at 40 degrees.
    kinked = _smoothness(_arms(angles, 3.0 * np.maximum(angles - 40.0, 0.0)), guessed=False)
    assert max(row.value for row in kinked) == pytest.approx(15.0)
    assert next(row for row in kinked if row.value > 1e-9).coordinate_value >= 40.0


@pytest.mark.parametrize(("step", "measured"), [(0.5, True), (2.0, True), (2.5, False)])
def test_roughness_is_the_second_difference_over_two_degrees_beyond_that_of_the_path(
    step, measured
):
    angles = np.arange(10.0, 40.0 + step / 2, step)
    arms = _arms(angles, np.zeros(len(angles)))
    # A length of curvature 0.03 per square degree with a step of 1 at 24, a path of 0.01.
    paths = {k: 0.005 * (a - 25.0) ** 2 for k, a in enumerate(angles)}
    lengths = {k: 0.015 * (a - 25.0) ** 2 + (a > 23.9) for k, a in enumerate(angles)}
    found = _roughness(arms, lengths, paths)
    assert bool(found) == measured
    if not measured:
        return
    by_name = {}
    for row in found:
        by_name.setdefault(row.quantity, []).append((row.coordinate_value, row.value))
    # Between frames lengths are interpolated, which is exact at multiples of these steps.
    smooth = [v for a, v in by_name["length_roughness"] if a < 21.5 or a > 26.5]
    assert smooth == pytest.approx([0.03 * 4.0] * len(smooth))
    assert [v for _, v in by_name["path_roughness"]] == pytest.approx(
        [0.01 * 4.0] * len(found[::3])
    )
    where, worst = max(by_name["roughness_beyond_path"], key=lambda row: row[1])
    assert 21.5 <= where <= 26.5 and worst == pytest.approx(0.12 + 1.0 - 0.04, abs=1e-9)
    assert min(a for a, _ in by_name["length_roughness"]) == 12.0
    # Of a path that is not known nothing is allowed.
    alone = _roughness(arms, lengths, dict.fromkeys(paths, np.nan))
    beyond = [row.value for row in alone if row.quantity == "roughness_beyond_path"]
    assert max(beyond) == pytest.approx(0.12 + 1.0)


def test_the_way_there_and_the_way_back_are_stretches_of_their_own():
    """Lengths fall by 2 per degree; the muscle is 5 longer on the way back."""
    scene = Scene("hinge", units="mm")
    for name in ("trunk", "limb"):
        scene.add_bone(name, trimesh.creation.box((1, 1, 1)))
    scene.add_joint("hinge", "trunk", "limb", (0, 0, 0), {"bend": (0, 0, 1)})
    angles = np.concatenate([np.arange(11.0), np.arange(9.0, -1.0, -1.0)])
    path = {k: {"hinge.bend": np.radians(a)} for k, a in enumerate(angles)}
    lengths = {k: 100.0 - 2.0 * a + 5.0 * (k > 10) for k, a in enumerate(angles)}
    none = {"shortest": {"m": dict.fromkeys(path, 90.0)}, "fibres": {}, "activations": {}}
    rows = moment_arm_rows(scene, path, lengths={"m": lengths}, **none)
    rough = [row for row in rows if row.quantity == "length_roughness"]
    # Second differences over 2 degrees, from 2 to 8 there and back.
    there, back = (
        [row.coordinate_value for row in rough if (row.frame > 10) == later] for later in (0, 1)
    )
    assert there == pytest.approx(np.arange(2.0, 9.0))
    assert back == pytest.approx(np.arange(2.0, 8.0))
    assert [row.value for row in rough] == pytest.approx([0.0] * len(rough), abs=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_a_moment_arm_is_judged_where_attachments_are_guessed(sign):
    arms = _arms(np.arange(0.0, 30.0, 2.0), sign * np.linspace(20.0, -9.0, 15))
    rows = _smoothness(arms, guessed=True)
    sides = [row.value for row in rows if row.quantity == "moment_arm_reversal"]
    # What this frame and those before show, of all but the first: the sign turns after the tenth.
    assert sides == pytest.approx([0.0] * 9 + [9.0 - k * 29.0 / 14.0 for k in (4, 3, 2, 1, 0)])
