"""A scene that is saved loads as the same scene."""

import json

import numpy as np
import pytest
import trimesh
from command_line import call
from rich_scene import built, rich

import rbfmuscle as rm
from rbfmuscle.run.info import record_scene
from rbfmuscle.scene.objects import Motion

FROM_FILES = ("file", "mesh", "mended")  # what the record of a scene says of where its files lie


def facts(value):
    """The record of a scene without what says where its files lie."""
    if isinstance(value, dict):
        return {key: facts(item) for key, item in value.items() if key not in FROM_FILES}
    return [facts(item) for item in value] if isinstance(value, (list, tuple)) else value


def test_a_saved_scene_loads_as_the_same_scene(tmp_path):
    scene = rich()
    again = rm.Scene.load(scene.save(tmp_path / "arm.toml"))
    assert facts(record_scene(again)) == facts(json.loads(json.dumps(record_scene(scene))))
    assert again.motion.frames == scene.motion.frames
    for ours, theirs in zip(scene.muscles, again.muscles, strict=True):
        for one, other in zip(ours.attachments, theirs.attachments, strict=True):
            assert np.array_equal(one.vertices, other.vertices) and one.via == other.via
    assert np.array_equal(again.muscles[0].fibres, scene.muscles[0].fibres)
    (end,) = again.muscle("second").tendons
    assert end.length == scene.muscle("second").tendons[0].length


def test_a_saved_scene_reaches_the_command_line_and_replaces_nothing(tmp_path, capsys):
    path = rm.phantom_scene(spacing=6.0).save(tmp_path / "hip.toml")
    code, out, _ = call(capsys, "check", path)
    assert code == 0 and "extensor" in out
    text = path.read_text()
    with pytest.raises(rm.UsageError, match="is there already"):
        rm.Scene("other").save(path)
    assert path.read_text() == text


def test_a_scene_that_cannot_be_saved_leaves_nothing_and_is_saved_at_the_next_try(
    tmp_path, monkeypatch
):
    scene = rich()
    written = []

    def full(file, vertices, **options):
        written.append(file)
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savetxt", full)
        with pytest.raises(OSError, match="No space"):
            scene.save(tmp_path / "arm.toml")
    assert written and not list(tmp_path.iterdir())
    with pytest.raises(ValueError):  # an impossible value, met while the text is written
        scene.save(tmp_path / "arm.toml", comment="\ud800")
    assert not list(tmp_path.iterdir())
    assert rm.Scene.load(scene.save(tmp_path / "arm.toml")).name == "arm"


def test_a_scene_without_motion_is_saved_where_rest_is_not_zero(tmp_path):
    scene = built()
    scene.add_bone("tip")
    turn = {"bend": {"rest": 20.0}}
    axes = {"bend": [0, 1, 0]}
    scene.add_joint("wrist", "lower", "tip", (90, 0, 0), axes, type="hinge", coordinates=turn)
    again = rm.Scene.load(scene.save(tmp_path / "arm.toml"))
    assert again.motion.frames[0] == pytest.approx({"wrist.bend": np.radians(20.0)})


def test_several_settings_of_a_motion_are_one_motion():
    scene = rich().with_options({"motion.step": 5, "motion.ramp.elbow.flexion.to": 10})
    assert np.degrees([frame["elbow.flexion"] for frame in scene.motion.frames]) == pytest.approx(
        [0.0, 5.0, 10.0]
    )


def test_frames_of_no_table_and_files_of_another_kind_are_refused(tmp_path):
    scene = built()
    scene.motion = Motion([{}, {"elbow.flexion": 0.1}])
    with pytest.raises(rm.SceneError, match="set_motion"):
        scene.save(tmp_path / "arm.toml")
    with pytest.raises(rm.UsageError, match=r"ends in \.toml"):
        built().save(tmp_path / "arm.json")
    assert list(tmp_path.iterdir()) == []


def test_open_bones_stay_open(tmp_path):
    scene = built()
    box = trimesh.creation.box((40, 40, 40)).apply_translation([0, 0, 90])
    scene.add_bone("shell", trimesh.Trimesh(box.vertices, box.faces[2:]))
    again = rm.Scene.load(scene.save(tmp_path / "arm.toml"))
    assert [bone.closed for bone in again.bones] == [bone.closed for bone in scene.bones]
