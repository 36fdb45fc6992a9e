"""The moving scene of a page: every vertex of every frame unpacked to its place, and no name ends its script."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.output.animation import page
from rbfmuscle.output.saved import MovingPart, MovingRun
from rbfmuscle.report.page import Page

CAPTIONS = ["frame 0: knee 0°", "frame 1: knee 10°", "frame 2: knee 20°", "frame 5: knee 30°"]


@pytest.fixture(scope="module")
def moving():
    """Two muscles over four frames, one with other triangles in the last two; a bone that turns and one that stands."""
    ball, box = trimesh.creation.icosphere(subdivisions=2, radius=100), trimesh.creation.box((50, 50, 300))
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    shapes = [points * [1.0, 1.0 + 0.1 * k, 1.0 - 0.05 * k] + [0.0, 20.0 * k, 0.0] for k in range(4)]
    cube = trimesh.creation.box((80, 80, 80))
    other = [*shapes[:2], np.array(cube.vertices), np.array(cube.vertices) + 5.0]
    kinds = [faces, faces, np.array(cube.faces), np.array(cube.faces)]
    kinds[1], kinds[3] = kinds[0], kinds[2]
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.radians([[10.0 * k, 0, 0] for k in range(4)])).as_matrix()
    poses[:, :3, 3] = [[0.0, 10.0 * k, 0.0] for k in range(4)]
    bones = [
        MovingPart("shin", "#e9e0cd", [np.array(box.vertices)], [np.array(box.faces)], poses),
        MovingPart(
            "thigh", "#e9e0cd", [np.array(box.vertices) + 300], [np.array(box.faces)], poses[:1].repeat(4, 0)
        ),
    ]
    muscles = [
        MovingPart("calf </script><b>", "#cc6677", shapes, [faces] * 4),
        MovingPart("knee", "#cc6677", other, kinds),
    ]
    times = np.array([2, 3, 4, 7]) / 24.0
    right = np.array([-1.0, 0.0, 0.0])
    return MovingRun("knee & calf", "mm", times, False, CAPTIONS, muscles, bones, np.eye(3), right)


@pytest.fixture(scope="module")
def written(moving, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "knee.html"
    Page("knee & calf", [], "", scene=page.pack_runs({"": moving})).write(path)
    return path


def test_no_name_ends_the_script_that_holds_it(written):
    text = written.read_text(encoding="utf-8")
    assert text.count("<script") == text.count("</script>") == 3 and "<b>" not in text


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node.js here")
def test_every_vertex_and_triangle_of_every_frame_is_unpacked(written, moving):
    script = Path(__file__).with_name("page_in_node.js")
    ran = subprocess.run(["node", script, written], capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert found["captions"] == CAPTIONS and found["panels"] == [""]
    parts = {part["name"]: part for part in found["parts"]}
    assert list(parts) == [*(m.name for m in moving.muscles), "shin", "thigh"]
    # Half a step, of which 30,000 are the longest side: 450 mm.
    for muscle in moving.muscles:
        pieces = parts[muscle.name]["pieces"]
        frames = [
            frame for piece in pieces for frame in np.reshape(piece["places"], (piece["frames"], -1, 3))
        ]
        corners = [piece["corners"] for piece in pieces for _ in range(piece["frames"])]
        for truth, faces, points, found_faces in zip(
            muscle.vertices, muscle.faces, frames, corners, strict=True
        ):
            np.testing.assert_allclose(points, truth, atol=0.02)
            np.testing.assert_array_equal(np.reshape(found_faces, (-1, 3)), faces)
    assert [len(parts[m.name]["pieces"]) for m in moving.muscles] == [1, 2]
    for bone in moving.bones:
        part = parts[bone.name]
        np.testing.assert_allclose(
            np.reshape(part["pieces"][0]["places"], (-1, 3)), bone.vertices[0], atol=0.02
        )
        poses = np.reshape(part["poses"], (-1, 3, 4))
        np.testing.assert_allclose(poses, bone.poses[: len(poses), :3], atol=1e-6)
        assert len(poses) == (4 if bone.moves else 1)
