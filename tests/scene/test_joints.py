"""Joints of every kind: functions, the table of kinds, rest poses, couplings, and the way to files
and back.
"""

import itertools
import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from toy_scene import held

from rbfmuscle.scene.check import check_scene
from rbfmuscle.scene.joints import (
    KINDS,
    Curve,
    JointTable,
    Linear,
    Polynomial,
    all_coordinates,
    coordinate_values,
    joint_row,
)
from rbfmuscle.scene.motion import bone_poses, step_angle, turned_angle
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import find_contact_pairs
from rbfmuscle.simulation.substeps import SubSteps
from rbfmuscle.validation import SceneError

BOX = trimesh.creation.box((10, 10, 10))
DEG = math.pi / 180
Q = {"axes": {"q": (1, 0, 0)}}
SPLINE = {"x": [-120, -60, 0, 10], "y": [3, 9, 5, 4]}


def turning(*more, **function):
    """A custom joint that turns by one function of q and further coordinates."""
    return {
        "type": "custom",
        "rotations": [{"axis": [1, 0, 0], "coordinates": ["q", *more], **function}],
    }


def pair(units="mm", **row):
    """Bone b on bone a by one joint ``j``."""
    scene = Scene("pair", units=units).add_bone("a", BOX).add_bone("b", BOX)
    return scene.add_joint("j", "a", "b", **{"centre": (3.0, -2.0, 5.0), **row})


def knee(**coordinate):
    """Rolls by a spline in one direction and glides by a polynomial in another."""
    return pair(
        type="custom",
        rotations=[{"axis": [0.1, 0.2, 1.0], "coordinates": ["q"]}],
        translations=[
            {"axis": [1, 0.2, -0.3], "coordinates": ["q"], "spline": SPLINE},
            {"axis": [0, 1, 0], "coordinates": ["q"], "polynomial": [0.001, -0.1, 7.0]},
        ],
        coordinates={"q": {"range": [-120, 10], **coordinate}},
    )


class TestFunctions:
    X, Y = (0.0, 0.7, 1.1, 2.0, 3.5), (1.0, -0.3, 0.4, 2.0, 1.0)

    def test_spline_of_a_cubic_is_that_cubic_and_goes_on_straight(self):
        cubic = np.poly1d([0.3, -1.0, 0.5, 2.0])
        mine = Curve(self.X, tuple(cubic(np.array(self.X))), degree=3)
        for q in np.linspace(0, 3.5, 50):
            assert mine(q) == pytest.approx(cubic(q), abs=1e-12)
        assert mine(-2.0) == pytest.approx(cubic(0.0) - 2.0 * cubic.deriv()(0.0), abs=1e-12)
        assert mine(5.0) == pytest.approx(cubic(3.5) + 1.5 * cubic.deriv()(3.5), abs=1e-12)

    @pytest.mark.parametrize(
        "function",
        [
            Linear((2.0,), 0.3),
            Polynomial((0.5, -1.0, 2.0)),
            Curve((-1.0, 0.5, 2.0), (1.0, 4.0, 2.0)),
            Curve((-1.0, 0.5, 2.0, 2.5), (1.0, 4.0, 2.0, 0.0), degree=3),
        ],
        ids=lambda f: type(f).__name__,
    )
    def test_other_units_change_the_numbers_only(self, function):
        other = function.rescaled([57.0], 1000.0)
        for q in np.linspace(-2, 3, 20):
            assert other(57.0 * q) == pytest.approx(1000.0 * function(q), rel=1e-12)


class TestKinds:
    @pytest.mark.parametrize("kind", sorted(set(KINDS) - {"custom", "weld"}))
    def test_each_coordinate_turns_or_shifts_along_its_axis(self, kind):
        turns, shifts = KINDS[kind]
        directions = [*turns, *shifts]
        scene = pair(type=kind, coordinates={f"q{k}": {} for k in range(len(directions))})
        centre = np.array([3.0, -2.0, 5.0])
        for k, axis in enumerate(directions):
            pose = bone_poses(scene, {f"j.q{k}": 0.4})["b"]
            if k < len(turns):
                assert pose[:3, :3] == pytest.approx(
                    Rotation.from_rotvec(0.4 * np.array(axis)).as_matrix()
                )
                assert pose[:3, :3] @ centre + pose[:3, 3] == pytest.approx(centre)
            else:
                assert pose[:3] == pytest.approx(np.column_stack([np.eye(3), 0.4 * np.array(axis)]))

    @pytest.mark.parametrize(
        ("kind", "axes"),
        [
            ("hinge", {"p": (0.3, -2.0, 0.7)}),
            ("universal", {"p": (0, 1, 0), "q": (1, 0, 0.2)}),
            ("ball", {"p": (0, 1, 0), "q": (1, 0, 0.2), "r": (0, 0.1, 1)}),
        ],
    )
    def test_kind_by_the_number_of_turns_is_that_kind_to_the_bit(self, kind, axes):
        """The last named turns first; the same by a custom joint."""
        q = dict(zip((f"j.{name}" for name in axes), (0.3, -0.5, 0.9)))
        turns = [{"axis": axis, "coordinates": [name]} for name, axis in axes.items()]
        rows = [{"axes": axes}, {"axes": axes, "type": kind}]
        rows.append({"type": "custom", "rotations": turns})
        first, *others = (bone_poses(pair(**row), q)["b"] for row in rows)
        assert all(np.array_equal(first, other) for other in others)
        assert pair(axes=axes).joints[0].kind == kind
        steps = [
            Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
            for angle, axis in zip(q.values(), axes.values())
        ]
        product = np.linalg.multi_dot([np.eye(3), *steps]) if len(steps) > 1 else steps[0]
        assert first[:3, :3] == pytest.approx(product, abs=1e-15)

    def test_six_turns_of_a_custom_joint(self):
        axes = np.random.default_rng(3).normal(size=(6, 3))
        turns = [{"axis": list(axis), "coordinates": [n]} for n, axis in zip("abcdef", axes)]
        scene = pair(type="custom", rotations=turns)
        pose = bone_poses(scene, {f"j.{n}": 0.1 * (k + 1) for k, n in enumerate("abcdef")})["b"]
        product = np.linalg.multi_dot(
            [
                Rotation.from_rotvec(0.1 * (k + 1) * axis / np.linalg.norm(axis)).as_matrix()
                for k, axis in enumerate(axes)
            ]
        )
        assert pose[:3, :3] == pytest.approx(product, abs=1e-14)

    def test_free_joint_is_body_fixed_turns_after_a_shift(self):
        scene = pair(type="free", coordinates={name: {} for name in "abcxyz"})
        q = {"j.a": 0.3, "j.b": -0.5, "j.c": 0.9, "j.x": 1.0, "j.y": 2.0, "j.z": 3.0}
        pose, centre = bone_poses(scene, q)["b"], np.array([3.0, -2.0, 5.0])
        assert pose[:3, :3] == pytest.approx(
            Rotation.from_euler("XYZ", [0.3, -0.5, 0.9]).as_matrix()
        )
        assert pose[:3, :3] @ centre + pose[:3, 3] == pytest.approx(centre + [1, 2, 3])

    @pytest.mark.parametrize(
        ("row", "message"),
        [
            (
                {"type": "hinge", "axes": {"p": (1, 0, 0), "q": (0, 1, 0)}},
                "a hinge joint has 1 coordinates, 2",
            ),
            (
                {"type": "custom", "axes": {"q": (1, 0, 0)}},
                "rotations and translations instead of axes",
            ),
            ({"type": "ball", "axes": {"q": (1, 0, 0)}}, "a ball joint has 3 coordinates, 1 are"),
            (
                {"axes": dict(zip("abcd", itertools.repeat((1, 0, 0))))},
                "give its type; without one, one to three axes",
            ),
            (
                {
                    "type": "custom",
                    "rotations": [{"axis": [1, 0, 0]}] * 5,
                    "translations": [{"axis": [1, 0, 0]}] * 2,
                },
                "at most 6 axes",
            ),
            (turning(linear=[1.0]), "linear needs a slope"),
            ({**Q, "coordinates": {"q": {"range": [3, 1]}}}, "range must go upwards"),
            (
                {**Q, "coordinates": {"q": {"motion": "translation"}}},
                "'q' is a rotation here, not a translation",
            ),
            ({**Q, "coordinates": {"p": {}}}, "coordinate 'p' moves nothing"),
            ({**Q, "coordinates": {"q": {"clamped": True}}}, "clamped needs a range"),
            (turning(spline={"x": [0, 1, 1], "y": [0, 1, 2]}), "x must increase"),
            (turning(piecewise={"x": [0, 1, 2], "y": [0, 1]}), "x has 3 values and y 2"),
            (
                turning(polynomial=[1, 2], constant=3),
                "give one function, not constant and polynomial",
            ),
            (turning("p", polynomial=[1, 2]), "polynomial is of 1 coordinate, 2 are given"),
        ],
    )
    def test_wrong_tables_are_named(self, row, message):
        with pytest.raises(SceneError, match=message):
            pair(**row)


class TestCoordinates:
    def test_rest_pose_may_be_any_pose(self):
        """Meshes scanned at 40 degrees: the motion from there is that of meshes moved there by a
        scene at 0.
        """
        zero, scanned = knee(), knee(rest=-40.0)
        assert np.array_equal(bone_poses(scanned, {})["b"], np.eye(4))
        assert np.array_equal(bone_poses(scanned, {"j.q": -40 * DEG})["b"], np.eye(4))
        start = bone_poses(zero, {"j.q": -40 * DEG})["b"]
        for angle in (-110.0, -40.0, -3.0, 0.0, 15.0):
            want = bone_poses(zero, {"j.q": angle * DEG})["b"] @ np.linalg.inv(start)
            assert bone_poses(scanned, {"j.q": angle * DEG})["b"] == pytest.approx(want, abs=1e-12)

    def test_locks_ranges_and_couplings_are_honoured(self):
        held = {"p": {"range": [-10, 20], "clamped": True}, "q": {"locked": True, "rest": 0.0}}
        scene = pair(type="universal", axes={"p": (1, 0, 0), "q": (0, 1, 0)}, coordinates=held)
        moved = bone_poses(scene, {"j.p": 90 * DEG, "j.q": 1.0})["b"]
        assert moved == pytest.approx(bone_poses(scene, {"j.p": 20 * DEG})["b"])

    def test_couplings_follow_each_other_in_any_order(self):
        scene = (
            Scene("s").add_bone("a", BOX).add_bone("b", BOX).add_bone("c", BOX).add_bone("d", BOX)
        )
        for name, bone in zip("xyz", "bcd"):
            scene.add_joint(name, "a", bone, (0, 0, 0), {name: (0, 0, 1)})
        scene.add_coupling("z", ["y"], linear=[2.0, 1.0])
        scene.add_coupling("y", ["x"], polynomial=[0.005, 0.0, 0.0])
        poses = bone_poses(scene, {"x.x": 20 * DEG})
        assert turned_angle(poses["c"][:3, :3]) == pytest.approx(2.0 * DEG)
        assert turned_angle(poses["d"][:3, :3]) == pytest.approx(
            4.0 * DEG
        )  # 5, of which 1 is at rest
        assert coordinate_values({}, all_coordinates(scene.joints), scene.couplings)[
            "z.z"
        ] == pytest.approx(1.0 * DEG)
        with pytest.raises(SceneError, match="follows itself"):
            scene.add_coupling("x", ["z"])
        with pytest.raises(SceneError, match="follows other coordinates"):
            scene.set_motion(ramp={"z": {"to": 3, "step": 1}})

    def test_leaving_a_range_is_reported(self):
        scene = knee().set_motion(ramp={"q": {"from": 0, "to": 20, "step": 5}})
        (note,) = scene.motion.notes
        assert "'j.q' leaves its range -120 to 10 in 2 of 5 frames, by up to 10" in note
        assert any(note in str(finding) for finding in check_scene(scene))

    def test_rows_make_the_same_joint_again(self):
        scenes = [
            knee(rest=-33.3),
            pair(axes={"flexion": (-1, 0, 0), "turn": (0.2, 0.3, 0.9)}),
            pair(type="custom", rotations=[{"axis": (0, 0, 1), "coordinates": ["q"]}] * 4),
            pair(type="planar", coordinates={"r": {"rest": 3.0}, "x": {}, "y": {"rest": 2.5}}),
            pair(type="weld", centre=None),
            pair(axes={"q": (0, 0, 1)}, backward=True),
        ]
        for scene in scenes:
            again = JointTable.build(joint_row(scene.joints[0]), context="").joint()
            other = Scene("other").add_bone("a", BOX).add_bone("b", BOX).add_joint(again)
            names = again.coordinates
            q = {f"j.{name}": 0.1 * (k + 1) for k, name in enumerate(names)}
            assert bone_poses(other, q)["b"] == pytest.approx(bone_poses(scene, q)["b"], abs=1e-13)
            given = scene.joints[0].coordinates
            assert [c.rest for c in names.values()] == pytest.approx(
                [c.rest for c in given.values()]
            )

    def test_a_pure_shift_is_cut_into_steps_and_reached(self):
        mesh = trimesh.creation.icosphere(subdivisions=2).apply_scale([30, 4, 4])
        scene = pair(centre=(0, 0, 0), type="slide", axes={"s": (1, 0, 0)})
        x = mesh.vertices[:, 0]
        scene.add_muscle("m", mesh, attach=held(a=x < -20, b=x > 20))
        scene.motion = Motion([{"j.s": 0.0}, {"j.s": 40.0}])
        stops = SubSteps(scene).split({"j.s": 0.0}, {"j.s": 40.0})
        values = [0.0, *(stop["j.s"] for stop in stops)]
        assert (
            values[-1] == 40.0
            and max(b - a for a, b in itertools.pairwise(values)) < 60 / 27 * 1.01
        )
        box = find_contact_pairs(scene)["m", "b"]
        assert box[0, 0] <= -70.0 + 1e-9  # seen from b, the muscle's other end is 40 further away


def test_step_angle_counts_turns_and_shifts():
    scene = knee()
    turn = step_angle(scene, {"j.q": 0.0}, {"j.q": -0.1}, shifts=False)
    assert turn == pytest.approx(0.1, rel=1e-9)
    slide = pair(type="slide", axes={"s": (0, 1, 0)})
    assert step_angle(slide, {}, {"j.s": 5.0}) == pytest.approx(0.1)
