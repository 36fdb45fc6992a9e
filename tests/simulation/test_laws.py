"""Laws of small parts: wherever things lie, however they turn, whatever they are called."""

import math
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.scene.check import (
    FAR_AWAY,
    FARTHEST_CENTRE,
    LARGEST_MM,
    SMALLEST_MM,
    check_centre,
    check_place,
    check_size,
)
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.scene.motion import turned_angle
from rbfmuscle.scene.objects import Bone
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.tunnelling import sweep_paths
from rbfmuscle.simulation.workers import Workers
from rbfmuscle.validation import MeshError, SceneError

UNITS = {"mm": 1.0, "cm": 0.1, "m": 1e-3}
SIDES = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]


@pytest.fixture(scope="module")
def bones():
    """Two cubes of 20 mm, 60 mm apart, off the origin: their box is 80 x 20 x 20."""
    scene = Scene("cubes", units="mm")
    for k, name in enumerate(("a", "b")):
        cube = trimesh.creation.box((20.0, 20.0, 20.0))
        cube.apply_translation([110.0 + 60.0 * k, -40.0, 30.0])
        scene.add_bone(name, cube)
    return scene, np.array([100.0, -50.0, 20.0]), np.array([180.0, -30.0, 40.0])


class TestPlaces:
    """However far, on whichever side: what is told is the distance from the box of all bones."""

    @pytest.mark.parametrize(("axis", "sign"), SIDES)
    @pytest.mark.parametrize("share", [0.98, 1.02])
    def test_muscle_is_refused_beyond_a_distance_that_counts_from_the_bones(self, bones, axis, sign, share):
        scene, low, high = bones
        away = share * FAR_AWAY * np.linalg.norm(high - low)
        ball = trimesh.creation.box((2.0, 2.0, 2.0))
        place = 0.5 * (low + high)
        place[axis] = high[axis] + away + 1.0 if sign > 0 else low[axis] - away - 1.0
        ball.apply_translation(place)
        if share < 1.0:
            check_place(scene, "ball", Bone("ball", ball))
            return
        with pytest.raises(MeshError, match=r"muscle 'ball'.*away from all bones") as error:
            check_place(scene, "ball", Bone("ball", ball))
        assert f"lies {away:.4g} mm away" in str(error.value)

    @pytest.mark.parametrize(("axis", "sign"), SIDES)
    @pytest.mark.parametrize("share", [0.98, 1.02])
    def test_centre_is_refused_beyond_a_distance_that_counts_from_the_bones(self, bones, axis, sign, share):
        scene, low, high = bones
        away = share * FARTHEST_CENTRE * np.linalg.norm(high - low)
        centre = 0.5 * (low + high)
        centre[axis] = high[axis] + away if sign > 0 else low[axis] - away
        if share < 1.0:
            check_centre(scene, "j", centre)
            return
        with pytest.raises(SceneError, match="joint 'j'") as error:
            check_centre(scene, "j", centre)
        assert f"lies {away:.4g} mm away" in str(error.value)

    @pytest.mark.parametrize("units", UNITS)
    def test_size_is_judged_in_millimetres_whatever_the_unit(self, units):
        scene = Scene("size", units=units)
        for millimetres, fine in (
            (1.02 * SMALLEST_MM, True),
            (0.98 * SMALLEST_MM, False),
            (0.98 * LARGEST_MM, True),
            (1.02 * LARGEST_MM, False),
        ):
            side = millimetres * UNITS[units] / math.sqrt(3.0)
            box = trimesh.creation.box((side, side, side))
            if fine:
                check_size(scene, "bone", "b", Bone("b", box))
            else:
                with pytest.raises(MeshError, match=rf"bone 'b' .* {units} across"):
                    check_size(scene, "bone", "b", Bone("b", box))


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.floats(1e-9, math.pi - 1e-6),
)
def test_angle_of_a_turn_is_its_angle_about_any_axis_and_way_round(axis, angle):
    axis = np.array(axis) / np.linalg.norm(axis)
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    assert turned_angle(turn) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert turned_angle(turn.T) == pytest.approx(angle, rel=1e-6, abs=1e-15)


class TestOBJ:
    """A face counts vertices from the first, or back from the last so far; texture and normal numbers say nothing."""

    PLACES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 1\n"

    def read(self, tmp_path, text):
        (tmp_path / "m.obj").write_text(text)
        return read_mesh(tmp_path / "m.obj", name="m").mesh

    def test_counting_back_is_counting_on(self, tmp_path):
        on = self.read(tmp_path, self.PLACES + "f 4 3 2 1\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n")
        back = self.read(
            tmp_path, self.PLACES + "f -2 -3 -4 -5\nf -5 -4 -1\nf -4 -3 -1\nf -3 -2 -1\nf -2 -5 -1\n"
        )
        mixed = self.read(
            tmp_path, self.PLACES + "f 4/1 3/2/3 2//4 1\nf 1 2 -1\n# f 9\nf 2 3 -1 # last\nf 3 4 5\nf 4 1 5\n"
        )
        for other in (back, mixed):
            np.testing.assert_array_equal(other.vertices, on.vertices)
            np.testing.assert_array_equal(other.faces, on.faces)
        assert on.volume == pytest.approx(1.0 / 3.0) and len(on.faces) == 6

    def test_counting_back_is_from_where_the_face_stands(self, tmp_path):
        first = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\nv 0 0 1\nf -4 -3 -1\nf -3 -2 -1\nf -2 -4 -1\n"
        mesh = self.read(tmp_path, first)
        assert mesh.is_watertight and mesh.volume == pytest.approx(1.0 / 6.0)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("v 0 0\n", "not a readable OBJ file|fewer than three coordinates"),
            ("v 0 0 x\n", "not a readable OBJ file"),
            ("v 0 0 0\nf 1 1 99999999999999999999\n", "not a readable OBJ file|out of bounds"),
            ("\nf a b c\n", "not a readable OBJ file|the mesh is empty"),
        ],
    )
    def test_what_is_no_obj_is_refused(self, tmp_path, text, words):
        with pytest.raises(MeshError, match=rf"m\.obj.*({words})"):
            self.read(tmp_path, text)


@pytest.fixture(scope="module")
def slab():
    """A plate 4 mm thin at z = 0, its field in coordinates far from the origin."""
    mesh = trimesh.creation.box((60.0, 60.0, 4.0))
    mesh = mesh.subdivide().subdivide().subdivide()
    shift = np.array([300.0, -200.0, 100.0])
    mesh.apply_translation(shift)
    return BoneSDF.from_mesh(mesh, cache=False), shift


def paths(ends, shift):
    start, end = np.array(ends, dtype=float).transpose(1, 0, 2)
    return start + shift, end + shift


def test_only_paths_that_go_through_the_plate_are_found(slab):
    field, shift = slab
    ends = [
        [(0, 0, 10), (0, 0, -10)],  # straight through
        [(5, 5, 10), (9, 5, -12)],  # askew
        [(0, 0, 10), (0, 0, 3)],  # towards it
        [(0, 0, 3), (10, 0, 3)],  # along it
        [(100, 0, 10), (100, 0, -10)],  # beside it
        [(0, 0, 50), (0, 0, 49)],  # far away
    ]
    start, end = paths(ends, shift)
    found = sweep_paths(field, start, end, tolerance=0.05)
    through = np.zeros(len(ends), dtype=bool)
    through[found.index] = found.through
    assert through.tolist() == [True, True, False, False, False, False]
    # Half of the plate, to a cell of its field; what stays outside is told as far as it is.
    assert found.lowest[found.index == 0] == pytest.approx(-2.0, abs=0.3)
    assert (found.lowest[found.index > 1] > 0.0).all()
    # What stays clear is not even looked at.
    assert not set(found.index.tolist()) & {2, 4, 5}
    # The other way round, and each path alone, are the same.
    back = sweep_paths(field, end, start, tolerance=0.05)
    assert back.index[back.through].tolist() == [0, 1]
    for k in range(len(ends)):
        one = sweep_paths(field, start[[k]], end[[k]], tolerance=0.05)
        assert bool(one.through.any()) == through[k]


@pytest.mark.parametrize("muscles", [1, 3])
@pytest.mark.parametrize("items", [[], [7], [3, 1, 2, 9]])
def test_what_goes_side_by_side_comes_back_in_order(muscles, items):
    workers = Workers(muscles)
    try:
        assert workers.each(lambda value: value * value, items) == [value * value for value in items]
        assert workers.parallel == (min(muscles, numba.get_num_threads()) > 1)
    finally:
        workers.close()


def test_nothing_starts_beside_a_single_thread(monkeypatch):
    monkeypatch.setattr("rbfmuscle.simulation.workers.numba", SimpleNamespace(get_num_threads=lambda: 1))
    workers = Workers(5)
    assert workers.each(abs, [-1, -2]) == [1, 2] and not workers.parallel
