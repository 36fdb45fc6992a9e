"""Models as they are found: roots, loops, weld constraints, names, joints and frames of every kind.

Where no hand calculation is named, numbers are those of OpenSim 4.6 for the same text.
"""

import math
import shutil

import numpy as np
import pytest
from command_line import call
from conftest import ROOT
from osim_text import (
    axis_joint,
    body,
    coordinate,
    joint,
    mesh,
    model,
    muscle,
    offset,
    pin,
    point,
)

import rbfmuscle as rm
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.scene import import_osim, write_imported
from rbfmuscle.scene.check import check_scene
from rbfmuscle.scene.joints import all_coordinates, joint_poses, rotation_about


@pytest.fixture
def read(tmp_path):
    """A reader of a model's text."""

    def reading(text):
        (tmp_path / "m.osim").write_text(text, encoding="utf-8")
        return read_osim(tmp_path / "m.osim")

    return reading


def turned(angle):
    return rotation_about((0.0, 0.0, 1.0), angle, np.zeros(3))[:3, :3]


def check_written(tmp_path, values):
    """The scene, written and loaded, has the model's poses at some values of its coordinates."""
    found = import_osim(tmp_path / "m.osim")
    scene = rm.Scene.load(write_imported(found, tmp_path / "scene"), skeleton=True)
    poses = joint_poses(found.model.bodies, scene.joints, scene.couplings, values)
    wanted = found.model.transforms(values)
    for name, place in found.places.items():
        np.testing.assert_allclose(poses[name] @ place, wanted[name], atol=1e-11, err_msg=name)


class TestRoots:
    knee = pin("knee", "upper", "lower", 0.5, "0 -0.4 0")

    def test_what_no_joint_joins_to_the_ground_is_a_root_of_its_own(self, read):
        found = read(model(["upper", "lower"], [self.knee]))
        places = found.transforms()
        np.testing.assert_allclose(places["upper"], np.eye(4))
        np.testing.assert_allclose(places["lower"][:3, 3], [0.0, -0.4, 0.0])
        np.testing.assert_allclose(places["lower"][:3, :3], turned(0.5))
        (doubt,) = found.doubts
        assert doubt.startswith("body 'upper' is joined to the ground by no joint")

    def test_the_root_is_the_body_that_is_no_child(self, read):
        knee = pin("knee", "lower", "upper", -0.5, "0 0 0", child_at="0 -0.4 0")
        found = read(model(["upper", "lower"], [knee]))
        place = found.transforms()["upper"]
        # By hand: 0.4 m up along the turned axis.
        np.testing.assert_allclose(
            place[:3, 3], [0.4 * math.sin(0.5), 0.4 * math.cos(0.5), 0.0], atol=1e-12
        )
        assert "body 'lower'" in found.doubts[0]

    def test_each_part_has_one_line_and_a_warning_of_check(self, read, tmp_path):
        tail = pin("root", "ground", "tail", 0.0, "0.2 0 0")
        read(model(["upper", "lower", "alone", "tail"], [self.knee, tail]))
        scene = rm.Scene.load(
            write_imported(import_osim(tmp_path / "m.osim"), tmp_path / "s"), skeleton=True
        )
        warned = [f.message for f in check_scene(scene) if f.level == "warning"]
        assert [message.split("'")[1] for message in warned] == ["upper", "alone"]
        check_written(tmp_path, {"knee.knee_q": 0.9, "root.root_q": -0.3})


def test_a_scene_in_which_no_bone_has_a_mesh_is_a_note_and_not_usable(read, tmp_path, capsys):
    read(model("a", [pin("p", "ground", "a")]))
    path = write_imported(import_osim(tmp_path / "m.osim"), tmp_path / "s")
    code, out, err = call(capsys, "check", path)
    assert code == 3 and out.count("note: m: no bone has a mesh") == 1
    assert "not usable" in err and "bug" not in err


class TestLoops:
    def test_a_loop_that_is_open_is_named_with_its_joints_and_gap(self, read):
        ring = [
            pin("one", "ground", "a"),
            pin("two", "a", "b", at="0.1 0 0"),
            pin("three", "b", "c", at="0.1 0 0"),
            pin("four", "c", "a", at="-0.15 0 0"),
        ]
        (doubt,) = read(model("abc", ring)).doubts
        assert "four (c to a) closes a loop with three, two: not taken" in doubt
        assert "its ends are 50 mm apart" in doubt
        assert "three.three_q, two.two_q may open it" in doubt

    def test_welds_that_say_the_same_are_a_note(self, read):
        ends = ("/ground", "/bodyset/a")
        welds = [joint("WeldJoint", name, ends, at=("0 1 0", "0 0 0")) for name in ("l", "r")]
        found = read(model("a", welds))
        assert not found.doubts
        assert "r (ground to a) closes a loop with l" in found.notes[0]
        assert "closed at rest" in found.notes[0]


FREE = "".join(coordinate(f"f{k}", v) for k, v in enumerate((0.1, 0.2, 0.3, 0.5, 0.6, 0.7)))


def weld(first, second, frames=""):
    return (
        f'<WeldConstraint name="wc"><socket_frame1>{first}</socket_frame1>'
        f"<socket_frame2>{second}</socket_frame2><frames>{frames}</frames></WeldConstraint>"
    )


class TestWeldConstraints:
    def joints(self):
        hip = pin("p", "ground", "a", 0.4, "0 1 0")
        return [hip, joint("FreeJoint", "f", ("/ground", "/bodyset/b"), own=FREE)]

    def test_a_weld_holds_a_body_that_a_free_joint_leaves_free(self, read, tmp_path):
        text = model("ab", self.joints(), constraints=[weld("/bodyset/a", "/bodyset/b")])
        found = read(text)
        # The nearest values that meet it: both turns are the mean of 0.4 and 0.3.
        assert all_coordinates(found.joints)["p.p_q"].rest == pytest.approx(0.35, abs=1e-10)
        places = found.transforms()
        np.testing.assert_allclose(places["a"], places["b"], atol=1e-10)
        np.testing.assert_allclose(places["b"][:3, 3], [0.0, 1.0, 0.0], atol=1e-10)
        moved = found.transforms({"p_q": -0.6})
        np.testing.assert_allclose(moved["a"], moved["b"], atol=1e-10)
        assert not found.doubts and any("wc is taken as a fixed joint" in n for n in found.notes)
        check_written(tmp_path, {"p.p_q": -0.6})

    def test_frames_of_a_weld_are_offset(self, read):
        frames = offset("fa", "/bodyset/a", "0.1 -0.4 0.05", "0 0 0.2")
        frames += offset("fb", "/bodyset/b", "0 0.1 0")
        found = read(model("ab", self.joints(), constraints=[weld("fa", "fb", frames)]))
        assert all_coordinates(found.joints)["p.p_q"].rest == pytest.approx(0.306716193, abs=1e-9)
        place = found.transforms()["b"]
        np.testing.assert_allclose(place[:3, 3], [0.264635775, 0.561426609, 0.05], atol=1e-9)

    def bars(self, end):
        joints = [
            pin("one", "ground", "a", 0.3),
            pin("two", "a", "b", 0.5, "0 -0.4 0"),
            pin("three", "b", "c", -0.4, "0 -0.4 0"),
        ]
        frames = offset("fa", "/ground", end, "0 0 0.3") + offset("fb", "/bodyset/c")
        return model("abc", joints, constraints=[weld("fa", "fb", frames)])

    def test_a_loop_is_closed_at_rest_and_what_may_open_it_is_named(self, read):
        found = read(self.bars("0.2 -0.7 0"))
        place = found.transforms()["c"]
        np.testing.assert_allclose(place[:3, 3], [0.2, -0.7, 0.0], atol=1e-9)
        np.testing.assert_allclose(place[:3, :3], turned(0.3), atol=1e-9)
        (doubt,) = found.doubts
        assert "one.one_q, two.two_q, three.three_q may open it" in doubt

    def test_what_cannot_be_met_is_doubtful_and_changes_nothing(self, read):
        found = read(self.bars("0.2 -0.9 0"))
        assert all_coordinates(found.joints)["one.one_q"].rest == 0.3
        (doubt,) = found.doubts
        assert "wc (ground to c) cannot be met" in doubt

    def test_other_constraints_name_what_depends_on_them(self, read):
        rod = (
            "<ConstantDistanceConstraint><socket_body_1>/bodyset/a</socket_body_1>"
            "<socket_body_2>/bodyset/b</socket_body_2></ConstantDistanceConstraint>"
        )
        joints = [pin("p", "ground", "a"), pin("k", "a", "b")]
        (doubt,) = read(model("ab", joints, constraints=[rod])).doubts
        assert doubt == "ConstantDistanceConstraint (a to b) is not taken; k.k_q may break it"


def coupler(target, of):
    return (
        "<CoordinateCouplerConstraint><coupled_coordinates_function><LinearFunction>"
        "<coefficients>2 0.1</coefficients></LinearFunction></coupled_coordinates_function>"
        f"<independent_coordinate_names>{of}</independent_coordinate_names>"
        f"<dependent_coordinate_name>{target}</dependent_coordinate_name>"
        "</CoordinateCouplerConstraint>"
    )


def test_couplers_of_couplers_follow_and_a_ring_of_them_is_doubtful(read):
    joints = [pin("i", "ground", "a"), pin("j", "a", "b"), pin("k", "b", "c")]
    chain = [coupler("k_q", "j_q"), coupler("j_q", "i_q")]
    found = read(model("abc", joints, constraints=chain))
    values = found.resolved({"i_q": 0.2})
    assert values["j.j_q"] == pytest.approx(0.5) and values["k.k_q"] == pytest.approx(1.1)
    found = read(model("abc", joints, constraints=[*chain, coupler("i_q", "k_q")]))
    assert len(found.couplings) == 2
    assert "the coupler of i.i_q to k.k_q is not taken" in found.doubts[0]


AT = ("1 2 3", "0.1 0.2 0.3")
CHILD = ("0.01 0.02 0.03", "0.3 0.1 -0.2")
THREE = [coordinate("x", 0.3), coordinate("y", -0.4), coordinate("z", 0.7)]
SURFACES = {
    "EllipsoidJoint": (
        3,
        "<radii_x_y_z>0.1 0.2 0.3</radii_x_y_z>",
        [1.056091693, 1.903556782, 3.22771438],
        [0.4187406, -0.8096857, -0.4111756],
    ),
    "ScapulothoracicJoint": (
        4,
        "<thoracic_ellipsoid_radii_x_y_z>0.1 0.2 0.3</thoracic_ellipsoid_radii_x_y_z>"
        "<scapula_winging_axis_origin>0.03 -0.02</scapula_winging_axis_origin>"
        "<scapula_winging_axis_direction>0.4</scapula_winging_axis_direction>",
        [1.107336128, 1.895363978, 3.209921072],
        [0.3704862, -0.8706375, 0.3236207],
    ),
    "ConstantCurvatureJoint": (
        3,
        "<neutral_angle_x_z_y>0.1 0.2 0.3</neutral_angle_x_z_y><length>0.7</length>",
        [0.873750464, 2.625269208, 3.207580519],
        [0.3568866, -0.3259788, 0.8754255],
    ),
}


@pytest.mark.parametrize("kind", SURFACES)
def test_joints_over_surfaces_are_opensims(read, tmp_path, kind):
    count, more, origin, row = SURFACES[kind]
    own = "".join([*THREE, coordinate("w", 0.25)][:count])
    ends = ("/ground", "/bodyset/a")
    text = model("a", [joint(kind, "e", ends, own=own, more=more, at=AT, child=CHILD)])
    place = read(text).transforms()["a"]
    np.testing.assert_allclose(place[:3, 3], origin, atol=2e-9)
    np.testing.assert_allclose(place[0, :3], row, atol=1e-7)
    check_written(tmp_path, {"e.x": 0.1, "e.y": 0.2, "e.z": -0.5})


def test_arc_has_its_length_and_ends_along_its_own_axis(read):
    # By hand: an arc of length 0.7 bent by 1 rad about x, from along y towards z.
    own = coordinate("x", 1.0) + coordinate("y") + coordinate("z")
    ends = ("/ground", "/bodyset/a")
    text = model(
        "a", [joint("ConstantCurvatureJoint", "e", ends, own=own, more="<length>0.7</length>")]
    )
    place = read(text).transforms()["a"]
    wanted = [0.0, 0.7 * math.sin(1.0), 0.7 * (1.0 - math.cos(1.0))]
    np.testing.assert_allclose(place[:3, 3], wanted, atol=1e-12)


SUM = (
    '<MultivariatePolynomialFunction name="function"><dimension>2</dimension><order>2</order>'
    "<coefficients>0.1 1 2 0.3 0.4 0.5</coefficients></MultivariatePolynomialFunction>"
)
FUNCTIONS = {
    "rotation1": ("q", "<function/>"),
    "rotation2": ("r", "<function></function>"),
    "translation2": ("q r", SUM),
}


def test_polynomials_of_several_coordinates_and_empty_functions(read, tmp_path):
    own = coordinate("q", 0.5) + coordinate("r", -0.3)
    found = read(model("a", [axis_joint("c", "ground", "a", FUNCTIONS, own)]))
    # By hand: 0.1 + r + 2 r^2 + 0.3 q + 0.4 q r + 0.5 q^2; an empty function is the coordinate.
    place = found.transforms()["a"]
    assert place[1, 3] == pytest.approx(0.195, abs=1e-12)
    np.testing.assert_allclose(
        place[:3, :3], turned(0.5) @ rotation_about((0, 1, 0), -0.3, np.zeros(3))[:3, :3]
    )
    check_written(tmp_path, {"c.q": 0.2, "c.r": 0.4})


def test_a_polynomial_of_zeros_moves_nothing(read, tmp_path):
    functions = FUNCTIONS | {"translation2": ("q r", SUM.replace("0.1 1 2 0.3 0.4 0.5", "0 " * 6))}
    own = coordinate("q", 0.5) + coordinate("r", -0.3)
    found = read(model("a", [axis_joint("c", "ground", "a", functions, own)]))
    assert found.transforms()["a"][1, 3] == 0.0
    check_written(tmp_path, {"c.q": 0.2, "c.r": 0.4})


def test_an_axis_without_a_function_moves_nothing(read):
    functions = {"rotation1": ("q", ""), "rotation2": ("r", "<function/>")}
    own = coordinate("q", 0.5) + coordinate("r", -0.3)
    found = read(model("a", [axis_joint("c", "ground", "a", functions, own)]))
    assert list(all_coordinates(found.joints)) == ["c.r"]
    assert found.notes == ["coordinate 'q' moves nothing: it is left out"]


class TestNames:
    def test_equal_coordinate_names_of_two_joints_are_two(self, read):
        ends = ("/ground", "/bodyset/a"), ("/bodyset/a", "/bodyset/b")
        joints = [
            joint("PinJoint", name, pair, own=coordinate("q", value))
            for name, pair, value in zip("jk", ends, (0.3, 0.5))
        ]
        found = read(model("ab", joints, constraints=[]))
        np.testing.assert_allclose(found.transforms()["b"][:3, :3], turned(0.8), atol=1e-12)
        assert list(all_coordinates(found.joints)) == ["j.q", "k.q"]

    def test_joints_without_names_or_coordinates_have_opensims(self, read):
        ends = ("/ground", "/bodyset/a"), ("/bodyset/a", "/bodyset/b")
        joints = [joint("PinJoint", "", ends[0]), joint("FreeJoint", "", ends[1])]
        again = joint("PinJoint", "", ("/ground", "/bodyset/c"), at=("1 0 0", "0 0 0"))
        found = read(model("abc", [*joints, again]))
        names = ["pinjoint._coord_0", *(f"freejoint._coord_{k}" for k in range(6))]
        assert list(all_coordinates(found.joints)) == [*names, "pinjoint_0._coord_0"]
        np.testing.assert_allclose(found.transforms()["c"][:3, 3], [1.0, 0.0, 0.0])

    def test_coordinates_left_out_of_a_custom_joint_are_those_of_its_axes(self, read):
        found = read(model("a", [axis_joint("c", "ground", "a", FUNCTIONS)]))
        assert list(all_coordinates(found.joints)) == ["c.q", "c.r"]

    def test_names_in_other_scripts_stay_apart(self, read, tmp_path):
        joints = [pin("髋", "ground", "股骨", 0.3), pin("膝", "股骨", "胫骨", 0.5, "0 1 0")]
        found = read(model(["股骨", "胫骨"], joints))
        assert found.bodies == ["ground", "u80a1u9aa8", "u80ebu9aa8"]
        assert "'股骨' as u80a1u9aa8" in found.notes[0]
        place = found.transforms()["u80ebu9aa8"]
        np.testing.assert_allclose(place[:3, :3], turned(0.8), atol=1e-12)
        file = tmp_path / "m.mot"
        file.write_text("inDegrees=no\nendheader\ntime 髋_q 膝_q\n0 0.1 0.2\n", encoding="utf-8")
        scene = import_osim(tmp_path / "m.osim").scene
        scene.set_motion(file=str(file))
        assert list(scene.motion.frames[0].values()) == [0.1, 0.2]

    def test_bodies_and_joints_among_the_components_are_taken(self, read):
        parts = body("z") + joint(
            "PinJoint", "zz", ("/bodyset/a", "/z"), own=coordinate("q", 0.3), at=("0 0 3", "0 0 0")
        )
        text = model("a", [pin("p", "ground", "a", 0.1)], first=f"<components>{parts}</components>")
        place = read(text).transforms()["z"]
        np.testing.assert_allclose(place[:3, 3], [0.0, 0.0, 3.0])
        np.testing.assert_allclose(place[:3, :3], turned(0.4), atol=1e-12)


def stations(owner="/bodyset/a"):
    places = {"sa": "0.1 0 0.2", "sb": "0.1 0.5 0.3", "sc": "-0.3 0.1 0.1", "so": "0.05 0.05 0.05"}
    made = "".join(
        f'<Station name="{name}"><socket_parent_frame>..</socket_parent_frame>'
        f"<location>{at}</location></Station>"
        for name, at in places.items()
    )
    sockets = {"point_a": "sa", "point_b": "sb", "point_c": "sc", "origin_point": "so"}
    sockets = "".join(f"<socket_{k}>{owner}/{v}</socket_{k}>" for k, v in sockets.items())
    return made + (
        '<StationDefinedFrame name="sdf"><ab_axis>-y</ab_axis><ab_x_ac_axis>+z</ab_x_ac_axis>'
        f"{sockets}</StationDefinedFrame>"
    )


def test_frames_through_stations_are_opensims(read):
    first = body("a", f"<components>{stations()}</components>")
    knee = joint(
        "PinJoint",
        "k",
        ("/bodyset/a/sdf", "/bodyset/b"),
        own=coordinate("w", 0.2),
        at=("0 0.3 0", "0 0 0"),
    )
    found = read(model([first, "b"], [pin("p", "ground", "a", 0.2), knee]))
    place = found.transforms()["b"]
    np.testing.assert_allclose(place[:3, 3], [0.097513254, -0.229373509, -0.008834841], atol=1e-9)
    np.testing.assert_allclose(place[0, :3], [-0.8935593, 0.379907, -0.2392122], atol=1e-7)


LONG = [point("a", "a", "0.05 -0.1 0"), point("b", "b", "0.05 -0.2 0")]


class TestMuscles:
    joints = (pin("p", "ground", "a"), pin("k", "a", "b", 0.5, "0 -0.4 0"))

    def test_numbers_come_from_the_defaults_of_the_file_then_opensims(self, read):
        given = "<max_isometric_force>200</max_isometric_force>"
        forces = [muscle("m", LONG, more=given)]
        (one,) = read(model("ab", self.joints, forces=forces)).muscles
        assert one.volume == pytest.approx(200.0 * 0.1 / 61e4)
        first = (
            "<defaults><Thelen2003Muscle><optimal_fiber_length>0.33</optimal_fiber_length>"
            "</Thelen2003Muscle></defaults>"
        )
        (one,) = read(model("ab", self.joints, forces=forces, first=first)).muscles
        assert one.volume == pytest.approx(200.0 * 0.33 / 61e4)

    def test_points_of_old_versions_are_read(self, read):
        points = (
            '<MusclePoint name="a"><body>a</body><location>0.05 -0.1 0</location></MusclePoint>'
            '<MusclePoint name="b"><body>b</body><location>0.05 -0.2 0</location></MusclePoint>'
        )
        old = (
            '<Thelen2003Muscle name="m"><MusclePointSet><objects>'
            f"{points}</objects></MusclePointSet></Thelen2003Muscle>"
        )
        (one,) = read(model("ab", self.joints, forces=[old])).muscles
        assert [owner for owner, _ in one.points] == ["a", "b"]

    def test_a_path_of_points_and_obstacles_is_read(self, read):
        def element(owner, at):
            inner = point("pathpoint", owner, at)
            return f"<Scholz2015GeometryPathPoint>{inner}</Scholz2015GeometryPathPoint>"

        obstacle = (
            "<Scholz2015GeometryPathObstacle><socket_contact_geometry>/contactgeometryset/c"
            "</socket_contact_geometry><contact_hint>0 -0.05 0</contact_hint>"
            "</Scholz2015GeometryPathObstacle>"
        )
        elements = element("a", "0.05 -0.1 0") + obstacle + element("b", "0.05 -0.2 0")
        force = (
            '<Millard2012EquilibriumMuscle name="m"><Scholz2015GeometryPath name="path">'
            f"<path_elements>{elements}</path_elements></Scholz2015GeometryPath>"
            "</Millard2012EquilibriumMuscle>"
        )
        round_ = (
            '<ContactGeometrySet><objects><ContactCylinder name="c"><socket_frame>/bodyset/b'
            "</socket_frame><location>0 0.1 0</location><radius>0.05</radius></ContactCylinder>"
            "</objects></ContactGeometrySet>"
        )
        (one,) = read(model("ab", self.joints, forces=[force], more=round_)).muscles
        assert [owner for owner, _ in one.points] == ["a", "b"]
        (wrap,) = one.wraps
        assert (wrap.body, wrap.kind, wrap.quadrant) == ("b", "WrapCylinder", "-y")
        np.testing.assert_allclose(wrap.frame[:3, 3], [0.0, 0.1, 0.0])
        np.testing.assert_allclose(wrap.radii[:2], 0.05)

    def test_what_cannot_be_read_is_one_line_with_type_and_name(self, read, tmp_path):
        forces = [
            '<Millard2012EquilibriumMuscle name="f"><FunctionBasedPath/>'
            "</Millard2012EquilibriumMuscle>",
            '<Thelen2003Muscle name="bare"/>',
            muscle("gone", [point("a", "nobody", "0 0 0"), LONG[1]]),
            muscle("spring", LONG, kind="PathSpring"),
            muscle("flat", LONG, more="<optimal_fiber_length>0</optimal_fiber_length>"),
            muscle("short", [LONG[0], point("b", "a", "0 0 0")]),
        ]
        found = read(model("ab", self.joints, forces=forces))
        doubts = import_osim(tmp_path / "m.osim").scene.doubts
        for title, words in {
            "Millard2012EquilibriumMuscle 'f'": "FunctionBasedPath gives its length and no points",
            "Thelen2003Muscle 'bare'": "it has no path",
            "Thelen2003Muscle 'gone'": "there is no frame '/bodyset/nobody'",
            "Thelen2003Muscle 'flat'": "it has no volume",
            "Thelen2003Muscle 'short'": "does not go from one moving body to another",
        }.items():
            (line,) = [doubt for doubt in doubts if doubt.startswith(f"{title} is not taken")]
            assert words in line
        assert found.notes == ["PathSpring is no muscle: spring not taken"]

    def cylinder(self, name, at):
        return (
            f'<WrapObjectSet><objects><WrapCylinder name="{name}"><translation>{at}</translation>'
            "<radius>0.02</radius><length>0.2</length></WrapCylinder></objects></WrapObjectSet>"
        )

    def test_wraps_are_those_of_their_owner_or_the_first_as_in_opensim(self, read):
        bodies = [
            body("a", self.cylinder("w", "0.1 0 0")),
            body("b", self.cylinder("w", "0.2 0 0")),
        ]
        forces = [muscle(name, LONG, wraps=[name]) for name in ("w", "/bodyset/b/w", "b/w")]
        found = read(model(bodies, self.joints, forces=forces))
        assert [one.wraps[0].body for one in found.muscles] == ["a", "b", "b"]
        assert (
            sum("2 wrapping objects are named 'w': the first, on a" in n for n in found.notes) == 1
        )

    def test_wraps_on_offset_frames_are_placed(self, read):
        frame = offset("o", "..", "0 -0.1 0", "0 0 1.5707963267948966")
        frame = frame.replace("</PhysicalOffsetFrame>", self.cylinder("w", "0.1 0 0") + "</Physi")
        frame = frame.replace("</Physi", "</PhysicalOffsetFrame>")
        bodies = [body("a", f"<components>{frame}</components>"), "b"]
        (one,) = read(model(bodies, self.joints, forces=[muscle("m", LONG, wraps=["w"])])).muscles
        # By hand: 0.1 along the frame's x, which is the body's y.
        np.testing.assert_allclose(one.wraps[0].frame[:3, 3], [0.0, 0.0, 0.0], atol=1e-12)
        assert one.wraps[0].body == "a"

    def test_a_body_without_a_mesh_is_held_by_the_one_that_it_is_welded_to(self, read, tmp_path):
        (tmp_path / "wedge.obj").write_text(
            (ROOT / "tests" / "data" / "wedge.obj").read_text(encoding="utf-8")
        )
        fixed = joint("WeldJoint", "w", ("/bodyset/b", "/bodyset/c"), at=("0 -0.1 0", "0 0 0"))
        points = [point("a", "a", "0.05 -0.1 0"), point("c", "c", "0.05 -0.1 0")]
        bodies = [body("a", mesh()), body("b", mesh()), "c"]
        read(model(bodies, [*self.joints, fixed], forces=[muscle("m", points)]))
        scene = import_osim(tmp_path / "m.osim").scene
        (one,) = scene.muscles
        assert sorted(held.bone for held in one.attachments) == ["a", "b"]
        assert not scene.doubts


def test_joints_of_one_name_keep_their_own_frames(read):
    """Their frames have equal paths in the file: the second joint would take the first's place."""
    joints = [pin("one", "ground", "a", 0.0, "0.1 0.2 0.3"), pin("one", "a", "b", 0.5, "0 -0.4 0")]
    found = read(model("ab", joints))
    place = found.transforms()["b"]
    np.testing.assert_allclose(place[:3, 3], [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(place[:3, :3], turned(0.5), atol=1e-12)
    assert found.notes == ["another joint is named 'one' too: it is 'one_0' here"]
    assert not found.doubts


class TestWhatIsSaid:
    """Each stands in one line of the import, and so in the scene."""

    def changed(self, tmp_path, *pairs):
        for name in ("muscles.osim", "wedge.obj"):
            shutil.copy(ROOT / "tests" / "data" / name, tmp_path)
        path = tmp_path / "muscles.osim"
        text = path.read_text(encoding="utf-8")
        for before, after in pairs:
            assert before in text
            text = text.replace(before, after, 1)
        path.write_text(text, encoding="utf-8")
        return import_osim(path)

    @pytest.mark.parametrize("version", ["50300", ""])
    def test_a_version_that_is_not_known(self, tmp_path, version):
        after = f' Version="{version}"' if version else ""
        found = self.changed(tmp_path, (' Version="40000"', after))
        (note,) = (note for note in found.notes if "version" in note)
        assert ("50300" if version else "no version") in note and len(found.scene.muscles) == 2

    @pytest.mark.parametrize("said", ["<appliesForce>false<", "<isDisabled>true<"])
    def test_a_muscle_that_is_switched_off_is_taken(self, tmp_path, said):
        tag = said.split(">")[0][1:]
        force = "<max_isometric_force>900"
        found = self.changed(tmp_path, (force, f"{said}/{tag}>{force}"))
        assert [muscle.name for muscle in found.scene.muscles] == ["hamstring", "vastus"]
        assert sum("'hamstring' is switched off" in note for note in found.notes) == 1
        assert not any("switched off" in note for note in self.changed(tmp_path).notes)

    @pytest.mark.parametrize("folder", ["C:\\Models\\Geometry\\", "/home/somebody/Geometry/"])
    def test_a_mesh_by_a_path_of_another_machine_is_the_one_of_its_name(self, tmp_path, folder):
        found = self.changed(tmp_path, ("wedge.obj", f"{folder}wedge.obj"))
        assert len(found.scene.bones) == 2
        (note,) = (note for note in found.notes if "was read from" in note)
        assert str(tmp_path / "wedge.obj") in note

    def test_numbers_in_brackets_are_numbers(self, tmp_path):
        at = "<location>0.04 -0.05 0.01"
        found = self.changed(tmp_path, (at, "<location>~[0.04,-0.05,0.01]"))
        assert found.model.muscles[1].points[0][1] == pytest.approx([0.04, -0.05, 0.01])
