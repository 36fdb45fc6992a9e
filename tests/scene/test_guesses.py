"""Guesses of a scene, picked points, and attachments on articular surfaces."""

import numpy as np
import pytest
import trimesh
from blend_model import arm_files

from rbfmuscle.scene.check import articular_points, check_scene
from rbfmuscle.scene.options import GuessTable
from rbfmuscle.scene.patches import picked_vertices, read_points
from rbfmuscle.scene.scene import Scene, doubtful
from rbfmuscle.validation import SceneError


def guessed(folder, hinge="", first=""):
    """The scene of a file with keys in the table of its joint, and in its first attachment."""
    path = arm_files(folder)
    text = path.read_text(encoding="utf-8")
    text = text.replace("[[joint]]\n", f"[[joint]]\n{hinge}", 1)
    path.write_text(text.replace('{ bone = "upper",', f'{{ bone = "upper",{first}', 1))
    return path


def test_a_guess_is_doubtful_until_its_key_is_removed(tmp_path):
    hinge = "guess = { confidence = 0.2, reason = 'a hinge' }\n"
    first = " guess = { confidence = 0.4, reason = 'far # \\u005Baway' },"
    scene = Scene.load(guessed(tmp_path, hinge, first))
    assert [(g.table, g.name, g.confidence) for g in scene.guesses] == [
        ("joint", "elbow", 0.2),
        ("muscle", "biceps", 0.4),
    ]
    assert [g.confidence for g in doubtful(scene.guesses, "muscle", "biceps")] == [0.4]
    warned = [found.message for found in check_scene(scene) if "guess" in found.message]
    assert len(warned) == 2 and "a doubtful guess (0.2): a hinge" in warned[0]
    (muscle,), (joint,) = scene.muscles, scene.joints
    joint.guess = None
    muscle.attachments[0].guess = GuessTable(confidence=0.9)
    assert doubtful(scene.guesses, "muscle") == doubtful(scene.guesses, "joint") == []


def test_layout_of_the_file_does_not_move_a_guess(tmp_path):
    path = arm_files(tmp_path, muscles=(("first", 0.0), ("second", 3.0)))
    lines = path.read_text(encoding="utf-8").splitlines()
    at = [k for k, line in enumerate(lines) if line.startswith("[[muscle]]")][1]
    # Rows of arrays at the margin and indented keys are TOML like any other.
    lines[at:] = [f"   {line}" for line in lines[at:]]
    rows = ['{ bone = "upper", vertices = "upper.txt", guess = { confidence = 0.3 } },']
    rows += ['{ bone = "fore", vertices = "fore.txt" }']
    path.write_text("\n".join([*lines, "attach = [", *rows, "]"]) + "\n", encoding="utf-8")
    assert [(g.table, g.name) for g in Scene.load(path).guesses] == [("muscle", "second")]


@pytest.mark.parametrize(
    ("hinge", "says"),
    [
        ("# GUESS 0.2: a whole line may say anything\n", ""),
        ("type = 'hinge'   # GUESS 0.2: a hinge\n", "line .*: comments mark no guesses any more"),
        ("guess = 0.7\n", "guess"),
        ("guess = { confidence = 1.2 }\n", "confidence"),
        ("guess = { sure = 0.2 }\n", "sure"),
    ],
)
def test_other_marks_are_refused_in_words(tmp_path, hinge, says):
    path = guessed(tmp_path, hinge)
    if not says:
        assert Scene.load(path).guesses == []
        return
    with pytest.raises(SceneError, match=says):
        Scene.load(path)


@pytest.mark.parametrize("head", ["", "x y z\n", '"Point ID","Points:0","Points:1","Points:2"\n'])
def test_picked_points_are_read_as_other_programs_write_them(tmp_path, head):
    points = np.array([[0.0, 0, 5], [2, 0, 4.5], [0, 2, 4.5]])
    comma = "," in head
    rows = [[*([7] if comma else []), *point] for point in points]
    lines = [("," if comma else " ").join(map(str, row)) for row in rows]
    file = tmp_path / "picked.csv"
    file.write_text(head + "\n".join(lines), encoding="utf-8")
    np.testing.assert_array_equal(read_points(file, context=""), points)


def test_picked_points_hold_the_vertices_about_them_and_no_other_muscle():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
    points = 5.0 * np.array([[0, 0, 1], [0.2, 0, 0.98], [0, 0.2, 0.98]])
    held = picked_vertices(points, ball.vertices, context="")
    away = np.linalg.norm(ball.vertices[held][:, None] - points, axis=2).min(axis=1)
    assert len(held) > 3 and away.max() < 0.6 * 1.05
    with pytest.raises(SceneError, match=r"point 2 of 3, \(3, 0, 14.7\), lies 10\S* units"):
        picked_vertices(points * [[1.0], [3.0], [1.0]], ball.vertices, context="")


def test_a_head_is_articular_and_a_far_end_is_not():
    head = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    shaft = trimesh.creation.cylinder(10.0, 200.0, sections=32).apply_translation([0, 0, -125.0])
    femur = trimesh.util.concatenate([head, shaft])
    socket = trimesh.creation.icosphere(subdivisions=4, radius=23.0)
    socket.invert()
    found = articular_points(
        [("pelvis", "femur", np.zeros(3))], {"pelvis": socket, "femur": femur}, 1.0
    )
    away = np.linalg.norm(found["femur"], axis=1)
    assert len(found["femur"]) > 1000 and away.max() < 1.08 * 20.0 and len(found["pelvis"])


def painted_scene(folder, colour, *, doubled=False):
    """A scene of two bones and a muscle whose ends were painted red and blue; with ``doubled``
    vertices as a program writes them that splits a mesh by its colours.
    """
    muscle = trimesh.creation.icosphere(3).apply_scale([8.0, 8.0, 30.0])
    if doubled:
        muscle = trimesh.Trimesh(muscle.triangles.reshape(-1, 3), process=False)
        muscle.faces = np.arange(len(muscle.vertices)).reshape(-1, 3)
    height = muscle.vertices[:, 2]
    paint = np.full((len(height), 4), 255, dtype=np.uint8)
    paint[height > 24.0] = [250, 5, 3, 255]  # red, a little off as after colour management
    paint[height < -24.0] = [0, 0, 255, 255]
    muscle.visual.vertex_colors = paint
    muscle.export(folder / "muscle.ply")
    for name, z in (("upper", 45.0), ("lower", -45.0)):
        ball = trimesh.creation.icosphere(3, 12.0).apply_translation([0.0, 0.0, z])
        ball.export(folder / f"{name}.ply")
    file = folder / "scene.toml"
    bones = "".join(f'[[bone]]\nname = "{n}"\nmesh = "{n}.ply"\n' for n in ("upper", "lower"))
    file.write_text(
        f'[scene]\nformat = 2\nunits = "mm"\n{bones}[[muscle]]\nname = "m"\nmesh = "muscle.ply"\n'
        f'attach = [{{ bone = "upper", colour = "{colour}" }}, '
        '{ bone = "lower", colour = "#0000ff" }]\n',
        encoding="utf-8",
    )
    return file


@pytest.mark.parametrize("doubled", [False, True])
def test_painted_vertices_are_attached(tmp_path, doubled):
    (muscle,) = Scene.load(painted_scene(tmp_path, "#ff0000", doubled=doubled)).muscles
    height = np.asarray(muscle.mesh.vertices)[:, 2]
    upper, lower = (set(attachment.vertices) for attachment in muscle.attachments)
    # A vertex that several triangles doubled is painted in all of them.
    assert upper == set(np.flatnonzero(height > 24.0)) and len(upper) > 20
    assert lower == set(np.flatnonzero(height < -24.0))


@pytest.mark.parametrize(
    ("colour", "words"),
    [("#00ff00", "no vertex has the colour #00ff00"), ("red", "must be like '#ff0000'")],
)
def test_a_colour_that_is_not_there_is_refused(tmp_path, colour, words):
    with pytest.raises(SceneError, match=words):
        Scene.load(painted_scene(tmp_path, colour))


def test_a_mesh_without_colours_is_refused_where_one_is_asked_for(tmp_path):
    file = painted_scene(tmp_path, "#ff0000")
    mesh = trimesh.load(tmp_path / "muscle.ply", process=False)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "muscle.ply")
    with pytest.raises(SceneError, match="holds no vertex colours"):
        Scene.load(file)
