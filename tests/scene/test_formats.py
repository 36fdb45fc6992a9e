"""Mesh files as other programs write them, each against a second reader of the same file."""

import json
import struct

import numpy as np
import pytest
import pyvista
import trimesh
from command_line import call

from rbfmuscle.scene.meshes.read import read_file, read_mesh, read_part
from rbfmuscle.validation import MeshError

L_SHAPE = np.array([(20, 0), (20, 10), (10, 10), (10, 30), (0, 30), (0, 0)], float)
# With corners on its straight sides, so that neighbours have vertices there.
L_DIVIDED = np.array(
    [(20, 0), (20, 5), (20, 10), (10, 10), (10, 20), (10, 30), (0, 30), (0, 0), (10, 0)], float
)


def prism(outline, height=50.0):
    """Corners, and faces of as many corners as the outline has; volume 20000, area 5800."""
    n = len(outline)
    points = np.vstack([np.column_stack([outline, np.full(n, z)]) for z in (0.0, height)])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    return points, [[0, *range(n - 1, 0, -1)], list(range(n, 2 * n)), *sides]


def obj_text(points, faces, first=1):
    lines = [*("v {} {} {}".format(*p) for p in points)]
    return "\n".join([*lines, *("f " + " ".join(str(k + first) for k in f) for f in faces), ""])


def ply_bytes(points, faces, form):
    head = [
        "ply",
        f"format {form} 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    if form == "ascii":
        rows = [*(" ".join(map(str, p)) for p in points)]
        rows += [" ".join(map(str, [len(f), *f])) for f in faces]
        return ("\n".join([*head[:-1], "end_header", *rows]) + "\n").encode()
    body = points.astype("<f8").tobytes()
    rows = [struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces]
    return "\n".join(head).encode() + body + b"".join(rows)


class TestPolygons:
    @pytest.mark.parametrize("outline", [L_SHAPE, L_DIVIDED], ids=["corners", "divided sides"])
    @pytest.mark.parametrize("start", [0, 1, 4])
    @pytest.mark.parametrize("form", ["obj", "ply", "ply-text", "vtk"])
    def test_concave_ones_are_cut_within_their_outline(self, tmp_path, outline, start, form):
        points, faces = prism(np.roll(outline, -start, axis=0))
        file = tmp_path / f"m.{form[:3]}"
        if form == "obj":
            file.write_text(obj_text(points, faces))
        elif form == "vtk":
            rows = np.concatenate([[len(face), *face] for face in faces])
            pyvista.PolyData(points, rows).save(file)
        else:
            written = "ascii" if form == "ply-text" else "binary_little_endian"
            file.write_bytes(ply_bytes(points, faces, written))
        read = read_mesh(file)
        assert len(read.vertices) == len(points)  # those on straight sides too
        assert read.mesh.is_watertight and read.mesh.is_winding_consistent
        assert read.mesh.volume == pytest.approx(20000, rel=1e-6)
        assert read.mesh.area == pytest.approx(5800, rel=1e-6)
        caps = np.abs(read.mesh.face_normals[:, 2]) > 0.5
        np.testing.assert_allclose(np.abs(read.mesh.face_normals[caps, 2]), 1.0, atol=1e-9)
        assert read.mesh.area_faces.min() > 1.0  # no flat ones

    def test_tilted_and_mirrored_ones_are_cut_alike(self, tmp_path):
        points, faces = prism(L_SHAPE)
        turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
        mirrored = [face[::-1] for face in faces]
        for corners, sides in ((points @ turn.T, faces), (points * [1, -1, 1], mirrored)):
            file = tmp_path / "m.obj"
            file.write_text(obj_text(corners, sides))
            read = read_mesh(file)
            assert read.mesh.volume == pytest.approx(20000) and read.notes == []
            assert read.mesh.area == pytest.approx(5800)

    def test_spiral_has_the_area_of_its_outline(self, tmp_path):
        turn = np.linspace(0.0, 4.5 * np.pi, 60)
        arm = np.column_stack([np.cos(turn), np.sin(turn)]) * (10 + 2 * turn)[:, None]
        outline = np.vstack([arm, 0.85 * arm[::-1]])
        x, y = outline.T
        area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
        points, faces = prism(outline, 7.0)
        file = tmp_path / "spiral.obj"
        file.write_text(obj_text(points, faces))
        assert read_mesh(file).mesh.volume == pytest.approx(7.0 * area, rel=1e-9)

    def test_corners_given_twice_count_once(self, tmp_path):
        points, faces = prism(L_SHAPE)
        faces[0] = [*faces[0], faces[0][0]]
        faces[1] = [faces[1][0], *faces[1]]
        (tmp_path / "prism.obj").write_text(obj_text(points, faces))
        part = read_part(tmp_path / "prism.obj")
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        assert not part.notes and len(part.faces) == 20
        assert mesh.volume == pytest.approx(20000) and mesh.area == pytest.approx(5800)

    @pytest.mark.parametrize("strips", [False, True])
    def test_points_without_faces_are_counted(self, tmp_path, strips):
        more = "element tristrips 1\nproperty list int int vertex_indices\n" if strips else ""
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}{more}end_header\n"
        rows = "0 0 0\n1 0 0\n0 1 0\n" + ("3 0 1 2\n" if strips else "")
        (tmp_path / "cloud.ply").write_text(head + rows, encoding="utf-8")
        words = "3 points and no faces" + (" but strips" if strips else "")
        with pytest.raises(MeshError, match=words):
            read_mesh(tmp_path / "cloud.ply", name="cloud")

    def test_a_file_that_ends_within_its_faces_is_refused(self, tmp_path):
        whole = ply_bytes(*prism(L_SHAPE), "ascii").decode()
        file = tmp_path / "cut.ply"
        file.write_text("\n".join(whole.split("\n")[:-3]) + "\n")
        with pytest.raises(MeshError, match="declares 8 faces and holds 6"):
            read_part(file)


class TestObj:
    @pytest.mark.parametrize(
        ("line", "words"),
        [
            ("f 0 1 2", r"line 15, 'f 0 1 2': vertex 0; numbers begin at 1"),
            ("f 1 2 99", r"line 15: a face names vertex 99, there are 12"),
            ("f -13 1 2", r"line 15, .*vertex -13"),
            ("f 1 2 x", r"line 15, 'f 1 2 x'"),
            ("v 1 2", r"line 15, 'v 1 2': 2 coordinates"),
        ],
    )
    def test_a_wrong_line_is_refused_by_its_number(self, tmp_path, line, words):
        lines = obj_text(*prism(L_SHAPE)).splitlines()
        file = tmp_path / "bad.obj"
        file.write_text("\n".join([*lines[:14], line, *lines[14:]]))
        with pytest.raises(MeshError, match=rf"bad\.obj.*{words}"):
            read_mesh(file)

    @pytest.mark.parametrize("mark", ["o", "g"])
    def test_several_objects_are_never_one_unasked(self, tmp_path, mark):
        points, faces = prism(L_SHAPE)
        file = tmp_path / "two.obj"
        second = obj_text(points + [100, 0, 0], faces, 13)
        file.write_text(f"{mark} femur\n{obj_text(points, faces)}{mark} gluteus\n{second}")
        with pytest.raises(MeshError, match=r"2 meshes in one file \(femur, gluteus\).*obj#femur"):
            read_mesh(file)
        one = read_mesh(tmp_path / "two.obj#gluteus")
        assert one.mesh.volume == pytest.approx(20000) and one.mesh.bounds[0, 0] == 100
        both = read_mesh(tmp_path / "two.obj#*", may_be_open=True)
        assert both.mesh.volume == pytest.approx(40000)
        assert "2 meshes of the file taken as one" in both.notes
        with pytest.raises(MeshError, match=r"no mesh of this name.*'femur'"):
            read_mesh(tmp_path / "two.obj#femr")

    def test_groups_that_share_vertices_are_one_mesh(self, tmp_path):
        text = obj_text(*prism(L_SHAPE)).replace("f 1 2 8 7", "g sides\nf 1 2 8 7")
        file = tmp_path / "one.obj"
        file.write_text("g caps\n" + text)
        assert read_mesh(file).mesh.volume == pytest.approx(20000)

    def test_what_is_no_face_and_loose_vertices_are_named(self, tmp_path):
        file = tmp_path / "m.obj"
        file.write_text("v 7 7 7\n" + obj_text(*prism(L_SHAPE), first=2) + "l 1 2\np 1\n")
        read = read_mesh(file)
        assert "2 lines, points and curves left out" in read.notes
        assert "1 vertices of no triangle left out" in read.notes
        assert not any("merged" in note for note in read.notes)


def capsule(x=0.0):
    mesh = trimesh.creation.capsule(height=176.0, radius=12.0, count=[12, 12])
    return mesh.apply_translation([x, 0, 0])


def stl_bytes(mesh, header):
    rows = np.zeros(len(mesh.faces), [("n", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["corners"] = mesh.triangles
    return header.ljust(80) + struct.pack("<I", len(rows)) + rows.tobytes()


def stl_text(mesh, name):
    rows = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {:.9g} {:.9g} {:.9g}\n".format(*corner) for corner in corners)
        + "endloop\nendfacet\n"
        for corners in mesh.triangles
    ]
    return f"solid {name}\n{''.join(rows)}endsolid {name}\n"


class TestStl:
    @pytest.mark.parametrize("kind", ["binary", "solid header", "trailing", "text", "capitals"])
    def test_dialects_give_what_vtk_reads(self, tmp_path, kind):
        mesh, file = capsule(), tmp_path / "m.stl"
        content = stl_bytes(mesh, b"exported" if kind == "binary" else b"solid facet femur")
        if kind in ("text", "capitals"):
            text = stl_text(mesh, "femur")
            text = text if kind == "text" else text.upper().replace("\n", "\r\n")
            content = text.encode()
        file.write_bytes(content + (b"\0\0" if kind == "trailing" else b""))
        read = read_mesh(file)
        assert len(read.vertices) == len(mesh.vertices)
        assert read.mesh.volume == pytest.approx(mesh.volume, rel=1e-5)  # float32
        assert read.notes == (
            ["2 bytes behind the last triangle left out"] if kind == "trailing" else []
        )
        if kind in ("binary", "text"):  # the others VTK does not read
            other = pyvista.read(file)
            assert other.n_cells == len(read.faces)
            np.testing.assert_allclose(
                np.sort(other.points, axis=0), np.sort(read.vertices, axis=0), atol=1e-5
            )

    @pytest.mark.parametrize("cut", [1, 10, 50, 3000])
    def test_a_truncated_file_is_refused_with_its_numbers(self, tmp_path, cut):
        content = stl_bytes(capsule(), b"solid facet femur")
        file = tmp_path / "m.stl"
        file.write_bytes(content[:-cut])
        words = rf"cut off: {len(content) - cut:,} bytes, {len(capsule().faces):,} triangles need"
        with pytest.raises(MeshError, match=words):
            read_mesh(file)
        file.write_text(stl_text(capsule(), "femur")[: -max(cut, 16)])  # into the last lines
        with pytest.raises(MeshError, match=r"cut off: solid 'femur' has no end|corners of"):
            read_mesh(file)

    @pytest.mark.parametrize(
        ("old", "new"), [(b"\n", b"\r"), (b"\n", b"\r\n"), (b"", b"\xef\xbb\xbf")]
    )
    def test_line_ends_and_marks_of_text_do_not_count(self, tmp_path, old, new):
        text = stl_text(capsule(), "femur").encode()
        file = tmp_path / "bone.stl"
        file.write_bytes(text.replace(old, new) if old else new + text)
        part = read_part(file)
        assert part.name == "femur" and len(part.faces) == len(capsule().faces)

    def test_decimal_commas_and_a_count_of_zero_are_named(self, tmp_path):
        file = tmp_path / "bone.stl"
        file.write_text(stl_text(capsule(), "femur").replace(".", ","))
        with pytest.raises(MeshError, match="decimal comma"):
            read_part(file)
        content = bytearray(stl_bytes(capsule(), b"exported"))
        content[80:84] = bytes(4)
        file.write_bytes(content)
        with pytest.raises(MeshError, match="declares 0 triangles, and has"):
            read_part(file)

    def test_solids_have_names_that_differ(self, tmp_path):
        two = stl_text(capsule(), "ascii") + stl_text(capsule(60), "ascii")
        for name, content, names in (
            ("same.stl", two.encode(), ["ascii", "ascii_2"]),
            (
                "path.stl",
                two.replace("ascii", "../left femur", 2).encode(),
                ["left_femur", "ascii"],
            ),
            ("joined.stl", stl_bytes(capsule(), b"a") + stl_bytes(capsule(60), b"b"), 2),
        ):
            file = tmp_path / name
            file.write_bytes(content)
            parts = read_file(file)
            assert names in ([part.name for part in parts], len(parts))
            again = [read_part(tmp_path / f"{name}#{part.name}") for part in parts]
            assert [part.vertices[:, 0].mean().round() for part in again] == [0, 60]

    def test_an_empty_solid_is_named(self, tmp_path):
        file = tmp_path / "m.stl"
        file.write_text(stl_text(capsule(), "femur") + "solid tibia\nendsolid tibia\n")
        assert "1 empty meshes in the file (tibia)" in read_mesh(file).notes


def test_new_takes_each_solid_of_a_file_and_writes_what_was_mended(tmp_path, capsys):
    lower, upper = capsule(), capsule().apply_translation([0, 0, 205])
    inner = trimesh.creation.capsule(height=176.0, radius=5.0, count=[12, 12])
    (tmp_path / "bones.stl").write_text(stl_text(upper, "pelvis") + stl_text(lower, "femur"))
    trimesh.util.concatenate([lower, inner]).apply_translation([60, 0, 0]).export(
        tmp_path / "tibia.ply"
    )
    muscle = trimesh.creation.icosphere(3).apply_scale([15, 15, 60])
    muscle.apply_translation([26, 0, 190]).export(tmp_path / "gluteus_maximus.ply")
    code, out, _ = call(capsys, "new", tmp_path, "--units", "mm", "--json", "--quiet")
    found = json.loads(out)
    assert code == 0 and found["file"] == str(tmp_path / "scene.toml")
    assert {guess["table"] for guess in found["guesses"]} == {"joint", "muscle"}
    scene = (tmp_path / "scene.toml").read_text()
    assert 'mesh = "bones.stl#pelvis"' in scene and 'mesh = "bones.stl#femur"' in scene
    assert "bones.stl: 2 meshes in one file (pelvis, femur)" in scene
    assert "# 2 nested shells, the inner one is ignored" in scene
    _, out, _ = call(capsys, "check", tmp_path / "scene.toml")
    assert "tibia: 2 nested shells, the inner one is ignored" in out


def test_ply_header_without_vertex_numbers_of_faces_is_refused(tmp_path):
    path = tmp_path / "x.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indic\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    with pytest.raises(MeshError, match="declares no list of the faces' vertex numbers"):
        read_mesh(path)


class TestForeignContent:
    """Files under a name that is not theirs: what they are, not how their bytes fail."""

    @pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtp"])
    def test_is_named(self, tmp_path, suffix):
        points, faces = prism(L_SHAPE)
        text = obj_text(points, faces)
        solid = trimesh.creation.box()
        meshes = {
            ".stl": [solid.export(file_type="stl"), solid.export(file_type="stl_ascii").encode()],
            ".obj": [text.encode(), b"\xef\xbb\xbf# made by hand\n\no prism\n" + text.encode()],
            ".ply": [ply_bytes(points, faces, "ascii")],
            ".vtk": [b"# vtk DataFile Version 3.0\n"],
            ".vtp": [b'<?xml version="1.0"?>\n<VTKFile type="PolyData">\n'],
        }
        found = [(kind, data) for kind, some in meshes.items() for data in some if kind != suffix]
        found += [
            ("Git LFS", b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n"),
            ("web page", b"<!DOCTYPE html><html><body>404</body></html>"),
            ("gzip", b"\x1f\x8b\x08\0"),
            ("zip archive", b"PK\x03\x04"),
            ("UTF-16", text.encode("utf-16")),
        ]
        for words, content in found:
            path = tmp_path / f"femur{suffix}"
            path.write_bytes(content)
            with pytest.raises(MeshError, match=f"not a {suffix[1:].upper()} file but .*{words}"):
                read_file(path)

    def test_a_binary_stl_may_begin_with_any_words(self, tmp_path):
        content = trimesh.creation.box().export(file_type="stl")
        for head in (b"ply ", b"o femur ", b"solid femur facet normal", b"PK\x03\x04"):
            (tmp_path / "b.stl").write_bytes(head.ljust(80) + content[80:])
            assert len(read_file(tmp_path / "b.stl")[0].faces) == 12


def test_a_mark_of_unicode_before_the_first_vertex_costs_no_vertex(tmp_path):
    """Numbers count backwards here: without the first vertex every one would be another."""
    points, faces = prism(L_SHAPE)
    path = tmp_path / "p.obj"
    path.write_bytes(b"\xef\xbb\xbf" + obj_text(points, faces, first=-len(points)).encode())
    part = read_part(path)
    assert trimesh.Trimesh(part.vertices, part.faces).volume == pytest.approx(20000.0)
