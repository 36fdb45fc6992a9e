"""The picture of a scene at rest: what is marked is what is there."""

import numpy as np
from PIL import Image

from rbfmuscle.cli.app import run_command as command
from rbfmuscle.report.render import draw_scene
from rbfmuscle.scene.phantom import phantom_scene


def test_picture_shows_bones_and_patches_in_their_colours(tmp_path):
    draw_scene(phantom_scene(spacing=6.0), tmp_path / "scene.png")
    image = np.asarray(Image.open(tmp_path / "scene.png").convert("RGB"), dtype=int)
    # The pelvis is pale rose and the femur pale indigo: both are in every one of the four views.
    for view in np.array_split(image[40:860], 4, axis=1):
        assert (view.min(axis=2) < 245).mean() > 0.05
        assert (view[..., 0] - view[..., 2] > 15).mean() > 0.01
        assert (view[..., 2] - view[..., 0] > 5).mean() > 0.01


def test_command_writes_it_beside_the_scene(tmp_path, capsys):
    scene = phantom_scene(spacing=6.0)
    for item in scene.bones + scene.muscles:
        item.mesh.export(tmp_path / f"{item.name}.ply")
    assert command(["new", str(tmp_path), "--units", "mm"]) == 0
    assert command(["check", str(tmp_path / "scene.toml"), "--picture"]) == 0
    assert (tmp_path / "scene.png").is_file()
    assert f"{tmp_path / 'scene.png'}\n" in capsys.readouterr().out
