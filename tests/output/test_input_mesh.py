"""The vertices, texture coordinates and normals of a muscle's file come out again, by readers that
are not ours: trimesh, pyvista, usd-core.
"""

import shutil

import numpy as np
import pytest
import pyvista
import trimesh
from blend_model import arm_scene, use_blend_model
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from toy_scene import ellipsoid

from rbfmuscle.geometry.surfaces import face_normals, vertex_normals
from rbfmuscle.output.export import export_run
from rbfmuscle.run import Run, simulate
from rbfmuscle.scene.meshes.input_mesh import InputMesh, vertex_corners
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import UsageError

SINGLE = 1e-5  # single precision of lengths to 50 mm


def egg():
    """Vertices, faces, texture coordinates (t, 2) with a seam, and their numbers (m, 3)."""
    mesh = ellipsoid([26, 5, 5], [0, 0, 9.5], subdivisions=2)
    points, faces = np.array(mesh.vertices), np.array(mesh.faces)
    x, y, z = (points - [0, 0, 9.5]).T
    around = (np.arctan2(z, y) / (2 * np.pi) % 1.0)[faces]
    around += (np.ptp(around, axis=1, keepdims=True) > 0.5) & (around < 0.5)
    corners = np.stack([faces, np.round(around * 1e6)], axis=2).reshape(-1, 2)
    rows, label = np.unique(corners.astype(int), axis=0, return_inverse=True)
    texture = np.stack([rows[:, 1] / 2e6, 0.5 + x[rows[:, 0]] / 60], axis=1)
    return points, faces, texture, label.reshape(-1, 3), rows[:, 0]


def obj_lines(points, faces, texture, texture_faces, flat):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in texture.tolist()]
    lines += [f"vn {x!r} {y!r} {z!r}" for x, y, z in flat.tolist()]
    for k, (face, own) in enumerate(zip(faces + 1, texture_faces + 1)):
        lines.append("f " + " ".join(f"{a}/{b}/{k + 1}" for a, b in zip(face, own)))
    return "\n".join(lines) + "\n"


def write(folder, form):
    """A file of the egg; its vertices, triangles, and texture coordinates (m, 3, 2) and normals
    (m, 3, 3) by corner, None where the form has none.
    """
    points, faces, texture, texture_faces, of = egg()
    by_corner = texture[texture_faces]
    flat = face_normals(points, faces)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    if form == "obj":
        text = obj_lines(points, faces, texture, texture_faces, flat)
        (folder / "egg.obj").write_text(text)
        return folder / "egg.obj", points, faces, by_corner, flat[:, None].repeat(3, axis=1)
    points, faces = points[of], texture_faces  # repeated along the seam
    normals = trimesh.Trimesh(*egg()[:2], process=False).vertex_normals[of]
    if form == "vtp":
        data = pyvista.PolyData.from_regular_faces(points, faces)
        data.active_texture_coordinates = texture
        data.point_data.active_normals = normals
        data.save(folder / "egg.vtp")
        return folder / "egg.vtp", points, faces, by_corner, normals[faces]
    made = trimesh.Trimesh(points, faces, process=False)
    made.vertex_attributes["s"], made.vertex_attributes["t"] = texture.astype(np.float32).T
    made.export(folder / "egg.ply", vertex_normal=False)
    return folder / "egg.ply", points, faces, by_corner, None


@pytest.fixture(scope="module", params=["obj", "vtp", "ply"])
def textured(request, tmp_path_factory):
    """A run in its folder, the vertices and corners of its file, and the run in memory."""
    folder = tmp_path_factory.mktemp(request.param)
    path, *truth = write(folder, request.param)
    x = truth[0][:, 0]
    scene = arm_scene(end=60, step=30)
    scene.muscles.clear()
    ends = {"upper": x < -19, "fore": x > 19}
    attach = [{"bone": bone, "vertices": np.flatnonzero(held)} for bone, held in ends.items()]
    scene.add_muscle("biceps", path, attach=attach)
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        made = simulate(scene)
    made.save(folder / "run")
    return folder / "run", truth, made


def expected_points(made, truth, frame):
    """Where the vertices of the file are in a frame."""
    shown = np.array(made.scene.muscles[0].mesh.vertices)
    assert len(shown) == 162 and trimesh.Trimesh(shown, made.frames[0].surfaces["biceps"].faces)
    near = cKDTree(shown).query(truth[0])[1]
    return made.frames[frame].surfaces["biceps"].vertices[near]


def check_corners(found, expected, truth, frame, scale=1.0):
    """Compare positions, texture coordinates and normals (m, 3, ...) of the corners of triangles;
    in the first frame the surface is the file's.
    """
    points, texture, normals = found
    np.testing.assert_allclose(points, scale * expected[truth[1]], rtol=0, atol=scale * SINGLE)
    np.testing.assert_allclose(texture, truth[2], rtol=0, atol=1e-6)
    if truth[3] is None or normals is None:
        return
    if frame == 0:
        np.testing.assert_allclose(normals, truth[3], rtol=0, atol=1e-6)
    elif np.ptp(truth[3], axis=1).max() == 0.0:  # facets stay so
        flat = face_normals(expected, truth[1])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        np.testing.assert_allclose(normals, flat[:, None].repeat(3, axis=1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("frame", [0, 2])
class TestExports:
    def test_obj(self, textured, tmp_path, frame):
        folder, truth, made = textured
        export_run(folder, "obj", output=tmp_path)
        path = tmp_path / "obj" / f"biceps_{frame:04d}.obj"
        expected = expected_points(made, truth, frame)
        rows = [line.split()[1:] for line in path.read_text().splitlines() if line[:2] == "v "]
        np.testing.assert_allclose(np.array(rows, float), expected, rtol=0, atol=1e-9)
        mesh = trimesh.load(path, process=False)  # it splits vertices, and the order of faces stays
        corners = mesh.vertices[mesh.faces], mesh.visual.uv[mesh.faces]
        normals = None if truth[3] is None else mesh.vertex_normals[mesh.faces]
        # trimesh splits no vertex by its normals
        smooth = truth[3] is not None and np.ptp(truth[3], axis=1).max() > 0
        check_corners((*corners, normals if smooth else None), expected, truth, frame)
        again = read_mesh(path).given
        np.testing.assert_allclose(again.vertices, expected, atol=1e-9)
        corners = again.corners
        normals = None if truth[3] is None else corners.normals[corners.normal_faces]
        found = again.vertices[again.faces], corners.texture[corners.texture_faces], normals
        check_corners(found, expected, truth, frame)

    @pytest.mark.parametrize("name", ["vtp", "ply"])
    def test_vtk(self, textured, tmp_path, frame, name):
        folder, truth, made = textured
        export_run(folder, name, output=tmp_path)
        data = pyvista.read(tmp_path / name / f"biceps_{frame:04d}.{name}")
        expected = expected_points(made, truth, frame)
        faces = data.regular_faces
        np.testing.assert_allclose(data.points[: len(expected)], expected, rtol=0, atol=SINGLE)
        normals = None
        if truth[3] is not None:
            given = data.point_data["normals" if name == "vtp" else "Normals"]
            normals = np.asarray(given)[faces]
        texture = np.asarray(data.active_texture_coordinates)[faces]
        check_corners((data.points[faces], texture, normals), expected, truth, frame)
        if name == "vtp":
            assert {"stretch", "bone_distance", "group"} <= set(data.point_data)
            place = cKDTree(expected).query(data.points)[1]
            np.testing.assert_array_equal(data["stretch"], data["stretch"][place])

    def test_glb(self, textured, tmp_path, frame):
        folder, truth, made = textured
        export_run(folder, "glb", output=tmp_path)
        mesh = trimesh.load(tmp_path / "glb" / f"frame_{frame:04d}.glb", process=False)
        mesh = mesh.geometry["biceps"]
        expected = expected_points(made, truth, frame)
        np.testing.assert_allclose(
            mesh.vertices[: len(expected)], 1e-3 * expected, rtol=0, atol=1e-3 * SINGLE
        )
        found = mesh.vertices[mesh.faces], mesh.visual.uv[mesh.faces], None
        normals = np.array(mesh._cache.cache["vertex_normals"])  # those of the file
        check_corners((*found[:2], normals[mesh.faces]), expected, truth, frame, scale=1e-3)

    def test_usd(self, textured, tmp_path, frame):
        from pxr import Usd, UsdGeom

        folder, truth, made = textured
        (path,) = export_run(folder, "usd", output=tmp_path)
        stage = Usd.Stage.Open(str(path))
        (prim,) = (p for p in stage.Traverse() if p.GetName() == "biceps")
        mesh, expected = UsdGeom.Mesh(prim), expected_points(made, truth, frame)
        points = np.array(mesh.GetPointsAttr().Get(frame))
        np.testing.assert_allclose(points, expected, rtol=0, atol=SINGLE)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        np.testing.assert_array_equal(faces, truth[1])
        primvars, shape = UsdGeom.PrimvarsAPI(mesh), faces.shape
        assert primvars.GetPrimvar("st").GetInterpolation() == "faceVarying"
        texture = np.array(primvars.GetPrimvar("st").ComputeFlattened()).reshape(*shape, 2)
        normals = None
        if truth[3] is not None:
            values = primvars.GetPrimvar("normals").ComputeFlattened(frame)
            normals = np.array(values).reshape(*shape, 3)
        check_corners((points[faces], texture, normals), expected, truth, frame)


def test_animated_glb_moves_normals_and_keeps_texture(textured, tmp_path):
    folder, truth, made = textured
    (path,) = export_run(folder, "animated-glb", output=tmp_path)
    mesh = trimesh.load(path, process=False).geometry["biceps"]
    assert mesh.visual.uv.shape == (len(mesh.vertices), 2)
    found = mesh.vertices[mesh.faces], mesh.visual.uv[mesh.faces], None
    check_corners(found, expected_points(made, truth, 0), truth, 0, scale=1e-3)


def test_a_run_in_memory_exports_as_its_folder_does(textured, tmp_path):
    folder, _, made = textured
    for run, place in ((folder, "a"), (made, "b")):
        export_run(run, "obj", output=tmp_path / place)
    for path in (tmp_path / "a" / "obj").iterdir():
        there = tmp_path / "b" / "obj" / path.name
        assert len(path.read_text().splitlines()) == len(there.read_text().splitlines())
    assert (folder / "surfaces" / "biceps.npz").is_file()
    assert "surfaces/biceps.npz" in (folder / "files.txt").read_text(encoding="utf-8")


class TestNormals:
    def given(self, normals):
        points, faces, *_ = egg()
        return InputMesh(
            points, faces, np.arange(len(points)), vertex_corners(faces, None, normals)
        )

    def test_normals_by_area_follow_an_affine_motion(self):
        points, faces, *_ = egg()
        normals = vertex_normals(points, faces)
        linear = np.eye(3) + np.random.default_rng(3).normal(0.0, 0.4, (3, 3))
        assert np.linalg.det(linear) > 0.2
        expected = normals @ np.linalg.inv(linear)  # the inverse transposed, of rows
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        moved = self.given(normals).moved(points @ linear.T + [5.0, -3.0, 1.0])
        np.testing.assert_allclose(moved.corners.normals, expected, rtol=0, atol=1e-12)

    def test_any_normals_turn_with_a_rigid_motion(self):
        points = egg()[0]
        rng = np.random.default_rng(5)
        normals = rng.normal(0.0, 1.0, points.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        turn = Rotation.random(rng=rng).as_matrix()
        moved = self.given(normals).moved(points @ turn.T + 3.0)
        np.testing.assert_allclose(moved.corners.normals, normals @ turn.T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_mirrored_file_keeps_its_corners(tmp_path, axis):
    from rbfmuscle.scene.meshes.transform import mesh_transform

    path, *truth = write(tmp_path, "obj")
    lies = mesh_transform(2.0, axis, None, context="")
    given, turn = read_mesh(path, transform=lies).given, np.ones(3)
    turn["xyz".index(axis)] = -1.0
    np.testing.assert_allclose(given.vertices, 2.0 * truth[0] * turn, atol=1e-9)
    corners = given.corners
    found = corners.texture[corners.texture_faces], corners.normals[corners.normal_faces]
    np.testing.assert_allclose(found[0], truth[2][:, ::-1], atol=1e-12)
    np.testing.assert_allclose(found[1], truth[3][:, ::-1] * turn, atol=1e-9)


@pytest.mark.parametrize("form", ["obj", "vtp", "ply"])
def test_a_saved_scene_keeps_its_corners(tmp_path, form):
    path, points, *_ = write(tmp_path, form)
    scene = arm_scene()
    scene.muscles.clear()
    ends = {"upper": points[:, 0] < -19, "fore": points[:, 0] > 19}
    attach = [{"bone": bone, "vertices": np.flatnonzero(held)} for bone, held in ends.items()]
    scene.add_muscle("biceps", path, attach=attach)
    again = Scene.load(scene.save(tmp_path / "saved.toml"))
    one, other = scene.muscles[0], again.muscles[0]
    np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
    np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
    for ours, theirs in zip(one.attachments, other.attachments, strict=True):
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
    mine, kept = one.given.corners, other.given.corners
    np.testing.assert_array_equal(
        kept.texture[kept.texture_faces], mine.texture[mine.texture_faces]
    )
    assert (form == "ply") == (len(kept.normals) == 0)
    if len(mine.normals):
        found, wanted = kept.normals[kept.normal_faces], mine.normals[mine.normal_faces]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-15)  # read as unit vectors


def test_a_mesh_with_added_triangles_says_that_its_texture_is_lost(tmp_path):
    path = write(tmp_path, "obj")[0]
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n")  # a hole
    read = read_mesh(path)
    assert read.given is None and any("texture coordinates" in note for note in read.notes)
    some = [line.replace("/1/", "//") for line in lines]
    path.write_text("\n".join(some) + "\n")
    read = read_mesh(path)
    assert not len(read.given.corners.texture) and len(read.given.corners.normals)
    assert any("texture coordinates left out" in note for note in read.notes)


def test_a_damaged_archive_is_refused_with_one_line(textured, tmp_path):
    copy = shutil.copytree(textured[0], tmp_path / "run")
    file = copy / "surfaces" / "biceps.npz"
    content = file.read_bytes()
    with np.load(file) as found:
        arrays = dict(found)
    arrays["faces"] = arrays["faces"] + 1
    for damage in (content[:200], b"", None):
        np.savez(file, **arrays) if damage is None else file.write_bytes(damage)
        with pytest.raises(UsageError, match=r"biceps\.npz is not as it was written") as caught:
            export_run(Run.load(copy), "obj", output=tmp_path / "out")
        assert "\n" not in str(caught.value)


def test_corners_of_ply_files_by_face_are_read(tmp_path):
    points, faces, texture, texture_faces, _ = egg()
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "property list uchar float texcoord",
        "end_header",
    ]
    rows = [" ".join(map(repr, point)) for point in points.tolist()]
    for face, pairs in zip(faces.tolist(), texture[texture_faces].reshape(-1, 6).tolist()):
        rows.append(f"3 {face[0]} {face[1]} {face[2]} 6 " + " ".join(map(repr, pairs)))
    (tmp_path / "egg.ply").write_text("\n".join(head + rows) + "\n")
    corners = read_mesh(tmp_path / "egg.ply").given.corners
    found = corners.texture[corners.texture_faces]
    np.testing.assert_allclose(found, texture[texture_faces], atol=1e-6)
    assert len(corners.texture) == len(texture)
