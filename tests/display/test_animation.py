"""Animations of a run, by readers that are not ours: usd-core, trimesh, glTF to the letter."""

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.display import animation as page
from rbfmuscle.display.animation import AnimatedMesh, Animation
from rbfmuscle.display.export import _key_name, export_run
from rbfmuscle.display.page import ReportPage
from rbfmuscle.recording import Run
from rbfmuscle.run.data import frame_caption
from rbfmuscle.run.vtk_files import write_vtp
from rbfmuscle.validation import MissingDependencyError, UsageError

TOLERANCE = 1e-6  # [m]: what single precision holds at a metre, with room
TIMES = [1.0, 1.25, 2.0, 2.5, 3.0, 4.0, 4.25]


@pytest.fixture(scope="module")
def folder(arm_run):
    return arm_run[1]


@pytest.fixture(scope="module")
def truth(folder):
    """Vertices of everything in each frame [m], by (name, frame)."""
    saved, found = Run.load(folder), {}
    for frame in saved.frame_numbers:
        found["biceps", frame] = saved.mesh("biceps", frame)[0] * 1e-3
        for bone in saved.bones:
            pose = saved.frame(frame).poses[bone]
            found[bone, frame] = (saved.meshes.bone(bone)[0] @ pose[:3, :3].T + pose[:3, 3]) * 1e-3
    return found


@pytest.fixture
def changing(folder, tmp_path):
    """The same run, but with another mesh in its last frame."""
    copy = shutil.copytree(folder, tmp_path / "changing")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=9.0)
    write_vtp(copy / "surfaces" / "biceps_0006.vtp", ball.vertices, ball.faces)
    return copy, np.array(ball.vertices), np.array(ball.faces)


class TestUsd:
    def read(self, path):
        from pxr import Usd

        stage = Usd.Stage.Open(str(path))
        return stage, {
            prim.GetName(): prim for prim in stage.Traverse() if prim.GetTypeName() == "Mesh"
        }

    def world(self, stage, prim, code):
        from pxr import UsdGeom

        points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code), dtype=float)
        place = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
        world = np.column_stack([points, np.ones(len(points))]) @ place
        return world[:, :3] * UsdGeom.GetStageMetersPerUnit(stage)

    def test_every_vertex_of_every_frame(self, folder, truth, tmp_path):
        from pxr import UsdGeom

        (path,) = export_run(folder, "usd", output=tmp_path, units="cm")
        stage, meshes = self.read(path)
        assert path.suffix == ".usdc" and set(meshes) == {"biceps", "upper", "fore"}
        for (name, frame), expected in truth.items():
            found = self.world(stage, meshes[name], frame)
            np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE)
        assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(0.01)
        assert UsdGeom.GetStageUpAxis(stage) == "Z"
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 6.0)
        muscle, moved, still = (UsdGeom.Mesh(meshes[name]) for name in ("biceps", "fore", "upper"))
        numbers = [muscle.GetFaceVertexIndicesAttr(), muscle.GetPointsAttr(), moved.GetPointsAttr()]
        numbers += [bone.GetOrderedXformOps()[0] for bone in (moved, still)]
        # Topology once, bones rigid.
        assert [samples.GetNumTimeSamples() for samples in numbers] == [0, 7, 0, 7, 0]

    def test_default_values_are_those_of_the_first_frame(self, folder, truth, tmp_path):
        from pxr import Usd, UsdGeom

        (path,) = export_run(folder, "usd", output=tmp_path)
        stage, meshes = self.read(path)
        for name, prim in meshes.items():
            found = self.world(stage, prim, Usd.TimeCode.Default())
            np.testing.assert_allclose(found, truth[name, 0], rtol=0, atol=TOLERANCE)
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get())
            extent = np.array(UsdGeom.Mesh(prim).GetExtentAttr().Get())
            np.testing.assert_array_equal(extent, [points.min(axis=0), points.max(axis=0)])
            assert len(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get())

    def test_changing_surface_has_its_topology_at_every_time(self, changing, tmp_path):
        from pxr import UsdGeom

        directory, vertices, faces = changing
        (path,) = export_run(directory, "usd", output=tmp_path)
        stage, meshes = self.read(path)
        np.testing.assert_allclose(
            self.world(stage, meshes["biceps"], 6), vertices * 1e-3, atol=TOLERANCE
        )
        numbers = UsdGeom.Mesh(meshes["biceps"]).GetFaceVertexIndicesAttr()
        np.testing.assert_array_equal(np.array(numbers.Get(6)).reshape(-1, 3), faces)
        assert len(numbers.Get(1)) != len(numbers.Get(6))


def test_usd_without_its_package_is_one_line_after_the_others(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(
        MissingDependencyError, match=r"usd-core: pip install -e '\.\[usd\]'"
    ) as told:
        export_run(folder, ["ply", "usd"], output=tmp_path)
    assert told.value.exit_code == 7
    assert set(told.value.written) == set((tmp_path / "ply").iterdir()) != set()
    with pytest.raises(MissingDependencyError):
        export_run(folder, "usd", output=tmp_path / "alone")
    assert not (tmp_path / "alone").exists()


def read_glb(path):
    """JSON tree of a binary glTF file, and a function that gives the numbers of an accessor, as its
    standard says.
    """
    data = Path(path).read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    tree = json.loads(data[20 : 20 + length])
    body = data[28 + length :]
    assert len(body) == tree["buffers"][0]["byteLength"]
    types = {5125: np.uint32, 5126: np.float32}
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def raw(view, offset, dtype, count, columns):
        entry, item = tree["bufferViews"][view], np.dtype(dtype).itemsize
        step = entry.get("byteStride", columns * item)
        start = entry["byteOffset"] + offset
        assert start % item == 0
        assert (count - 1) * step + columns * item <= entry["byteLength"]
        return np.ndarray((count, columns), dtype, body, start, (step, item)).copy()

    def numbers(index):
        entry = tree["accessors"][index]
        dtype, columns = types[entry["componentType"]], width[entry["type"]]
        out = raw(entry["bufferView"], 0, dtype, entry["count"], columns)
        if "max" in entry:
            np.testing.assert_array_equal(out.max(axis=0), np.array(entry["max"], dtype))
            np.testing.assert_array_equal(out.min(axis=0), np.array(entry["min"], dtype))
        return out

    return tree, numbers


def morphed(tree, numbers, name, frame):
    """Vertices and normals of a node in the world in a frame, with y up."""
    number = next(k for k, node in enumerate(tree["nodes"]) if node["name"] == name)
    node, animation = tree["nodes"][number], tree["animations"][0]
    primitive = tree["meshes"][node["mesh"]]["primitives"][0]
    moved = {
        key: numbers(primitive["attributes"][key]).astype(float) for key in ("POSITION", "NORMAL")
    }
    found = dict(node)
    for channel in animation["channels"]:
        if channel["target"]["node"] == number:
            sampler = animation["samplers"][channel["sampler"]]
            times = numbers(sampler["input"])[:, 0]
            found[channel["target"]["path"]] = numbers(sampler["output"]).reshape(len(times), -1)[
                frame
            ]
    for target, weight in zip(primitive.get("targets", ()), found.get("weights", ())):
        for key in moved:
            moved[key] += weight * numbers(target[key])
    turn = Rotation.from_quat(found.get("rotation", [0, 0, 0, 1]))
    root = Rotation.from_quat(
        tree["nodes"][tree["scenes"][0]["nodes"][0]].get("rotation", [0, 0, 0, 1])
    )
    vertices = root.apply(turn.apply(moved["POSITION"]) + found.get("translation", np.zeros(3)))
    return (
        vertices,
        root.apply(turn.apply(moved["NORMAL"])),
        numbers(primitive["indices"]).reshape(-1, 3),
    )


class TestAnimatedGlb:
    def test_every_vertex_of_every_frame(self, folder, truth, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path)
        tree, numbers = read_glb(path)
        for (name, frame), expected in truth.items():
            vertices, _, _ = morphed(tree, numbers, name, frame)
            up = np.column_stack([expected[:, 0], expected[:, 2], -expected[:, 1]])
            np.testing.assert_allclose(vertices, up, rtol=0, atol=TOLERANCE)

    def test_shape_keys_have_the_captions_of_their_frames(self, folder, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path, frames=slice(1, None, 2))
        tree, _ = read_glb(path)
        (mesh,) = [mesh for mesh in tree["meshes"] if mesh["name"] == "biceps"]
        saved = Run.load(folder)
        assert mesh["extras"]["targetNames"] == [frame_caption(saved, 3), frame_caption(saved, 5)]
        assert len(_key_name("°" * 40).encode()) == 62  # Blender keeps 63 bytes

    def test_frames_per_second_are_those_asked_for(self, folder, tmp_path):
        for fps, wanted in ((None, 24.0), (30.0, 30.0)):
            out = tmp_path / str(fps)
            (path,) = export_run(
                folder, "animated-glb", output=out, frames=slice(1, None, 2), fps=fps
            )
            tree, numbers = read_glb(path)
            times = numbers(tree["animations"][0]["samplers"][0]["input"])[:, 0]
            np.testing.assert_allclose(times, np.array([0, 2, 4]) / wanted, rtol=1e-6)
        for wrong in ({"formats": "ply", "fps": 30.0}, {"formats": "usd", "fps": 0.0}):
            with pytest.raises(UsageError, match="fps"):
                export_run(folder, output=tmp_path / "no", **wrong)

    def test_changing_surface_is_refused_with_a_remedy(self, changing, tmp_path):
        with pytest.raises(UsageError, match=r"'biceps' do not; run with surface = 'material'"):
            export_run(changing[0], "animated-glb", output=tmp_path)


def test_files_with_y_up_or_z_up_stand_upright_whatever_the_data(folder, truth, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "run")
    info = json.loads((copy / "run.json").read_text(encoding="utf-8"))
    info["scene"] |= {"superior": [1.0, 0, 0], "anterior": [0, 0, -1.0]}
    (copy / "run.json").write_text(json.dumps(info))
    (path,) = export_run(copy, "animated-glb", output=tmp_path)
    tree, numbers = read_glb(path)
    x, y, z = truth["biceps", 1].T
    upright = np.column_stack([y, x, -z])
    np.testing.assert_allclose(
        morphed(tree, numbers, "biceps", 1)[0], upright, rtol=0, atol=TOLERANCE
    )
    (path,) = export_run(copy, "usd", output=tmp_path)
    stage, meshes = TestUsd().read(path)
    found = TestUsd().world(stage, meshes["biceps"], 1)
    np.testing.assert_allclose(found, np.column_stack([y, z, x]), rtol=0, atol=TOLERANCE)


def test_times_of_a_motion_are_those_of_the_files(folder, tmp_path):
    import pyvista

    copy = shutil.copytree(folder, tmp_path / "run")
    info = json.loads((copy / "run.json").read_text(encoding="utf-8"))
    info["scene"]["motion"]["times"] = TIMES
    (copy / "run.json").write_text(json.dumps(info))
    export_run(copy, ["pvd", "animated-glb"], output=tmp_path / "out")
    assert list(pyvista.get_reader(tmp_path / "out" / "pvd" / "surfaces.pvd").time_values) == TIMES
    tree, numbers = read_glb(next((tmp_path / "out" / "animated-glb").iterdir()))
    times = numbers(tree["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.array(TIMES) - 1.0)


def test_names_that_usd_does_not_know_stay_apart():
    from rbfmuscle.display.export import identifier

    used = set()
    assert [identifier(name, used) for name in ("a-b", "a_b", "1x")] == ["a_b", "a_b_2", "_x"]


CAPTIONS = ["frame 0: knee 0°", "frame 1: knee 10°", "frame 2: knee 20°", "frame 5: knee 30°"]


@pytest.fixture(scope="module")
def moving():
    """Two muscles over four frames, one with other triangles in the last two; a bone that turns and
    one that stands.
    """
    ball, box = (
        trimesh.creation.icosphere(subdivisions=2, radius=100),
        trimesh.creation.box((50, 50, 300)),
    )
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    shapes = [
        points * [1.0, 1.0 + 0.1 * k, 1.0 - 0.05 * k] + [0.0, 20.0 * k, 0.0] for k in range(4)
    ]
    cube = trimesh.creation.box((80, 80, 80))
    other = [*shapes[:2], np.array(cube.vertices), np.array(cube.vertices) + 5.0]
    kinds = [faces, faces, np.array(cube.faces), np.array(cube.faces)]
    kinds[1], kinds[3] = kinds[0], kinds[2]
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(
        np.radians([[10.0 * k, 0, 0] for k in range(4)])
    ).as_matrix()
    poses[:, :3, 3] = [[0.0, 10.0 * k, 0.0] for k in range(4)]
    corners, sides = np.array(box.vertices), [np.array(box.faces)]
    bones = [
        AnimatedMesh("shin", "#e9e0cd", [corners], sides, poses),
        AnimatedMesh("thigh", "#e9e0cd", [corners + 300], sides, poses[:1].repeat(4, 0)),
    ]
    muscles = [
        AnimatedMesh("calf </script><b>", "#cc6677", shapes, [faces] * 4),
        AnimatedMesh("knee", "#cc6677", other, kinds),
    ]
    times = np.array([2, 3, 4, 7]) / 24.0
    right = np.array([-1.0, 0.0, 0.0])
    return Animation("knee & calf", "mm", times, False, CAPTIONS, muscles, bones, np.eye(3), right)


@pytest.fixture(scope="module")
def written(moving, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "knee.html"
    ReportPage("knee & calf", [], "", scene=page.pack_runs({"": moving})).write(path)
    return path


def test_no_name_ends_the_script_that_holds_it(written):
    text = written.read_text(encoding="utf-8")
    assert text.count("<script") == text.count("</script>") == 3 and "<b>" not in text


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node.js here")
def test_every_vertex_and_triangle_of_every_frame_is_unpacked(written, moving):
    script = Path(__file__).with_name("page_in_node.js")
    ran = subprocess.run(
        ["node", script, written], capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert found["captions"] == CAPTIONS and found["panels"] == [""]
    parts = {part["name"]: part for part in found["parts"]}
    assert list(parts) == [*(m.name for m in moving.muscles), "shin", "thigh"]
    # Half a step, of which 30,000 are the longest side: 450 mm.
    for muscle in moving.muscles:
        frames = []
        for piece in parts[muscle.name]["pieces"]:
            corners = np.reshape(piece["corners"], (-1, 3))
            frames += [(p, corners) for p in np.reshape(piece["places"], (piece["frames"], -1, 3))]
        for truth, faces, found_frame in zip(muscle.vertices, muscle.faces, frames, strict=True):
            np.testing.assert_allclose(found_frame[0], truth, atol=0.02)
            np.testing.assert_array_equal(found_frame[1], faces)
    assert [len(parts[m.name]["pieces"]) for m in moving.muscles] == [1, 2]
    for bone in moving.bones:
        part = parts[bone.name]
        places = np.reshape(part["pieces"][0]["places"], (-1, 3))
        np.testing.assert_allclose(places, bone.vertices[0], atol=0.02)
        poses = np.reshape(part["poses"], (-1, 3, 4))
        np.testing.assert_allclose(poses, bone.poses[: len(poses), :3], atol=1e-6)
        assert len(poses) == (4 if bone.moves else 1)
