"""The vertices of a muscle's file come out again in its order, by readers that are not ours:
trimesh, pyvista, usd-core.
"""

import shutil

import numpy as np
import pytest
import pyvista
import trimesh
from blend_model import arm_scene, use_blend_model
from scipy.spatial import cKDTree
from toy_scene import ellipsoid

from rbfmuscle.display.export import export_run
from rbfmuscle.geometry.surfaces import face_normals, vertex_normals
from rbfmuscle.recording import Run, simulate
from rbfmuscle.scene.meshes.read import read_mesh
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


def expected_normals(made, truth, frame):
    """Normals of the shown surface at the vertices of the file: seams do not show."""
    surface = made.frames[frame].surfaces["biceps"]
    normals = vertex_normals(surface.vertices, surface.faces)
    near = cKDTree(np.array(made.scene.muscles[0].mesh.vertices)).query(truth[0])[1]
    return normals[near]


@pytest.mark.parametrize("frame", [0, 2])
class TestExports:
    @pytest.mark.parametrize("name", ["obj", "ply", "vtp"])
    def test_one_file_a_muscle(self, textured, tmp_path, frame, name):
        folder, truth, made = textured
        export_run(folder, name, output=tmp_path)
        path = tmp_path / name / f"biceps_{frame:04d}.{name}"
        expected = expected_points(made, truth, frame)
        if name == "obj":
            rows = [line.split() for line in path.read_text().splitlines()]
            points, normals = (
                np.array([row[1:] for row in rows if row[:1] == [key]], float)
                for key in ("v", "vn")
            )
            numbers = [row[1:] for row in rows if row[:1] == ["f"]]
            corners = np.array([[corner.split("//") for corner in row] for row in numbers], int)
            np.testing.assert_array_equal(corners[..., 0], corners[..., 1])
            faces = corners[..., 0] - 1
        else:
            data = pyvista.read(path)
            points, faces = data.points, data.regular_faces
            normals = data.point_data["normals" if name == "vtp" else "Normals"]
        accuracy = SINGLE if name == "ply" else 1e-9
        np.testing.assert_allclose(points, expected, rtol=0, atol=accuracy)
        np.testing.assert_array_equal(faces, truth[1])
        np.testing.assert_allclose(normals, expected_normals(made, truth, frame), atol=1e-6)
        if name == "vtp":
            assert {"stretch", "bone_distance", "group"} <= set(data.point_data)
            place = cKDTree(expected).query(data.points)[1]
            np.testing.assert_array_equal(data["stretch"], data["stretch"][place])

    def test_glb(self, textured, tmp_path, frame):
        folder, truth, made = textured
        export_run(folder, "glb", output=tmp_path)
        mesh = trimesh.load(tmp_path / "glb" / f"frame_{frame:04d}.glb", process=False)
        mesh = mesh.geometry["biceps"]
        expected = 1e-3 * expected_points(made, truth, frame)
        np.testing.assert_allclose(mesh.vertices, expected, rtol=0, atol=1e-3 * SINGLE)
        np.testing.assert_array_equal(mesh.faces, truth[1])
        normals = np.array(mesh._cache.cache["vertex_normals"])  # those of the file
        np.testing.assert_allclose(normals, expected_normals(made, truth, frame), atol=1e-6)

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
        assert mesh.GetNormalsInterpolation() == UsdGeom.Tokens.vertex
        normals = np.array(mesh.GetNormalsAttr().Get(frame))
        np.testing.assert_allclose(normals, expected_normals(made, truth, frame), atol=1e-6)


def test_a_run_in_memory_exports_as_its_folder_does(textured, tmp_path):
    folder, _, made = textured
    for run, place in ((folder, "a"), (made, "b")):
        export_run(run, "obj", output=tmp_path / place)
    for path in (tmp_path / "a" / "obj").iterdir():
        there = tmp_path / "b" / "obj" / path.name
        assert len(path.read_text().splitlines()) == len(there.read_text().splitlines())
    kept = folder / "surfaces" / "biceps.npz"
    listed = (folder / "files.txt").read_text(encoding="utf-8")
    repeats = made.scene.muscles[0].given is not None
    assert kept.is_file() is repeats and ("surfaces/biceps.npz" in listed) is repeats


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_mirrored_file_keeps_its_order(tmp_path, axis):
    from rbfmuscle.scene.meshes.read import MeshTransform

    path, points, faces, *_ = write(tmp_path, "vtp")
    read = read_mesh(path, transform=MeshTransform(scale=2.0, mirror=axis))
    turn = np.ones(3)
    turn["xyz".index(axis)] = -1.0
    vertices = read.vertices[read.given.source]
    np.testing.assert_allclose(vertices, 2.0 * points * turn, atol=SINGLE)
    np.testing.assert_array_equal(np.sort(read.given.faces), np.sort(faces))


def test_a_mesh_with_added_triangles_has_an_order_of_its_own(tmp_path):
    points, _, _, own, of = egg()
    trimesh.Trimesh(points[of], own[:-1], process=False).export(tmp_path / "egg.ply")
    read = read_mesh(tmp_path / "egg.ply")
    assert "1 small holes closed" in read.notes and read.given is None


@pytest.mark.parametrize("textured", ["vtp"], indirect=True)
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


def test_texture_by_face_of_a_ply_file_does_not_count(tmp_path):
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
    read = read_mesh(tmp_path / "egg.ply")
    np.testing.assert_array_equal(read.vertices, points)
    np.testing.assert_array_equal(read.faces, faces)
    assert read.notes == [] and read.given is None
