"""Lines marked GUESS, picked points, and attachments on articular surfaces."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.scene.articular import articular_points
from rbfmuscle.scene.guesses import doubtful, find_guesses
from rbfmuscle.scene.picked import picked_vertices, read_points
from rbfmuscle.validation import SceneError

TEXT = """# Check every line marked GUESS 0.1: this line is a comment
[[joint]]   # GUESS 0.2: a hinge
name = "knee"
[[muscle]]
name = "psoas"
attach = [
  { bone = "pelvis" },   # GUESS 0.4: far away
  { bone = "femur" },   # GUESS 0.9: near
]
"""


def test_a_guess_is_doubtful_until_its_word_is_removed():
    guesses = find_guesses(TEXT)
    assert [(g.table, g.name, g.confidence) for g in guesses] == [
        ("joint", "knee", 0.2),
        ("muscle", "psoas", 0.4),
        ("muscle", "psoas", 0.9),
    ]
    assert [g.text for g in doubtful(guesses, "muscle", "psoas")] == ["far away"]
    assert doubtful(find_guesses(TEXT.replace("GUESS 0.4", "0.4")), "muscle") == []


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
    with pytest.raises(SceneError, match="away from the muscle"):
        picked_vertices(points * 1000.0, ball.vertices, context="")


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
