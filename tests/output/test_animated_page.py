"""The page that turns and scrubs a run: by itself, and with every vertex where it belongs, as three.js has it."""

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.output.animation import page
from rbfmuscle.output.animation.gltf import animated_glb
from rbfmuscle.output.animation.moving import MovingBone, MovingMuscle, MovingRun
from rbfmuscle.validation import MissingPartError, UsageError

CAPTIONS = ["frame 0: knee 0°", "frame 1: knee 10°", "frame 2: knee 20°", "frame 5: knee 30°"]


@pytest.fixture(scope="module")
def moving():
    """A muscle that changes its shape over four frames, a bone that turns and one that stands."""
    ball, box = (
        trimesh.creation.icosphere(subdivisions=2, radius=0.1),
        trimesh.creation.box((0.05, 0.05, 0.3)),
    )
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    shapes = [points * [1.0, 1.0 + 0.1 * k, 1.0 - 0.05 * k] + [0.0, 0.02 * k, 0.0] for k in range(4)]
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.radians([[10.0 * k, 0, 0] for k in range(4)])).as_matrix()
    poses[:, :3, 3] = [[0.0, 0.01 * k, 0.0] for k in range(4)]
    red, white = np.array([0.7, 0.2, 0.2]), np.array([0.9, 0.9, 0.8])
    bones = [
        MovingBone("shin", white, np.array(box.vertices), np.array(box.faces), poses),
        MovingBone("thigh", white, np.array(box.vertices) + 0.3, np.array(box.faces), poses[:1].repeat(4, 0)),
    ]
    muscle = MovingMuscle("calf </script><b>", red, shapes, [faces] * 4)
    return MovingRun("knee & calf", "m", np.array([2, 3, 4, 7]) / 24.0, False, [muscle], bones, "z")


@pytest.fixture(scope="module")
def written(moving, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "knee.html"
    page.write_animated_page(path, moving, CAPTIONS)
    return path


def test_page_names_no_other_address_and_holds_the_animation(written, moving):
    text = written.read_text(encoding="utf-8")
    assert "<title>knee &amp; calf</title>" in text
    assert not re.search(r"<(?:script|img|link)[^>]*\b(?:src|href)=", text) and "@import" not in text
    # The name that holds a closing tag has not closed anything.
    assert len(re.findall(r"<script", text)) == text.count("</script>") == 4 and "<b>" not in text
    model = re.search(r'<script id="model"[^>]*>([^<]*)</script>', text).group(1)
    assert base64.b64decode(model) == animated_glb(moving)
    assert "Three.js Authors" in text  # its licence asks for that


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node.js here")
def test_slider_brings_every_vertex_of_every_frame_to_its_place(written, moving):
    script = Path(__file__).with_name("page_in_node.js")
    ran = subprocess.run(["node", script, written], capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert [frame["caption"] for frame in told["frames"]] == CAPTIONS
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z up to y up
    for k, frame in enumerate(told["frames"]):
        truth = {muscle.name: muscle.vertices[k] for muscle in moving.muscles}
        for bone in moving.bones:
            truth[bone.name] = bone.vertices @ bone.poses[k, :3, :3].T + bone.poses[k, :3, 3]
        assert set(frame["parts"]) == set(truth)
        for name, vertices in truth.items():
            np.testing.assert_allclose(frame["parts"][name], vertices @ up.T, atol=1e-6)
    names = [moving.muscles[0].name, "shin", "thigh"]
    assert told["boxes"] == names and told["hidden"] == names[:1] and told["drawn"] > len(CAPTIONS)


def test_surfaces_that_change_are_refused_with_a_remedy(moving, tmp_path):
    muscle = moving.muscles[0]
    other = MovingMuscle(muscle.name, muscle.colour, muscle.vertices, [f.copy() for f in muscle.faces])
    run = MovingRun(moving.name, "m", moving.times, False, [other], moving.bones, "z")
    with pytest.raises(UsageError, match="html needs surfaces that keep their vertices"):
        page.write_animated_page(tmp_path / "x.html", run, CAPTIONS)
    assert not (tmp_path / "x.html").exists()


@pytest.mark.parametrize("held", [None, b"no archive"])
def test_a_trimesh_without_its_viewer_is_one_line(moving, tmp_path, monkeypatch, held):
    if held is not None:
        (tmp_path / "templates").mkdir()
        (tmp_path / "templates" / "viewer.zip").write_bytes(held)
    monkeypatch.setattr(page.resources, "files", lambda name: tmp_path)
    with pytest.raises(MissingPartError, match="takes its viewer from trimesh"):
        page.write_animated_page(tmp_path / "x.html", moving, CAPTIONS)
