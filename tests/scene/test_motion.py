"""Ramps, waypoints, OpenSim files, and the poses that they give."""

import math

import numpy as np
import pytest
import trimesh

from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.phantom import MUSCLES, Tube
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import SceneError, UsageError

BOX = trimesh.creation.box((10, 10, 10))


def chain():
    """Three bones: b turns against a about z and x, c against b about y."""
    scene = Scene("chain")
    for name in "abcd":
        scene.add_bone(name, BOX)
    scene.add_joint("one", "a", "b", (10, 0, 0), {"turn": (0, 0, 2), "roll": (1, 0, 0)})
    scene.add_joint("two", "b", "c", (20, 0, 0), {"bend": (0, 1, 0)})
    return scene


def degrees(scene, name):
    return [math.degrees(frame[name]) for frame in scene.motion.frames]


class TestFrames:
    def test_ramp_ends_exactly_and_several_coordinates_go_together(self):
        scene = chain().set_motion(ramp={"one.turn": {"from": 0, "to": 25, "step": 10}})
        assert degrees(scene, "one.turn") == pytest.approx([0, 10, 20, 25])
        ramp = {"one.turn": {"to": 40, "step": 10}, "bend": {"to": -10, "step": 5}}
        scene = chain().set_motion(ramp=ramp)
        assert degrees(scene, "one.turn") == pytest.approx([0, 10, 20, 30, 40])
        assert degrees(scene, "two.bend") == pytest.approx([0, -2.5, -5, -7.5, -10])
        assert scene.motion.coordinates == ["one.turn", "two.bend"]

    def test_waypoints_there_and_back_hold_what_they_do_not_mention(self):
        stops = [{"one.turn": 0, "two.bend": 5}, {"one.turn": 10}, {"one.turn": 0}]
        scene = chain().set_motion(waypoints=stops, step=5)
        assert degrees(scene, "one.turn") == pytest.approx([0, 5, 10, 5, 0])
        assert degrees(scene, "two.bend") == pytest.approx([5] * 5)

    def test_slices(self):
        scene = chain().set_motion(ramp={"one.turn": {"to": 40, "step": 10}})
        assert degrees(scene.with_options(frames="1::2"), "one.turn") == pytest.approx([10, 30])
        assert len(scene.with_options(frames="-1").motion) == 1
        with pytest.raises(UsageError, match="none of the 5 frames"):
            scene.with_options(frames="7:9")


class TestOpenSimFile:
    TEXT = (
        "motion\nnRows=2\nnColumns=3\ninDegrees={flag}\nendheader\n"
        "time\tbend\t/jointset/one/turn/value\n"
    )

    def write(self, tmp_path, rows, flag="yes"):
        path = tmp_path / "walk.mot"
        path.write_text(self.TEXT.format(flag=flag) + rows)
        return path

    def test_degrees_and_radians(self, tmp_path):
        self.write(tmp_path, "0 10 20\n0.1 11 21\n")
        scene = chain().set_motion(file=tmp_path / "walk.mot")
        assert degrees(scene, "two.bend") == pytest.approx([10, 11])
        assert degrees(scene, "one.turn") == pytest.approx([20, 21])
        self.write(tmp_path, "0 0.5 1\n", flag="no")
        frames = chain().set_motion(file=tmp_path / "walk.mot").motion.frames
        assert frames == [{"two.bend": 0.5, "one.turn": 1.0}]

    def notes(self, tmp_path, rows, flag="yes", **changed):
        path = self.write(tmp_path, rows, flag)
        for before, after in changed.items():
            path.write_text(path.read_text(encoding="utf-8").replace(before, after, 1))
        return chain().set_motion(file=tmp_path / "walk.mot").motion.notes

    def test_a_whole_file_has_no_notes(self, tmp_path):
        assert not self.notes(tmp_path, "0 10 20\n0.1 11 21\n")

    def test_columns_of_no_coordinate_are_named_in_one_line(self, tmp_path):
        (note,) = self.notes(tmp_path, "0 10 20\n0.1 11 21\n", bend="knee.activation")
        assert note.endswith("columns of no coordinate of the scene are not used: knee.activation")

    def test_a_column_that_several_joints_have_names_them(self, tmp_path):
        self.write(tmp_path, "0 10 20\n0.1 11 21\n")
        scene = chain().add_joint("three", "c", "d", (30, 0, 0), {"bend": (0, 1, 0)})
        (note,) = scene.set_motion(file=tmp_path / "walk.mot").motion.notes
        assert note.endswith("are not used: bend (of two.bend or three.bend)")

    def test_rows_that_are_missing_are_counted(self, tmp_path):
        (note,) = self.notes(tmp_path, "0 10 20\n")
        assert "nRows says 2, 1 rows are there" in note
        (note,) = self.notes(tmp_path, "0 10 20\n0.1 11 21\n", nColumns="datacolumns=7\nwas")
        assert "nColumns says 7, 3 columns are there" in note

    def test_a_row_that_jumps_there_and_back_is_named(self, tmp_path):
        rows = "0 1 2\n1 2 2\n2 350 2\n3 4 2\n4 6 2\n"
        (note,) = self.notes(tmp_path, rows, nRows="row_s")
        assert "row 3: two.bend jumps 346 degrees from the rows before and after" in note
        # What only moves fast, or turns back, does not jump.
        assert not self.notes(tmp_path, "0 1 2\n1 40 2\n2 80 2\n3 40 2\n", nRows="row_s")

    def test_names_in_quotes_are_names(self, tmp_path):
        assert not self.notes(tmp_path, "0 10 20\n0.1 11 21\n", bend='"bend"')

    def test_times_that_do_not_increase_are_named(self, tmp_path):
        (note,) = self.notes(tmp_path, "0 1 2\n0.1 1 2\n0.1 2 3\n0.05 2 3\n", nRows="row_s")
        assert "2 times do not increase, the first after row 2, 0.1 and 0.1 s" in note

    def test_radians_that_can_only_be_degrees_are_questioned(self, tmp_path):
        (note,) = self.notes(tmp_path, "0 0 20\n0.1 1 60\n", flag="no")
        assert "one.turn reaches 60 radians, 9.55 turns: does the file mean degrees" in note
        assert not self.notes(tmp_path, "0 0 2\n0.1 1 6\n", flag="no")

    @pytest.mark.parametrize(
        ("rows", "words"),
        [
            ("0 1 2\n1 x 2\n", "row 2: bend is 'x'"),
            ("0,1 1 2\n", "row 1: time is '0,1', .* points"),
        ],
    )
    def test_text_among_numbers_is_named_with_row_and_column(self, tmp_path, rows, words):
        self.write(tmp_path, rows)
        with pytest.raises(SceneError, match=words):
            chain().set_motion(file=tmp_path / "walk.mot")

    @pytest.mark.parametrize("rows", ["0 1\n", "0 x 1\n", "0 nan 1\n", "", "\n"])
    def test_bad_rows(self, tmp_path, rows):
        self.write(tmp_path, rows)
        with pytest.raises(SceneError, match=r"walk\.mot"):
            chain().set_motion(file=tmp_path / "walk.mot")


def test_child_follows_its_parent_and_a_loose_bone_is_fixed():
    assert all(np.array_equal(pose, np.eye(4)) for pose in bone_poses(chain(), {}).values())
    poses = bone_poses(chain(), {"one.turn": 0.3, "one.roll": -0.8, "two.bend": 1.1})
    parent = rotation_about((0, 0, 1), 0.3, (10, 0, 0)) @ rotation_about(
        (1, 0, 0), -0.8, (10, 0, 0)
    )
    assert poses["b"] == pytest.approx(parent)
    assert poses["c"] == pytest.approx(parent @ rotation_about((0, 1, 0), 1.1, (20, 0, 0)))
    assert np.array_equal(poses["d"], np.eye(4))


class TestTube:
    def test_straight_tube_with_fullness_two_is_an_ellipsoid(self):
        line = ((0, 0, -30), (0, 1e-9, 0), (0, 0, 30))
        tube = Tube(points=line, radius=1, width=12, thickness=7, fullness=2)
        assert tube.volume == pytest.approx(4 / 3 * np.pi * 12 * 7 * 30)
        vertices, _, _ = tube.mesh(3.0)
        assert (vertices / [12, 7, 30])[:, 2].max() == pytest.approx(1)
        rim = np.linalg.norm(vertices / [12, 7, 30], axis=1)
        turned = np.linalg.norm(vertices / [7, 12, 30], axis=1)
        assert min(np.abs(rim - 1).max(), np.abs(turned - 1).max()) < 1e-9

    @pytest.mark.parametrize("name", MUSCLES)
    def test_mesh_volume_converges_to_the_closed_form(self, name):
        tube = MUSCLES[name]
        errors = []
        for spacing in (6.0, 3.0, 1.5):
            vertices, faces, _ = tube.mesh(spacing)
            mesh = trimesh.Trimesh(vertices, faces, process=False)
            assert mesh.is_watertight and mesh.euler_number == 2
            errors.append(1 - mesh.volume / tube.volume)
        assert 0 < errors[2] < 0.005  # an inscribed polyhedron, edges of 1.5 mm
        assert (
            errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3
        )  # second order, 4 in the limit
