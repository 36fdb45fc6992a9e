"""Files against readers that are not ours: pyvista and trimesh."""

import json
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista
import trimesh
from blend_model import arm_files

from rbfmuscle.cli.options import one_line
from rbfmuscle.display.export import _file_name, export_run
from rbfmuscle.geometry.surfaces import simplified
from rbfmuscle.recording import Run, simulate
from rbfmuscle.run.info import FORMAT
from rbfmuscle.run.vtk_files import Collection, read_vtp, write_vtp
from rbfmuscle.run.writer import write_json
from rbfmuscle.validation import MeshError, UsageError


@pytest.fixture
def mesh():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=7.3)
    return np.array(sphere.vertices) + [1000 / 3, -20, 4], np.array(sphere.faces)


class TestVtp:
    @pytest.mark.parametrize("kind", [np.float64, np.float32])
    def test_pyvista_and_our_reader_read_the_same_numbers(self, tmp_path, mesh, kind):
        path, vertices = tmp_path / "a.vtp", mesh[0].astype(kind)
        write_vtp(path, vertices, mesh[1])
        data, (points, faces) = pyvista.read(path), read_vtp(path)
        np.testing.assert_array_equal(points, data.points)
        np.testing.assert_array_equal(faces, data.regular_faces)
        np.testing.assert_array_equal(faces, mesh[1])
        np.testing.assert_array_equal(data.points, vertices)
        assert data.points.dtype == kind

    def test_arrays_that_vary_and_that_do_not_are_read_by_pyvista(self, tmp_path, mesh):
        count = len(mesh[0])
        arrays = {"one": np.full(count, 3.0), "many": np.linspace(0.0, 1.0, count)}
        write_vtp(tmp_path / "a.vtp", *mesh, arrays)
        data = pyvista.read(tmp_path / "a.vtp")
        for name, values in arrays.items():
            np.testing.assert_array_equal(data.point_data[name], values.astype(np.float32))

    @pytest.mark.parametrize("size", [0, 40, 900, 9000])
    def test_a_file_that_is_cut_off_is_refused(self, tmp_path, mesh, size):
        path = tmp_path / "a.vtp"
        write_vtp(path, *mesh)
        path.write_bytes(path.read_bytes()[:size])
        with pytest.raises(MeshError, match="damaged or was not written by a run"):
            read_vtp(path)
        with pytest.raises(MeshError, match=r"none\.vtp is missing"):
            read_vtp(tmp_path / "none.vtp")


class TestCollections:
    def test_pyvista_finds_the_names_of_what_a_run_and_an_export_write(self, arm_run, tmp_path):
        """It reads no names of a collection's blocks."""
        export_run(arm_run[1], "pvd", output=tmp_path / "export")
        for folder in (arm_run[1], tmp_path / "export" / "pvd"):
            for file, names in (("surfaces", ["biceps"]), ("bones", ["upper", "fore"])):
                blocks = pyvista.read(folder / f"{file}.pvd")
                assert [str(block.field_data["name"][0]) for block in blocks] == names

    def test_a_step_is_added_to_what_is_there(self, tmp_path):
        path = tmp_path / "a.pvd"
        steps = Collection(path)
        inode = path.stat().st_ino
        for time in range(50):
            steps.add(float(time), [("a", f"a_{time}.vtp"), ("<b>", "b.vtp")])
            sets = ElementTree.parse(path).getroot().findall("Collection/DataSet")
            assert len(sets) == 2 * (time + 1) and sets[-1].get("name") == "<b>"
            assert float(sets[-1].get("timestep")) == time
        assert path.stat().st_ino == inode  # not written anew

    def test_a_full_disk_leaves_the_steps_before(self, tmp_path):
        resource = pytest.importorskip("resource")
        path = tmp_path / "a.pvd"
        steps = Collection(path)
        steps.add(0.0, [("a", "a.vtp")])
        whole = path.read_bytes()
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 10, limits[1]))
        try:
            with pytest.raises(OSError):
                steps.add(1.0, [("a", "a_1.vtp")])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == whole
        steps.add(1.0, [("a", "a_1.vtp")])
        assert len(ElementTree.parse(path).getroot().findall("Collection/DataSet")) == 2


class TestSaved:
    def test_paraview_collection_has_every_frame_and_muscle(self, arm_run):
        reader = pyvista.get_reader(arm_run[1] / "surfaces.pvd")
        assert list(reader.time_values) == list(range(7))
        assert reader.read()[0].is_manifold
        bones = pyvista.get_reader(arm_run[1] / "bones.pvd")
        bones.set_active_time_value(2.0)
        pose = arm_run[0].frames[2].poses["fore"]
        expected = np.array(arm_run[0].scene.bones[1].mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(bones.read()[1].points, expected, atol=1e-5)  # single precision

    def test_a_bone_that_moves_is_light_in_the_series(self, tmp_path):
        ball = trimesh.creation.icosphere(subdivisions=6, radius=20.0)
        vertices, faces = simplified(ball.vertices, ball.faces, 1600)
        light = trimesh.Trimesh(vertices, faces, process=False)
        assert len(faces) == 1600 and light.is_watertight
        assert np.abs(np.linalg.norm(vertices, axis=1) - 20.0).max() < 0.1
        assert light.volume == pytest.approx(ball.volume, rel=0.01)
        box = trimesh.creation.box((1, 2, 3))
        np.testing.assert_array_equal(simplified(box.vertices, box.faces, 1600)[0], box.vertices)
        doubled = np.vstack([ball.faces, ball.faces[:5, ::-1]])  # edges of four faces
        assert 1000 < len(simplified(ball.vertices, doubled, 1600)[1]) < 2500
        # No edge of a tetrahedron can collapse: what is of many parts is not lost for that.
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
        parts = [corners + [3.0 * k, 0, 0] for k in range(600)]
        four = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        many = np.concatenate([four + 4 * k for k in range(600)])
        assert len(simplified(np.concatenate(parts), many, 1600)[1])

    def test_no_run_is_said(self, tmp_path):
        with pytest.raises(UsageError, match="holds no run"):
            Run.load(tmp_path)
        (tmp_path / "run.json").write_text("{}")
        with pytest.raises(UsageError, match=r"not the run\.json"):
            Run.load(tmp_path)

    def test_newer_run_is_refused_with_one_line(self, arm_run, tmp_path):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        assert info["format"] == FORMAT
        info["format"] = FORMAT + 1
        (folder / "run.json").write_text(json.dumps(info))
        with pytest.raises(UsageError, match="of a newer rbfmuscle; this one reads up to") as told:
            Run.load(folder)
        assert "\n" not in str(told.value)


def test_vtk_files_carry_distance_to_bones_stretch_and_group(arm_run, tmp_path):
    export_run(arm_run[1], ["pvd"], output=tmp_path)
    first, last = (pyvista.read(tmp_path / f"pvd/biceps_{k:04d}.vtp") for k in (0, 6))
    assert set(first.point_data) == {"bone_distance", "stretch", "group", "normals"}
    assert np.abs(first["stretch"]).max() < 1e-15 and (first["group"] == 0).all()
    poses, expected = arm_run[0].frames[6].poses, []
    for bone in arm_run[0].scene.bones:
        moved = bone.mesh.copy().apply_transform(poses[bone.name])
        expected.append(-trimesh.proximity.signed_distance(moved, last.points))
    np.testing.assert_allclose(last["bone_distance"], np.min(expected, axis=0), atol=1e-5)
    edges = trimesh.Trimesh(last.points, last.regular_faces, process=False).edges_unique
    vertex = int(np.abs(last["stretch"]).argmax())
    own = edges[(edges == vertex).any(axis=1)]
    lengths = [
        np.linalg.norm(np.diff(d.points[own], axis=1), axis=-1).ravel() for d in (first, last)
    ]
    assert abs(last["stretch"][vertex]) > 0.01
    assert last["stretch"][vertex] == pytest.approx((lengths[1] / lengths[0] - 1).mean(), abs=1e-6)
    kept = pyvista.read(arm_run[1] / "surfaces" / "biceps_0006.vtp")
    assert {*kept.point_data, "normals"} == set(last.point_data)
    for name in ("stretch", "group"):
        np.testing.assert_allclose(kept[name], last[name], atol=1e-6)
    # A run's own files have the distance of the bones' fields, here to the bones in reach.
    near = np.abs(last["bone_distance"]) < 1.0
    assert near.sum() > 10
    np.testing.assert_allclose(kept["bone_distance"][near], last["bone_distance"][near], atol=0.05)


class TestHostileRuns:
    @pytest.mark.parametrize(
        ("change", "word"),
        [
            (lambda info: info["scene"]["muscles"][0].update(name="../../victim"), "victim"),
            (lambda info: info["scene"]["bones"][0].update(name="a/b"), "a/b"),
            (lambda info: info["scene"]["bones"][0].update(name=["a"]), "bones.0.name"),
            (lambda info: info["scene"]["muscles"][0].update(name="<img src=x>"), "<img"),
            (lambda info: info["scene"].update(units="<b>"), "units"),
            (lambda info: info["frames"][0].update(frame="/../x"), "frame"),
            (lambda info: info["frames"][0].update(frame=-1), "frame"),
            (lambda info: info["frames"][0].update(frame=True), "frame"),
        ],
    )
    def test_names_that_no_run_has_are_refused(self, arm_run, tmp_path, change, word):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        change(info)
        (folder / "run.json").write_text(json.dumps(info))
        with pytest.raises(UsageError, match=r"not the run\.json") as caught:
            Run.load(folder)
        assert word in str(caught.value)

    @pytest.mark.parametrize("name", ["metrics.csv", "events.csv", "poses.csv"])
    @pytest.mark.parametrize("line", [b"0,a,b,c,d,e,f\n", b"0,a\n", b"\xff\n"])
    def test_a_table_that_no_run_writes_is_refused(self, arm_run, tmp_path, name, line):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        with (folder / name).open("ab") as file:
            file.write(line)
        with pytest.raises(UsageError, match=f"{name} is not as it was written"):
            Run.load(folder)

    def test_a_run_without_all_poses_is_refused(self, arm_run, tmp_path):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        lines = (folder / "poses.csv").read_text().splitlines(keepends=True)
        for kept in (lines[:-1], []):
            (folder / "poses.csv").write_text("".join(kept))
            with pytest.raises(UsageError, match=r"poses\.csv lacks frame"):
                Run.load(folder)

    def test_a_file_that_is_nested_too_deep_is_refused(self, arm_run, tmp_path):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        (folder / "run.json").write_text('{"a":' * 100_000)
        with pytest.raises(UsageError, match=r"not the run\.json"):
            Run.load(folder)

    def test_messages_reach_the_terminal_without_control_characters(self):
        assert one_line("a\x1b[2J\nb\x00\u202ec") == "a?[2J b??c"

    def test_a_copy_holds_the_files_of_the_run_alone(self, arm_run, tmp_path):
        folder = shutil.copytree(arm_run[1], tmp_path / "run")
        (folder / "surfaces" / "mine.vtp").write_text("mine")
        Run.load(folder).save(tmp_path / "copy")
        assert not (tmp_path / "copy" / "surfaces" / "mine.vtp").exists()
        assert len(Run.load(tmp_path / "copy")) == 7
        (folder / "files.txt").unlink()
        with pytest.raises(UsageError, match=r"no files\.txt"):
            Run.load(folder).save(tmp_path / "other")
        assert not (tmp_path / "other").exists()


class TestExport:
    def test_a_bone_and_a_muscle_of_one_name_are_two_files(self, tmp_path):
        file = arm_files(tmp_path, end=0)
        file.write_text(file.read_text(encoding="utf-8").replace('"fore"', '"Biceps"'))
        simulate(file, model="pbd").save(tmp_path / "run", pictures=False)
        names = {path.name for path in export_run(tmp_path / "run", "stl")}
        assert names == {"biceps_0000.stl", "Biceps.bone_0000.stl", "upper_0000.stl"}

    @pytest.mark.parametrize("name", ["pvd", "vtp", "ply", "obj"])
    def test_vertices_and_faces_come_back_in_their_order(self, arm_run, tmp_path, name):
        made, folder = arm_run
        written = [
            p for p in export_run(folder, name, output=tmp_path) if p.stem.startswith("biceps_")
        ]
        for path, frame in zip(sorted(written), made.frames, strict=True):
            data, surface = (
                pyvista.read(path),
                frame.surfaces["biceps"],
            )  # by readers that are not ours
            np.testing.assert_allclose(data.points, surface.vertices, rtol=1e-6, atol=1e-5)
            np.testing.assert_array_equal(data.regular_faces, surface.faces)

    def test_a_run_exports_some_frames_and_a_rate(self, arm_run, tmp_path):
        run = arm_run[0]
        for number, frames in enumerate(("1:6:2", slice(1, 6, 2))):
            written = run.export(tmp_path / str(number), "vtp", frames=frames)
            names = {path.name for path in written if path.name.startswith("biceps")}
            assert names == {"biceps_0001.vtp", "biceps_0003.vtp", "biceps_0005.vtp"}
        (glb,) = run.export(tmp_path / "glb", "animated-glb", fps=10.0)
        assert glb.stat().st_size > 0
        with pytest.raises(UsageError, match="fps is for"):
            run.export(tmp_path / "none", "stl", fps=10.0)

    def test_named_muscles_alone_come_with_their_tendons_and_all_bones(self, tmp_path):
        run = simulate("phantom", "pbd", frames="0:1")
        everything = {path.name for path in run.export(tmp_path / "all", "stl")}
        names = {path.name for path in run.export(tmp_path / "one", "stl", muscles=["extensor"])}
        others = {f"{name}_0000.stl" for name in run.muscles if name != "extensor"}
        assert others and names == everything - others
        with pytest.raises(UsageError, match="did you mean 'extensor'"):
            run.export(tmp_path / "none", "stl", muscles=["extensr"])
        with pytest.raises(UsageError, match="names no muscle"):
            run.export(tmp_path / "none", "stl", muscles=[])

    @pytest.mark.parametrize(("name", "units"), [("fbx", "m"), ("ply", "inch"), ("glb", "mm")])
    def test_wrong_words(self, arm_run, tmp_path, name, units):
        with pytest.raises(UsageError):
            export_run(arm_run[1], name, output=tmp_path, units=units)

    def test_no_name_leads_out_of_the_folder(self):
        assert _file_name("../a b/c") == "_a b_c"
        assert [_file_name(name) for name in ("CON", "aux.2")] == ["CON_run", "aux.2_run"]


def test_json_has_no_nan_and_is_replaced_whole(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": float("nan"), "b": np.float64(2.5), "c": np.arange(3), "d": (1, np.inf)})
    kept = {"a": None, "b": 2.5, "c": [0, 1, 2], "d": [1, None]}
    assert json.loads(path.read_text(encoding="utf-8")) == kept
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
