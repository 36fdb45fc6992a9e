"""The page that turns and scrubs a run: by itself, and with every vertex where it belongs."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.output.animation import page
from rbfmuscle.output.animation.moving import MovingBone, MovingMuscle, MovingRun

CAPTIONS = ["frame 0, knee 0°", "frame 1, knee 10°", "frame 2, knee 20°", "frame 5, knee 30°"]


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
    red, white = np.array([0.7, 0.2, 0.2]), np.array([0.9, 0.9, 0.8])
    bones = [
        MovingBone("shin", white, np.array(box.vertices), np.array(box.faces), poses),
        MovingBone("thigh", white, np.array(box.vertices) + 300, np.array(box.faces), poses[:1].repeat(4, 0)),
    ]
    muscles = [
        MovingMuscle("calf </script><b>", red, shapes, [faces] * 4),
        MovingMuscle("knee", red, other, kinds),
    ]
    return MovingRun("knee & calf", "mm", np.array([2, 3, 4, 7]) / 24.0, False, muscles, bones, "z")


@pytest.fixture(scope="module")
def written(moving, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "knee.html"
    page.write_animated_page(path, moving, CAPTIONS)
    return path


def unpacked(data):
    """Vertices of each part in each frame and its faces, as the script in the page takes them from the data."""
    stream, at, found = zlib.decompress(base64.b64decode(data["bytes"])), 0, {}

    def whole(count, kind):
        nonlocal at
        size = np.dtype(kind).itemsize
        raw = np.frombuffer(stream, np.uint8, count * size, at).reshape(size, count)
        at += count * size
        return np.frombuffer(raw.T.tobytes(), kind)

    for part in data["parts"]:
        frames, faces = [], []
        for piece in part["pieces"]:
            moved = whole(piece["frames"] * piece["points"] * 3, "<i2").reshape(piece["frames"], -1, 3)
            for axis in (1, 0, 0):
                moved = np.cumsum(moved, axis=axis, dtype=np.int16)
            frames += list(moved * data["step"] + data["origin"])
            faces += [np.cumsum(whole(piece["faces"] * 3, "<i4")).reshape(-1, 3)] * piece["frames"]
        poses = np.array(part.get("poses", [np.eye(4)[:3].ravel()])).reshape(-1, 3, 4)
        found[part["name"]] = frames, faces, poses
    assert at == len(stream)
    return found


def shown_data(path):
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script id="scene"[^>]*>(.*?)</script>', text, re.DOTALL).group(1))


def test_page_names_no_other_address_and_no_name_closes_a_script(written):
    text = written.read_text(encoding="utf-8")
    assert "<title>knee &amp; calf</title>" in text
    assert not re.search(r"<(?:script|img|link)[^>]*\b(?:src|href)=|@import|https?://(?!www\.w3\.org)", text)
    assert len(re.findall(r"<script", text)) == text.count("</script>") == 2 and "<b>" not in text


def test_every_vertex_of_every_frame_is_within_half_a_step(written, moving):
    data = shown_data(written)
    assert data["captions"] == CAPTIONS and data["up"] == "z"
    found = unpacked(data)
    assert list(found) == [moving.muscles[0].name, "shin", "thigh"]
    away = 0.51 * data["step"] * np.ones(3)
    for k in range(4):
        frames, faces, _ = found[moving.muscles[0].name]
        assert (np.abs(frames[k] - moving.muscles[0].vertices[k]) < away).all()
        np.testing.assert_array_equal(faces[k], moving.muscles[0].faces[k])
        for bone in moving.bones:
            (vertices,), (triangles,), poses = found[bone.name]
            pose = poses[min(k, len(poses) - 1)]
            np.testing.assert_allclose(pose, bone.poses[k, :3], atol=1e-6)
            assert (np.abs(vertices - bone.vertices) < away).all()
            np.testing.assert_array_equal(triangles, bone.faces)


def test_surfaces_that_change_have_their_faces_in_each_frame(moving, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    muscle = moving.muscles[0]
    shapes = [*muscle.vertices[:3], np.array(ball.vertices)]
    changing = MovingMuscle("calf", muscle.colour, shapes, [*muscle.faces[:3], np.array(ball.faces)])
    page.write_animated_page(
        tmp_path / "x.html", MovingRun("x", "m", moving.times, False, [changing], moving.bones, "z"), CAPTIONS
    )
    frames, faces, _ = unpacked(shown_data(tmp_path / "x.html"))["calf"]
    assert [len(points) for points in frames] == [len(points) for points in shapes]
    np.testing.assert_array_equal(faces[3], ball.faces)
