"""Tubes of a model's muscles: volume, path, wrapping, what holds them."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.lines import line_length
from rbfmuscle.importers.opensim.elements import ModelMuscle, WrapShape, read_xml
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.scene import LEAST_MISSED, import_osim, write_imported
from rbfmuscle.importers.opensim.tubes import FITTED, SIDES, make_tube, wrap_path
from rbfmuscle.scene.check import check_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import SceneError

PLACES = {"a": np.eye(4), "b": np.eye(4), "c": np.eye(4)}
HELD_BY = {name: name for name in PLACES}


def _bones(*names):
    small = trimesh.creation.icosphere(radius=0.001)
    small.apply_translation([5.0, 5.0, 5.0])
    return {name: ExactDistance(small.vertices, small.faces) for name in names}


def _tube(points, **more):
    muscle = ModelMuscle("m", points, volume=1e-4, **more)
    return make_tube(muscle, PLACES, _bones("a", "b", "c"), HELD_BY)


def test_straight_tube_is_closed_has_its_volume_and_is_held_at_its_ends():
    tube = _tube([("a", np.zeros(3)), ("b", np.array([0.0, 0.0, 0.3]))])
    mesh = trimesh.Trimesh(tube.vertices, tube.faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    assert mesh.volume == pytest.approx(1e-4, rel=1e-9)
    assert tube.volume_error == pytest.approx(mesh.volume / 1e-4 - 1.0, abs=1e-12)
    assert (
        tube.vertices[tube.held["a"], 2].max() < 0.03
        and tube.vertices[tube.held["b"], 2].min() > 0.27
    )
    assert not set(tube.held["a"]) & set(tube.held["b"])


@pytest.mark.parametrize(("quadrant", "side"), [("", 1.0), ("-x", -1.0), ("x", 1.0)])
def test_path_goes_around_a_cylinder_on_the_side_that_it_says(quadrant, side):
    frame = np.eye(4)  # its axis along y
    frame[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    frame[:3, 3] = [-0.002, 0.0, 0.15]
    wrap = WrapShape("a", frame, np.array([0.03, 0.03, 0.1]), "WrapCylinder", quadrant)
    tube = _tube([("a", np.zeros(3)), ("b", np.array([0.0, 0.0, 0.3]))], wraps=[wrap])
    middles = tube.vertices[:-2].reshape(-1, SIDES, 3).mean(axis=1)
    away = np.hypot(middles[:, 0] + 0.002, middles[:, 2] - 0.15)
    assert away.min() > 0.0298 and side * middles[len(middles) // 2, 0] > 0.02


RADII = {
    "WrapCylinder": [0.03, 0.03, 0.1],
    "WrapSphere": [0.03] * 3,
    "WrapEllipsoid": [0.03, 0.06, 0.04],
}


@pytest.mark.parametrize(
    ("kind", "quadrant", "ends", "length"),
    [  # lengths of OpenSim 4.6
        ("WrapCylinder", "x", ([0.03, 0.22, 0.0], [-0.05002689, -0.0701513, 0.0]), 0.33002492),
        ("WrapCylinder", "x", ([0.03, 0.22, 0.0], [-0.00349898, -0.02601462, 0.0]), 0.24828480),
        ("WrapCylinder", "x", ([0.03, 0.22, 0.0], [0.01620907, -0.02524413, 0.0]), 0.24563158),
        ("WrapCylinder", "x", ([-0.01, 0.17, 0.0], [-0.08684861, -0.04982286, 0.01]), 0.31102113),
        (
            "WrapEllipsoid",
            "x",
            ([0.03, 0.22, 0.005], [-0.06685743, -0.08095730, -0.004]),
            0.31628731,
        ),
    ],
)
def test_path_over_a_shape_is_as_long_as_opensims(kind, quadrant, ends, length):
    wrap = WrapShape("a", np.eye(4), np.array(RADII[kind]), kind, quadrant)
    path, own = wrap_path(np.array(ends), [(wrap, np.eye(4))])
    assert line_length(path) == pytest.approx(length, rel=0.003)  # an arc of 24 points
    assert own.tolist() == [0, len(path) - 1]


def test_shortest_path_over_a_sphere_is_known():
    """Two tangents and an arc: of points at distance d the tangents are sqrt(d^2 - r^2)."""
    wrap = WrapShape("a", np.eye(4), np.array([0.03] * 3), "WrapSphere", "")
    path, _ = wrap_path(np.array([[-0.1, 0.01, 0.0], [0.1, 0.01, 0.0]]), [(wrap, np.eye(4))])
    away = np.hypot(0.1, 0.01)
    arc = 2.0 * (np.arctan2(0.1, 0.01) - np.arccos(0.03 / away))
    known = 2.0 * np.sqrt(away**2 - 0.03**2) + 0.03 * arc
    assert line_length(path) == pytest.approx(known, rel=1e-4)  # an arc of 24 points


def test_slender_tube_whose_path_crosses_a_bone_is_said_and_keeps_its_volume():
    """What comes out of the bone on both sides has no volume of its own."""
    rod = trimesh.creation.cylinder(radius=0.012, height=0.38, sections=16)
    rod = rod.subdivide_to_size(0.02)
    bones = _bones("a", "b", "c") | {"rod": ExactDistance(rod.vertices, rod.faces)}
    points = [("a", np.array([0.03, 0.005, -0.01])), ("b", np.array([-0.067, -0.004, 0.301]))]
    tube = make_tube(ModelMuscle("m", points, volume=3e-6), PLACES, bones, HELD_BY)
    assert np.isfinite(tube.vertices).all() and tube.volume_error < 0.1
    assert tube.crossed == ["rod"]


def test_tube_lies_flat_on_a_bone_in_its_way_and_keeps_its_volume():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ball.apply_translation([0.025, 0.0, 0.15])
    bones = _bones("a", "b", "c") | {"ball": ExactDistance(ball.vertices, ball.faces)}
    points = [("a", np.zeros(3)), ("b", np.array([0.0, 0.0, 0.3]))]
    tube = make_tube(ModelMuscle("m", points, volume=1e-4), PLACES, bones, HELD_BY)
    away = np.linalg.norm(tube.vertices - [0.025, 0.0, 0.15], axis=1) - 0.02
    assert 0.0 < away.min() < 0.001
    mesh = trimesh.Trimesh(tube.vertices, tube.faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(
        1e-4, rel=3 * FITTED
    )  # of the radius, whose square it is


def test_no_edge_of_a_bone_cuts_through_the_faces_of_a_tube():
    """A sharp edge between the tube's rings, 8 mm into a straight one of 9 mm."""
    plate = trimesh.creation.box([0.04, 0.04, 0.002]).subdivide().subdivide()
    plate.apply_translation([0.0215, 0.0, 0.1535])
    bones = _bones("a", "b", "c") | {"plate": ExactDistance(plate.vertices, plate.faces)}
    points = [("a", np.zeros(3)), ("b", np.array([0.0, 0.0, 0.3]))]
    tube = make_tube(ModelMuscle("m", points, volume=5e-5), PLACES, bones, HELD_BY)
    inside = ExactDistance(tube.vertices, tube.faces).signed_distance(plate.vertices)
    assert inside.min() > -1e-4
    assert bones["plate"].signed_distance(tube.vertices).min() > 0.0


def test_ends_lie_on_their_bones_and_not_in_them():
    """The path begins 5 mm inside a ball: its tube begins at the ball's surface."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    bones = _bones("b", "c") | {"a": ExactDistance(ball.vertices, ball.faces)}
    points = [("a", np.array([0.0, 0.0, 0.015])), ("b", np.array([0.0, 0.0, 0.3]))]
    tube = make_tube(ModelMuscle("m", points, volume=5e-5), PLACES, bones, HELD_BY)
    assert 0.0 < bones["a"].signed_distance(tube.vertices).min() < 0.001
    inside = ExactDistance(tube.vertices, tube.faces).signed_distance(ball.vertices)
    assert inside.min() > -1e-4
    mesh = trimesh.Trimesh(tube.vertices, tube.faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(
        5e-5, rel=3 * FITTED
    )  # of the radius, whose square it is


def test_points_between_the_ends_hold_the_tube_on_its_way():
    """A path from a over c to b, with a second point on b: its ends are those of a and b alone."""
    at = [("a", 0.0), ("c", 0.1), ("b", 0.25), ("b", 0.3)]
    tube = _tube([(body, np.array([0.0, 0.0, z])) for body, z in at])
    assert set(tube.held) == {"a", "b"} and set(tube.via) == {"b", "c"}
    heights = {body: tube.vertices[rows, 2] for body, rows in tube.via.items()}
    assert np.abs(heights["c"] - 0.1).max() < 0.3 / 39
    assert heights["b"].min() == pytest.approx(0.25, abs=0.3 / 39) and heights["b"].max() < 0.29
    assert tube.vertices[tube.held["b"], 2].min() > 0.28
    rows = np.concatenate([*tube.held.values(), *tube.via.values()])
    assert len(rows) == len(set(rows))


def test_muscle_without_a_bone_to_hold_it_is_named():
    muscle = ModelMuscle("m", [("a", np.zeros(3)), ("b", np.ones(3))], volume=1e-4)
    with pytest.raises(SceneError, match="body 'b' has no mesh"):
        make_tube(muscle, PLACES, _bones("a"), HELD_BY)


def test_muscles_of_published_models_are_written_and_load(osim_data, tmp_path):
    path = osim_data / "leg6dof9musc" / "leg6dof9musc.osim"
    model = read_osim(path)
    assert len(model.muscles) == 9
    found = import_osim(path)
    scene = Scene.load(write_imported(found, tmp_path))
    scene = scene.with_options({"motion.file": str(path.parent / "leg69_IK_swing.mot")})
    assert len(scene.muscles) == 9 and scene.superior == [0.0, 1.0, 0.0]
    assert scene.neighbours is None  # tubes lie in each other by up to 31 mm
    assert all(finding.level != "error" for finding in check_scene(scene))
    for known, muscle in zip(model.muscles, scene.muscles):
        # What presses a tube off the edges of bones comes and goes with its radius, so that the
        # last fit may miss by some 1e-4; beyond LEAST_MISSED a doubt says so.
        assert muscle.mesh.volume == pytest.approx(known.volume, rel=LEAST_MISSED), known.name


def test_latin_1_is_read_as_opensim_reads_it(tmp_path):
    text = '<?xml version="1.0" encoding="UTF-8"?><Model name="Köln"/>'
    for encoding in ("utf-8", "latin-1"):
        (tmp_path / "m.osim").write_bytes(text.encode(encoding))
        root = read_xml(tmp_path / "m.osim")
        assert (root.get("name"), root.name) == ("Köln", "Köln")
