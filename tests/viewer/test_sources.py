"""What a viewer shows of scenes and saved runs, without a browser."""

from types import SimpleNamespace

import numpy as np
import pytest
import toy_scene
import trimesh
from blend_model import arm_scene

import rbfmuscle as rm
from rbfmuscle.run.data import RunData
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.joints import Coordinate
from rbfmuscle.scene.motion import coordinate_limits
from rbfmuscle.scene.options import GuessTable
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.viewer import open_server
from rbfmuscle.viewer.page import Panel
from rbfmuscle.viewer.side import KINDS, MarkView, vertex_values
from rbfmuscle.viewer.sources import LiveFigure, LiveSource, Picture, SavedSource, scene_marks


@pytest.fixture
def figure():
    scene, fields = toy_scene.hinged_scene([0, 20, 40])
    return LiveFigure(scene, [toy_scene.ToyMuscle(m, scene) for m in scene.muscles], fields)


def go(figure, *, coarse=False):
    count, picture = 0, None
    while figure.pending:
        picture, count = figure.advance(coarse=coarse and not figure.arrived), count + 1
    return picture, count


def strap(picture):
    return picture.surfaces["strap"][0]


def test_control_moves_the_muscle_by_sub_steps(figure):
    start, _ = go(figure)
    figure.set("hinge.bend", 21.0)
    assert figure.pending
    picture, count = go(figure)
    assert count == 11  # two degrees a picture
    assert not np.allclose(strap(picture), strap(start))
    assert np.degrees(figure.here["hinge.bend"]) == pytest.approx(21.0)
    figure.set("hinge.bend", 0.0)
    figure.rest()
    again, count = go(figure)
    assert count == 1
    np.testing.assert_array_equal(strap(again), strap(start))


def test_live_equals_a_run(figure):
    scene, fields = toy_scene.hinged_scene([0, 2, 4, 6])
    models = [toy_scene.ToyMuscle(m, scene) for m in scene.muscles]
    run = list(simulate_frames(scene, models, bone_sdfs=fields))
    go(figure)
    figure.set("hinge.bend", 6.0)
    picture, _ = go(figure)
    np.testing.assert_allclose(strap(picture), run[-1].surfaces["strap"].vertices, atol=1e-9)


def test_coarse_pictures_show_the_material_and_end_with_a_full_one(figure):
    go(figure)
    figure.set("hinge.bend", 10.0)
    coarse = figure.advance(coarse=True)
    np.testing.assert_array_equal(strap(coarse), figure.models[0].material_mesh()[0])
    assert coarse.depth == {}  # of the surface, which was not made
    full, _ = go(figure, coarse=True)
    assert set(full.depth) == {"strap"}
    assert np.degrees(figure.here["hinge.bend"]) == pytest.approx(10.0)


def picture_of(vertices, faces):
    return Picture({"bone": np.eye(4)}, {"ball": (vertices, faces)}, {}, {"ball": 0.5}, {}, "")


def test_stretch_of_a_ball_that_grew_and_its_depth_in_a_box():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    now, rest = picture_of(1.2 * vertices, faces), picture_of(vertices, faces)
    values = vertex_values("stretch", "ball", now, rest, [], None)
    np.testing.assert_allclose(values, 0.2, atol=1e-12)
    bone = trimesh.creation.box(extents=(100.0, 100.0, 100.0))
    bone.apply_translation((0.0, 0.0, 58.0))  # its lower face cuts the ball 2 below the top
    values = vertex_values("penetration", "ball", rest, rest, [BoneDistance("bone", bone)], None)
    np.testing.assert_allclose(values, np.maximum(vertices[:, 2] - 8.0, 0.0), atol=1e-9)


def test_controls_of_the_phantom_have_joint_unit_and_limits():
    source = LiveSource(rm.phantom_scene(end=60.0, spacing=6.0), "pbd")
    assert source.controls["hip.flexion"] == ("hip", "flexion [°]", -30.0, 60.0, 0.0)
    assert source.choices[0] == "pbd" and len(set(source.choices)) == len(source.choices)
    assert source.motion[-1]["hip.flexion"] == pytest.approx(60.0)


def test_a_slider_spans_the_range_of_its_coordinate():
    """All of it, however far the motion goes; with the rest value where that lies outside."""
    scene = arm_scene(end=20)
    for ends, rest, expected in (
        ((-5, 140), 0, (-5, 140)),
        ((10, 30), 0, (0, 30)),
        (None, 0, (-30, 30)),
    ):
        given = None if ends is None else tuple(np.radians(ends))
        scene.joints[0].coordinates["flexion"] = Coordinate(rest=rest, range=given)
        limits = coordinate_limits(scene)["elbow.flexion"]
        assert np.degrees(limits) == pytest.approx(expected)


@pytest.mark.parametrize(("runs", "beside"), [(("rbf",), "none"), (("rbf", "pbd", "x"), "pbd")])
def test_a_comparison_opens_with_its_first_two_models(arm_run, runs, beside):
    source = SavedSource(dict.fromkeys(runs, RunData.load(arm_run[1])))
    server, _ = open_server(0)
    try:
        panel = Panel(server, source, {}, "group", lambda: None)
        assert [model.value for model in panel.models] == ["rbf", beside]
    finally:
        server.stop()


def test_moment_arms_follow_the_coordinate_that_is_moved():
    """Live they are those of a run over the same poses up to there; saved, those of its table."""
    scene = rm.phantom_scene(end=12.0, step=2.0, spacing=6.0)
    scene.muscles = scene.muscles[:1]
    run = rm.simulate(scene, model="pbd")
    name = run.muscles[0]
    source = SavedSource({"run": run})
    saved = source.figure("run")
    frames, arms = run.series(name, "moment_arm", "hip.flexion")
    saved.set("frame", frames[3])
    assert saved.advance().moment_arms == {name: arms[3]}
    live = LiveSource(scene, "pbd").figure("pbd")
    assert go(live)[0].moment_arms == {}  # at rest nothing has moved
    live.set("hip.flexion", 12.0)
    found = go(live)[0].moment_arms[name]
    lengths, angles = run.series(name, "length")[1], np.radians(run.coordinates["hip.flexion"])
    ahead = np.polyfit(angles[2:] - angles[-1], lengths[2:], 2)[-2]  # the last 8 degrees
    assert found == pytest.approx(-ahead, rel=1e-6) and abs(found) > 5.0
    live.set("hip.flexion", 10.0)
    live.set("hip.adduction", 2.0)
    assert go(live)[0].moment_arms == {}
    live.rest()
    assert live.advance().moment_arms == {}


def test_no_text_of_a_run_is_read_as_html():
    """Names, units and messages are a stranger's: they are shown as they are."""
    hostile = "<img src=x onerror=alert(1)>"
    colours = {hostile: "#000000"}
    panel = SimpleNamespace(
        colour=SimpleNamespace(value="group"),
        source=SimpleNamespace(units=hostile, millimetre=1.0, colours=colours),
        _numbers=SimpleNamespace(content=""),
    )
    Panel.write(panel, [SimpleNamespace(choice=hostile, numbers={})], [hostile])
    shown = panel._numbers.content
    assert "<img" not in shown and shown.count("&lt;img src=x onerror=alert(1)&gt;") == 5


def test_activation_of_a_muscle_is_set_and_coloured():
    scene = rm.phantom_scene(end=4.0, step=2.0, spacing=6.0)
    scene.muscles = [scene.muscle("extensor")]
    source = LiveSource(scene.with_options({"activation": 0.0}), "arap-volume")
    assert source.controls["activation extensor"] == ("Activation", "extensor", 0.0, 1.0, 0.0)
    figure = source.figure("arap-volume")
    figure.set("activation extensor", 0.35)
    picture, _ = go(figure)
    values = vertex_values("activation", "extensor", picture, picture, [], None)
    np.testing.assert_allclose(values, 0.35)


def test_marks_of_a_scene_move_with_their_bones():
    scene = rm.phantom_scene()
    marks = scene_marks(scene)
    (joint,) = scene.joints
    ((name, _, lines),) = marks.axes
    assert name == joint.name
    assert len(lines) == len(joint.coordinates)
    np.testing.assert_allclose(lines.mean(axis=1), np.tile(joint.centre, (len(lines), 1)))
    assert sum(held.name == "extensor" for held in marks.held) == 2
    server, _ = open_server()
    try:
        view = MarkView(server, "/.marks", marks, 0.001)
        pose = np.eye(4)
        pose[:3, 3] = [10.0, 0.0, 0.0]
        poses = {bone.name: pose for bone in scene.bones}
        meshes = {m.name: (np.asarray(m.mesh.vertices), m.mesh.faces) for m in scene.muscles}
        view.draw(KINDS, {"abductor"}, poses, meshes)
        nodes = view._nodes
        shown = nodes[f"/.marks/axes/{joint.name}"].points
        np.testing.assert_allclose(shown, 0.001 * (lines + pose[:3, 3]), rtol=1e-5)
        assert {"/.marks/names/extensor", f"/.marks/names/{joint.name}"} <= set(nodes)
        assert "/.marks/names/abductor" not in nodes
        view.draw((), (), poses, meshes)
        assert not any(node.visible for node in nodes.values())
    finally:
        server.stop()


def test_doubts_of_a_scene_are_listed():
    scene = rm.phantom_scene(end=0.0)
    scene.doubts = ["the foot is one bone"]
    held = scene.muscle("extensor").attachments[0]
    held.guess = GuessTable(confidence=0.3, reason="held by the nearest bone")
    assert scene_marks(scene).doubts == [
        "the foot is one bone",
        "muscle extensor: held by the nearest bone",
    ]
