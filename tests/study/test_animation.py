"""Animations of a run, by readers that are not ours: usd-core, VTK, trimesh, Blender, glTF to the letter."""

import json
import os
import struct
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, use_blend_model

from rbfmuscle.run import simulate
from rbfmuscle.study.animation.gltf import write_animated_glb
from rbfmuscle.study.animation.moving import MovingMuscle, MovingRun
from rbfmuscle.study.files.export import export_run
from rbfmuscle.study.files.meshfiles import write_mesh
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.validation import MissingPartError, UsageError

TOLERANCE = 1e-6  # [m]: what single precision holds at a metre, with room
NAMES = ("biceps", "upper", "fore")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A saved run of three frames, in mm."""
    made = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        simulate(arm_scene()).save(made)
    return made


@pytest.fixture(scope="module")
def truth(folder):
    """Vertices of everything in each frame [m], by (name, frame)."""
    saved, found = SavedRun(folder), {}
    for frame in saved.frames:
        found["biceps", frame] = saved.surface("biceps", frame)[0] * 1e-3
        for bone in saved.bones:
            pose = saved.poses[frame][bone]
            found[bone, frame] = (saved.bone(bone)[0] @ pose[:3, :3].T + pose[:3, 3]) * 1e-3
    return found


@pytest.fixture
def changing(folder, tmp_path):
    """The same run, but with another mesh in its last frame."""
    import shutil

    copy = shutil.copytree(folder, tmp_path / "changing")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=9.0)
    write_mesh(copy / "surfaces" / "biceps_0002.vtp", ball.vertices, ball.faces)
    return copy, np.array(ball.vertices), np.array(ball.faces)


class TestUsd:
    @pytest.fixture(autouse=True)
    def _needs_usd(self):
        pytest.importorskip("pxr.UsdGeom")

    def read(self, path):
        from pxr import Usd

        stage = Usd.Stage.Open(str(path))
        return stage, {prim.GetName(): prim for prim in stage.Traverse() if prim.GetTypeName() == "Mesh"}

    def world(self, stage, prim, code):
        from pxr import UsdGeom

        points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code), dtype=float)
        place = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
        world = np.column_stack([points, np.ones(len(points))]) @ place
        return world[:, :3] * UsdGeom.GetStageMetersPerUnit(stage)

    def test_every_vertex_of_every_frame(self, folder, truth, tmp_path):
        (path,) = export_run(folder, "usd", output=tmp_path)
        stage, meshes = self.read(path)
        assert path.suffix == ".usdc"
        assert set(meshes) == set(NAMES)
        for (name, frame), expected in truth.items():
            np.testing.assert_allclose(
                self.world(stage, meshes[name], frame), expected, rtol=0, atol=TOLERANCE
            )

    def test_topology_once_bones_rigid_units_and_axis_told(self, folder, tmp_path):
        from pxr import UsdGeom

        (path,) = export_run(folder, "usd", output=tmp_path, units="cm", up="y")
        stage, meshes = self.read(path)
        assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(0.01)
        assert UsdGeom.GetStageUpAxis(stage) == "Y"
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 2.0)
        muscle, bone = UsdGeom.Mesh(meshes["biceps"]), UsdGeom.Mesh(meshes["fore"])
        assert muscle.GetFaceVertexIndicesAttr().GetNumTimeSamples() == 0
        assert muscle.GetPointsAttr().GetNumTimeSamples() == 3
        assert bone.GetPointsAttr().GetNumTimeSamples() == 0
        assert bone.GetOrderedXformOps()[0].GetNumTimeSamples() == 3
        assert UsdGeom.Mesh(meshes["upper"]).GetOrderedXformOps()[0].GetNumTimeSamples() == 0

    def test_normals_of_bones_once_and_of_muscles_where_asked_for(self, folder, truth, tmp_path):
        from pxr import UsdGeom

        (plain,) = export_run(folder, "usd", output=tmp_path / "plain")
        (smooth,) = export_run(folder, "usd", output=tmp_path / "smooth", values=["normals"])
        assert plain.stat().st_size < smooth.stat().st_size
        before, rough = self.read(plain)
        assert before and not UsdGeom.Mesh(rough["biceps"]).GetNormalsAttr().HasAuthoredValue()
        stage, meshes = self.read(smooth)
        assert set(meshes) == set(NAMES) and stage
        for name in NAMES:
            mesh = UsdGeom.Mesh(meshes[name])
            normals = mesh.GetNormalsAttr()
            assert normals.GetNumTimeSamples() == (3 if name == "biceps" else 0)
            assert mesh.GetNormalsInterpolation() == UsdGeom.Tokens.vertex
            points = np.array(mesh.GetPointsAttr().Get(2), dtype=float)
            faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(2)).reshape(-1, 3)
            crossed = np.cross(
                points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
            )
            expected = np.zeros_like(points)
            for corner in range(3):
                np.add.at(expected, faces[:, corner], crossed)
            expected /= np.linalg.norm(expected, axis=1, keepdims=True)
            assert np.einsum("nd,nd->n", np.array(normals.Get(2)), expected).min() > 0.95

    def test_changing_surface_has_its_topology_at_every_time(self, changing, tmp_path):
        from pxr import UsdGeom

        directory, vertices, faces = changing
        (path,) = export_run(directory, "usd", output=tmp_path)
        stage, meshes = self.read(path)
        np.testing.assert_allclose(self.world(stage, meshes["biceps"], 2), vertices * 1e-3, atol=TOLERANCE)
        numbers = UsdGeom.Mesh(meshes["biceps"]).GetFaceVertexIndicesAttr()
        np.testing.assert_array_equal(np.array(numbers.Get(2)).reshape(-1, 3), faces)
        assert len(numbers.Get(1)) != len(numbers.Get(2))

    def test_names_that_usd_does_not_know_stay_apart(self):
        from rbfmuscle.study.animation.usd import _identifier

        used = set()
        assert [_identifier(name, used) for name in ("a-b", "a_b", "1x", "materials")] == [
            "a_b", "a_b_2", "_x", "materials_2",
        ]  # fmt: skip


def test_usd_without_its_package_is_one_line(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(MissingPartError, match=r"usd-core: pip install -e '\.\[usd\]'") as told:
        export_run(folder, ["ply", "usd"], output=tmp_path)
    assert told.value.exit_code == 7
    assert not list(tmp_path.iterdir())


def read_glb(path):
    """JSON tree of a binary glTF file, and a function that gives the numbers of an accessor, as its standard says."""
    data = Path(path).read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    tree = json.loads(data[20 : 20 + length])
    body = data[28 + length :]
    assert len(body) == tree["buffers"][0]["byteLength"]
    types = {5120: np.int8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def raw(view, offset, dtype, count, columns):
        entry = tree["bufferViews"][view]
        item = np.dtype(dtype).itemsize
        step = entry.get("byteStride", columns * item)
        start = entry["byteOffset"] + offset
        assert start % item == 0
        assert (count - 1) * step + columns * item <= entry["byteLength"]
        shape, strides = (count, columns), (step, item)
        return np.ndarray(shape, dtype, buffer=body, offset=start, strides=strides).copy()

    def numbers(index):
        entry = tree["accessors"][index]
        dtype, columns = types[entry["componentType"]], width[entry["type"]]
        if "bufferView" in entry:
            out = raw(entry["bufferView"], 0, dtype, entry["count"], columns)
        else:
            out = np.zeros((entry["count"], columns), dtype)
        if "sparse" in entry:
            sparse = entry["sparse"]
            where = sparse["indices"]
            rows = raw(where["bufferView"], 0, types[where["componentType"]], sparse["count"], 1)[:, 0]
            out[rows] = raw(sparse["values"]["bufferView"], 0, dtype, sparse["count"], columns)
        if "max" in entry:
            np.testing.assert_array_equal(out.max(axis=0), np.array(entry["max"], dtype))
            np.testing.assert_array_equal(out.min(axis=0), np.array(entry["min"], dtype))
        return out / 127.0 if entry.get("normalized") else out

    return tree, numbers


def morphed(tree, numbers, name, frame):
    """Vertices and normals of a node in the world in a frame, with y up."""
    from scipy.spatial.transform import Rotation

    number = next(k for k, node in enumerate(tree["nodes"]) if node["name"] == name)
    node, animation = tree["nodes"][number], tree["animations"][0]
    primitive = tree["meshes"][node["mesh"]]["primitives"][0]
    moved = {key: numbers(primitive["attributes"][key]).astype(float) for key in ("POSITION", "NORMAL")}
    found = dict(node)
    for channel in animation["channels"]:
        if channel["target"]["node"] == number:
            sampler = animation["samplers"][channel["sampler"]]
            times = numbers(sampler["input"])[:, 0]
            found[channel["target"]["path"]] = numbers(sampler["output"]).reshape(len(times), -1)[frame]
    for target, weight in zip(primitive.get("targets", ()), found.get("weights", ())):
        for key in moved:
            moved[key] += weight * numbers(target[key])
    turn = Rotation.from_quat(found.get("rotation", [0, 0, 0, 1]))
    root = Rotation.from_quat(tree["nodes"][tree["scenes"][0]["nodes"][0]].get("rotation", [0, 0, 0, 1]))
    vertices = root.apply(turn.apply(moved["POSITION"]) + found.get("translation", np.zeros(3)))
    return vertices, root.apply(turn.apply(moved["NORMAL"])), numbers(primitive["indices"]).reshape(-1, 3)


class TestAnimatedGlb:
    def test_every_vertex_of_every_frame(self, folder, truth, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path)
        tree, numbers = read_glb(path)
        for (name, frame), expected in truth.items():
            vertices, _, _ = morphed(tree, numbers, name, frame)
            up = np.column_stack([expected[:, 0], expected[:, 2], -expected[:, 1]])
            np.testing.assert_allclose(vertices, up, rtol=0, atol=TOLERANCE)

    def test_normals_turn_with_the_surface(self, folder, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path, up="y")
        tree, numbers = read_glb(path)
        for frame in range(3):
            vertices, normals, faces = morphed(tree, numbers, "biceps", frame)
            expected = trimesh.Trimesh(vertices, faces, process=False)
            assert expected.volume > 0
            normals /= np.linalg.norm(normals, axis=1)[:, None]
            # Vertex normals are area-weighted here and by angle there; a byte holds half a degree.
            assert np.median(np.einsum("nd,nd->n", normals, expected.vertex_normals)) > 0.999

    def test_trimesh_reads_names_and_the_first_frame(self, folder, truth, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path)
        scene = trimesh.load(path)
        assert set(scene.geometry) == set(NAMES)
        np.testing.assert_allclose(scene.geometry["biceps"].vertices, truth["biceps", 0], atol=TOLERANCE)

    def test_bones_are_nodes_and_what_stands_still_is_sparse(self, folder, tmp_path):
        (path,) = export_run(folder, "animated-glb", output=tmp_path)
        tree, _ = read_glb(path)
        moving = {
            (tree["nodes"][c["target"]["node"]]["name"], c["target"]["path"])
            for c in tree["animations"][0]["channels"]
        }
        assert moving == {("fore", "rotation"), ("fore", "translation"), ("biceps", "weights")}

    def test_few_moved_vertices_are_written_sparse(self, tmp_path):
        ball = trimesh.creation.icosphere(subdivisions=2)
        frames = [np.array(ball.vertices) for _ in range(3)]
        frames[2][7] += [0.1, 0.2, 0.3]
        faces = np.array(ball.faces)
        muscle = MovingMuscle("m", np.ones(3), frames, [faces] * 3, {})
        write_animated_glb(tmp_path / "a.glb", MovingRun("r", "m", np.arange(3.0), [muscle], [], "y"))
        tree, numbers = read_glb(tmp_path / "a.glb")
        accessors = [tree["accessors"][t["POSITION"]] for t in tree["meshes"][0]["primitives"][0]["targets"]]
        assert [a.get("sparse", {}).get("count", 0) for a in accessors] == [0, 1]
        assert not any("bufferView" in a for a in accessors)
        np.testing.assert_allclose(morphed(tree, numbers, "m", 2)[0], frames[2], atol=TOLERANCE)

    def test_a_turn_of_half_keeps_normals_in_their_range(self, tmp_path):
        ball = trimesh.creation.icosphere(subdivisions=2)
        first, faces = np.array(ball.vertices), np.array(ball.faces)
        second = first * [-1.0, -1.0, 1.0]
        muscle = MovingMuscle("m", np.ones(3), [first, second], [faces] * 2, {})
        write_animated_glb(tmp_path / "a.glb", MovingRun("r", "m", np.arange(2.0), [muscle], [], "y"))
        tree, numbers = read_glb(tmp_path / "a.glb")
        _, normals, _ = morphed(tree, numbers, "m", 1)
        size = np.linalg.norm(normals, axis=1)
        seen = size > 0.1  # near the equator all but the direction is lost
        cosines = np.einsum("nd,nd->n", normals, second)[seen] / size[seen]
        assert seen.mean() > 0.5
        assert cosines.min() > 0.99

    def test_changing_surface_is_refused_with_a_remedy(self, changing, tmp_path):
        with pytest.raises(
            UsageError, match=r"'biceps' do not; run with surface = 'material', or export to usd"
        ):
            export_run(changing[0], "animated-glb", output=tmp_path)

    def test_other_units_are_refused(self, folder, tmp_path):
        with pytest.raises(UsageError, match="in metres"):
            export_run(folder, "animated-glb", output=tmp_path, units="mm")


def test_a_page_of_a_run_says_frame_and_coordinates(folder, tmp_path):
    (path,) = export_run(folder, "html", output=tmp_path)
    text = path.read_text(encoding="utf-8")
    assert path.suffix == ".html" and path.parent.name == "html" and '"frame 1: ' in text
    with pytest.raises(UsageError, match="html is in metres by its standard"):
        export_run(folder, "html", output=tmp_path, units="mm")


def test_vtkhdf_holds_every_time(folder, changing, truth, tmp_path):
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
    if not hasattr(hdf, "vtkHDFWriter"):
        pytest.skip("VTK before 9.4 does not write VTKHDF")
    import pyvista

    written = export_run(changing[0], "vtkhdf", output=tmp_path, units="m")
    assert [path.name for path in written] == [f"{name}.vtkhdf" for name in NAMES]
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    reader, key = hdf.vtkHDFReader(), vtkStreamingDemandDrivenPipeline.TIME_STEPS()
    for path, frames in ((written[0], (0, 1, 2)), (written[2], (0, 1, 2))):
        reader.SetFileName(str(path))
        reader.UpdateInformation()
        times = reader.GetOutputInformation(0).Get(key)
        np.testing.assert_allclose(times, np.arange(3) / 24.0, atol=1e-7)  # single precision
        for frame in frames:
            reader.UpdateTimeStep(times[frame])
            points = pyvista.wrap(reader.GetOutputDataObject(0)).points
            other = path == written[0] and frame == 2
            expected = changing[1] * 1e-3 if other else truth[path.stem, frame]
            np.testing.assert_allclose(points, expected, rtol=0, atol=TOLERANCE)


def test_times_of_a_motion_are_those_of_the_files(folder, tmp_path):
    import shutil

    import pyvista

    copy = shutil.copytree(folder, tmp_path / "run")
    info = json.loads((copy / "run.json").read_text())
    info["scene"]["motion"]["times"] = [1.0, 1.25, 2.0]
    (copy / "run.json").write_text(json.dumps(info))
    export_run(copy, ["pvd", "animated-glb"], output=tmp_path / "out")
    assert list(pyvista.get_reader(tmp_path / "out" / "pvd" / "surfaces.pvd").time_values) == [1.0, 1.25, 2.0]
    tree, numbers = read_glb(next((tmp_path / "out" / "animated-glb").iterdir()))
    times = numbers(tree["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, [0.0, 0.25, 1.0])


BLENDER = """
import sys, bpy, numpy as np
usd, glb, truth = sys.argv[1:4]
truth = np.load(truth)
for load, path in ((bpy.ops.wm.usd_import, usd), (bpy.ops.import_scene.gltf, glb)):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    load(filepath=path)
    corners = {}
    for key in truth.files:
        name, frame = key.rsplit(" ", 1)
        bpy.context.scene.frame_set(int(frame))
        shown = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = shown.to_mesh()
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        place = np.array(shown.matrix_world)
        world = points.reshape(-1, 3) @ place[:3, :3].T + place[:3, 3]
        numbers = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", numbers)
        assert np.abs(world - truth[key]).max() < 1e-6, (path, key)
        assert (corners.setdefault(name, numbers) == numbers).all(), (path, key)
    bones = [bpy.data.objects[name] for name in ("upper", "fore")]
    assert not any(bone.modifiers or bone.data.shape_keys for bone in bones), path
print("as ours")
"""


def test_blender_shows_every_vertex_where_it_is(folder, truth, tmp_path):
    """In a Python that has bpy: this one, or the one named by RBFMUSCLE_BPY_PYTHON."""
    python = os.environ.get("RBFMUSCLE_BPY_PYTHON") or (sys.executable if find_spec("bpy") else None)
    if python is None:
        pytest.skip("no bpy here; RBFMUSCLE_BPY_PYTHON may name a Python that has it")
    pytest.importorskip("pxr.UsdGeom")
    usd, glb = export_run(folder, ["usd", "animated-glb"], output=tmp_path)
    np.savez(tmp_path / "truth.npz", **{f"{name} {frame}": points for (name, frame), points in truth.items()})
    (tmp_path / "look.py").write_text(BLENDER)
    command = [python, tmp_path / "look.py", usd, glb, tmp_path / "truth.npz"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.rstrip().endswith("as ours")


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A run with fibres whose muscle has an activation in its metrics."""
    made = tmp_path_factory.mktemp("told")
    scene = arm_scene(fibres={"count": 12, "segments": 6})
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        simulate(scene).save(made)
    with open(made / "metrics.csv", "a", encoding="utf-8") as file:
        file.writelines(f"{k},elbow.flexion,0,biceps,activation,{0.25 * k},1\n" for k in range(3))
    return made


class TestValues:
    """What is told of every vertex."""

    def test_bone_distance_is_that_of_the_bones_where_they_are(self, told, tmp_path):
        import igl

        export_run(told, "ply", output=tmp_path, units="cm", values=["bone_distance"])
        found = trimesh.load(tmp_path / "ply" / "biceps_0002.ply", process=False)
        saved, expected = SavedRun(told), np.inf
        for bone in saved.bones:
            pose = saved.poses[2][bone]
            vertices, faces = saved.bone(bone)
            local = (saved.surface("biceps", 2)[0] - pose[:3, 3]) @ pose[:3, :3]
            signed = igl.signed_distance(local, vertices, faces.astype(np.int64))[0]
            expected = np.minimum(expected, signed)
        values = np.asarray(found.metadata["_ply_raw"]["vertex"]["data"]["bone_distance"]).ravel()
        np.testing.assert_allclose(values, 0.1 * expected, atol=1e-5)  # single precision, [cm]

    def test_stretch_and_activation_in_vtp_keep_to_their_vertices(self, told, tmp_path):
        import pyvista

        export_run(told, "pvd", output=tmp_path, values=["stretch", "activation"])
        first, last = (pyvista.read(tmp_path / "pvd" / f"biceps_000{k}.vtp") for k in (0, 2))
        np.testing.assert_allclose(first.point_data["stretch"], 1.0, atol=1e-12)
        assert np.ptp(last.point_data["stretch"]) > 0.01
        np.testing.assert_array_equal(last.point_data["activation"], 0.5)
        points, _ = SavedRun(told).fibres("biceps", 2)
        start, _ = SavedRun(told).fibres("biceps", 0)
        ratio = np.linalg.norm(np.diff(points, axis=1), axis=2) / np.linalg.norm(
            np.diff(start, axis=1), axis=2
        )
        assert ratio.min() - 1e-9 <= last.point_data["stretch"].min()
        assert last.point_data["stretch"].max() <= ratio.max() + 1e-9

    def test_usd_and_vtkhdf_hold_them_at_every_time(self, told, tmp_path):
        import pyvista

        pytest.importorskip("pxr.UsdGeom")
        from pxr import Usd, UsdGeom

        names = ["stretch", "bone_distance"]
        usd, hdf, *_ = export_run(told, ["usd", "vtkhdf"], output=tmp_path, units="m", values=names)
        export_run(told, "vtp", output=tmp_path, units="m", values=names)
        stage = Usd.Stage.Open(str(usd))
        mesh = next(p for p in stage.Traverse() if p.GetName() == "biceps" and p.GetTypeName() == "Mesh")
        for frame in range(3):
            expected = pyvista.read(tmp_path / "vtp" / f"biceps_000{frame}.vtp").point_data
            for name in names:
                primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(name)
                assert primvar.GetInterpolation() == "vertex"
                np.testing.assert_allclose(primvar.Get(frame), expected[name], rtol=1e-6, atol=1e-8)
        assert set(pyvista.read(hdf).point_data) == set(names)

    def test_what_is_missing_is_said(self, folder, tmp_path):
        for values, said in (
            (["stretch"], "set output.fibres = true"),
            (["activation"], "no muscle contracts"),
            (["strech"], "did you mean 'stretch'"),
        ):
            with pytest.raises(UsageError, match=said):
                export_run(folder, "vtp", output=tmp_path, values=values)
        with pytest.raises(UsageError, match="normals of vertices go into usd, not into ply"):
            export_run(folder, "ply", output=tmp_path, values=["normals"])
        with pytest.raises(UsageError, match="not into animated-glb"):
            export_run(folder, "animated-glb", output=tmp_path, values=["stretch"])
