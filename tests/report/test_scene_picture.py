"""The picture of a scene at rest: what is marked is what is there."""

import numpy as np
from PIL import Image

from rbfmuscle.cli.app import run_command as command
from rbfmuscle.report.scene_picture import draw_scene, write_parts
from rbfmuscle.scene.phantom import phantom_scene


def test_patches_far_ends_and_overlaps_are_those_of_the_scene(tmp_path):
    scene = phantom_scene(spacing=6.0)
    facts = write_parts(scene, tmp_path)
    assert facts["far"] == [] and facts["overlaps"] == []
    assert [joint["name"] for joint in facts["joints"]] == ["hip"] and len(facts["joints"][0]["axes"]) == 3
    muscle = scene.muscles[0]
    with np.load(tmp_path / "parts.npz") as parts:
        attached_bone = parts["muscle0h"]
    for attachment in muscle.attachments:
        assert (attached_bone[attachment.vertices] == facts["bones"].index(attachment.bone)).all()
    assert (attached_bone >= 0).sum() == sum(len(a.vertices) for a in muscle.attachments)

    away = muscle.mesh.copy()
    away.apply_translation([-400.0, 0, 0])
    muscle.mesh = away
    inside = scene.muscles[1].mesh.copy()
    inside.apply_translation(np.asarray(scene.bones[1].mesh.centroid) - inside.centroid)
    scene.muscles[1].mesh = inside
    facts = write_parts(scene, tmp_path)
    far = {(one["muscle"], one["bone"]): one["gap"] for one in facts["far"]}
    assert all(250.0 < far[muscle.name, a.bone] < 410.0 for a in muscle.attachments)
    assert ("femur", scene.muscles[1].name) in {(one["bone"], one["muscle"]) for one in facts["overlaps"]}


def test_picture_shows_bones_in_their_pale_colours(graphics, tmp_path):
    found = draw_scene(phantom_scene(spacing=6.0), tmp_path / "scene.png")
    assert found == {"far_ends": 0, "overlaps": 0}
    image = np.asarray(Image.open(tmp_path / "scene.png").convert("RGB"), dtype=int)
    views = np.array_split(image[40:1000], 3, axis=1)
    assert all((view.min(axis=2) < 245).mean() > 0.05 for view in views)
    # The pelvis is pale red and the femur pale blue: both are in every view.
    for view in views:
        assert (view[..., 0] - view[..., 2] > 15).mean() > 0.01 and (
            view[..., 2] - view[..., 0] > 5
        ).mean() > 0.01


def test_command_writes_it_beside_the_scene(graphics, tmp_path, capsys):
    scene = phantom_scene(spacing=6.0)
    for item in scene.bones + scene.muscles:
        item.mesh.export(tmp_path / f"{item.name}.ply")
    assert command(["new", str(tmp_path), "--units", "mm"]) == 0
    assert command(["check", str(tmp_path / "scene.toml"), "--picture"]) == 0
    assert (tmp_path / "scene.png").is_file()
    assert f"{tmp_path / 'scene.png'}: " in capsys.readouterr().out
