"""Files of format 1: they load as before, and are rewritten with their comments."""

import json
import logging

import numpy as np
import pytest
from blend_model import arm_files
from command_line import call

from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.upgrade import upgrade_file, upgraded
from rbfmuscle.validation import SceneError

OLD = """\
# An arm.
[scene]
format = 1   # once
name = "arm"
units = "mm"
left_out = ["hand"]

[[bone]]
name = "upper"
mesh = "upper.ply"
[[bone]]
name = "fore"
mesh = "fore.ply"
[[bone]]
name = "tip"

[[joint]]   # GUESS 0.9: a hinge
name = "elbow"
parent = "upper"
child = "fore"
type = "ball"   # of one turn
centre = [0, 0, 0]
axes = { flexion = [0, -1, 0] }
[[joint]]
name = "wrist"
parent = "fore"
child = "tip"
type = 'slider'
centre = [0, 0, 0]
axes = { out = [1, 0, 0] }
[motion]
ramp = { "elbow.flexion" = { from = 0, to = 10, step = 5 } }

[defaults]
model = { name = "pbd", slack = 1.3 }
[[muscle]]
name = "biceps"
mesh = "biceps.ply"
tendon = { length = 4 }
attach = [
  { bone = "upper", sphere = { centre = [-26, 0, 9.5], radius = 8.5 } },   # a ball
  { bone = "fore", vertices = "fore.txt" },
]
"""


@pytest.fixture
def old(tmp_path):
    path = arm_files(tmp_path)
    path.write_text(OLD)
    return path


def same(one, other):
    """Whether two scenes are the same to the bit."""
    for mine, image in zip(one.bones + one.muscles, other.bones + other.muscles, strict=True):
        assert np.array_equal(mine.mesh.vertices, image.mesh.vertices)
    for mine, image in zip(one.muscles, other.muscles, strict=True):
        assert (mine.model, mine.options) == (image.model, image.options)
        for first, second in zip(mine.attachments, image.attachments, strict=True):
            assert np.array_equal(first.vertices, second.vertices)
    for frame in one.motion.frames:
        mine, image = bone_poses(one, frame), bone_poses(other, frame)
        assert all(np.array_equal(mine[name], image[name]) for name in mine)
    assert one.missing_bones == other.missing_bones and one.guesses == other.guesses


def test_old_file_loads_with_one_line(old, caplog):
    with caplog.at_level(logging.WARNING):
        scene = Scene.load(old)
    (line,) = caplog.messages
    assert "format 1" in line and f"check {old} --upgrade" in line
    assert [joint.kind for joint in scene.joints] == ["hinge", "slide"]
    assert len(scene.muscles[0].attachments[0].vertices) > 3
    assert scene.muscles[0].model == "pbd" and scene.missing_bones == ["hand"]


def test_upgrade_keeps_comments_and_meaning(old, caplog):
    before = Scene.load(old)
    caplog.clear()
    assert upgrade_file(old)
    text = old.read_text()
    assert text.count("#") == OLD.count("#") and text.count("\n") == OLD.count("\n")
    changed = [pair for pair in zip(OLD.splitlines(), text.splitlines()) if pair[0] != pair[1]]
    assert changed == [
        ("format = 1   # once", "format = 2   # once"),
        ('left_out = ["hand"]', 'missing_bones = ["hand"]'),
        ('type = "ball"   # of one turn', 'type = "hinge"   # of one turn'),
        ("type = 'slider'", "type = 'slide'"),
        ("[defaults]", "[classes.main]"),
        ('model = { name = "pbd", slack = 1.3 }', 'model = { name = "pbd", slack_ratio = 1.3 }'),
        ("tendon = { length = 4 }", "tendon_region = { length = 4 }"),
        (
            '  { bone = "upper", sphere = { centre = [-26, 0, 9.5], radius = 8.5 } },   # a ball',
            '  { bone = "upper", points = [[-26, 0, 9.5]], radius = 8.5 },   # a ball',
        ),
    ]
    same(before, Scene.load(old))
    assert not caplog.messages and not upgrade_file(old) and old.read_text() == text
    assert [path.name for path in old.parent.iterdir() if path.name.startswith(".")] == []


def test_lines_end_as_they_did(old):
    old.write_bytes(OLD.replace("\n", "\r\n").encode())
    assert upgrade_file(old)
    assert old.read_bytes().count(b"\r\n") == OLD.count("\n")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("format = 1", '"format" = 1'),
        ("[defaults]\n", "[ defaults ]\n"),
        ("sphere = { centre", 'sphere = { "centre"'),
        ('name = "arm"', 'name = "arm"\nnotes = ["""\nformat = 1"""]'),
        (
            "axes = { flexion = [0, -1, 0] }",
            "axes = { a = [1, 0, 0], b = [1, 0, 0], c = [1, 0, 0], d = [1, 0, 0] }",
        ),
    ],
)
def test_what_cannot_be_rewritten_is_refused_and_stays(old, before, after):
    assert before in OLD
    text = OLD.replace(before, after)
    old.write_text(text)
    with pytest.raises(SceneError, match=f"{old.name}: cannot be rewritten"):
        upgrade_file(old)
    assert old.read_text() == text
    assert [path.name for path in old.parent.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("written", "kept"),
    [
        ('model = { name = "rbf", placement = "fitted" }', 'model = { name = "rbf" }'),
        ("model = { placement = 'greedy' , name = \"rbf\" }", 'model = { name = "rbf" }'),
        (
            'model = { name = "rbf", placement="greedy", slack = 2 }',
            'model = { name = "rbf", slack_ratio = 2 }',
        ),
        ('model.name = "rbf"\nmodel.nodes = 99', 'model.name = "rbf"\nmodel.nodes = 99'),
        (
            '[defaults.model]\nname = "rbf"\nplacement = "fitted"   # moved',
            '[classes.main.model]\nname = "rbf"',
        ),
    ],
)
def test_the_placement_of_centres_is_dropped(old, written, kept):
    old.write_text(OLD.replace('model = { name = "pbd", slack = 1.3 }', written))
    before = Scene.load(old)
    assert before.muscles[0].model == "rbf" and "placement" not in before.muscles[0].options
    assert upgrade_file(old) and "placement" not in old.read_text()
    assert f"{kept}\n[[muscle]]" in old.read_text()
    same(before, Scene.load(old))


def test_a_ball_of_six_turns_becomes_a_custom_joint():
    axes = {name: [1, 0, k] for k, name in enumerate("abcdef")}
    (joint,) = upgraded({"joint": [{"name": "j", "axes": axes}]})["joint"]
    assert joint["type"] == "custom" and "axes" not in joint
    assert [row["coordinates"] for row in joint["rotations"]] == [[name] for name in axes]


@pytest.mark.parametrize("value", [None, 1, "x", [1], {"a": 1}, [{"attach": [3]}]])
def test_tables_of_another_shape_pass_through(value):
    for key in ("scene", "joint", "muscle", "defaults"):
        upgraded({key: value})


def test_check_rewrites_it_before_it_checks(old, capsys):
    old.write_text(OLD[: OLD.index('[[joint]]\nname = "wrist"')] + OLD[OLD.index("[motion]") :])
    code, out, err = call(capsys, "check", old, "--upgrade", "--json")
    assert code == 0 and json.loads(out)["upgraded"] is True
    assert "rewritten in the form of today" in err and "format = 2" in old.read_text()
