"""Reading meshes of every format, and mending them only where that is safe."""

import numpy as np
import pytest
import trimesh
from fuzz.meshes import write_mesh

from rbfmuscle.geometry.mesh_distance import inside_test
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.meshes.read import prepare_mesh, read_mesh
from rbfmuscle.validation import MeshError


def ball(radius=20.0):
    return trimesh.creation.icosphere(subdivisions=2, radius=radius)


def write(path, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


class TestFormats:
    @pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtp"])
    def test_every_format_gives_the_same_surface(self, tmp_path, suffix):
        mesh = ball()
        form = (
            "vtp-Binary-ZLib"
            if suffix == ".vtp"
            else "vtk-binary-51"
            if suffix == ".vtk"
            else suffix[1:]
        )
        read = read_mesh(write_mesh(tmp_path / f"ball{suffix}", mesh, form))
        assert read.closed
        assert len(read.mesh.vertices) == len(mesh.vertices)
        assert read.mesh.volume == pytest.approx(mesh.volume, rel=1e-6)  # STL and VTK hold float32
        if suffix != ".stl":
            assert np.abs(read.mesh.vertices - mesh.vertices).max() < 1e-5 * 20

    def test_obj_keeps_the_order_of_vertices_with_texture_and_quads(self, tmp_path):
        path = tmp_path / "box.obj"
        corners = [(x, y, z) for x in (0, 9) for y in (0, 9) for z in (0, 9)]
        quads = [
            "1/1 2/2 4/3 3/4",
            "5 7 8 6",
            "1 5 6 2",
            "3//1 4//1 8//1 7//1",
            "1 3 7 5",
            "-7 -3 -1 -5",
        ]
        lines = [*(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", *(f"f {q}" for q in quads)]
        path.write_text("\n".join(lines))
        read = read_mesh(path)
        np.testing.assert_allclose(read.mesh.vertices, corners, atol=1e-9)
        assert read.mesh.volume == pytest.approx(729)

    def test_counting_back_from_where_a_face_stands_is_counting_on(self, tmp_path):
        path = tmp_path / "m.obj"
        on = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 3 2 1\nf 1 2 4\nf 4 3 1\nf 2 3 4\n"
        back = (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\nv 0 0 1\nf -4 -3 -1\nf -1 -2 -4\nf -3 -2 -1\n"
        )
        read = [path.write_text(text) and read_mesh(path).mesh for text in (on, back)]
        assert read[0].volume == pytest.approx(1.0 / 6.0)
        np.testing.assert_array_equal(read[0].vertices, read[1].vertices)
        np.testing.assert_array_equal(read[0].faces, read[1].faces)


class TestMending:
    @pytest.mark.parametrize(
        "kind", ["inward", "wrong way", "1 small holes", "1 dangling", "1 loose parts"]
    )
    def test_what_is_mended_is_noted_and_the_ball_is_whole(self, tmp_path, kind):
        mesh = ball()
        vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
        if kind == "inward":
            faces = faces[:, ::-1]
        elif kind == "wrong way":
            faces[::7] = faces[::7, ::-1]
        elif kind == "1 small holes":
            faces = faces[1:]
        elif kind == "1 dangling":
            vertices = np.vstack([vertices, [[0, 0, 60.0]]])
            faces = np.vstack([faces, [[*faces[0, :2], len(mesh.vertices)]]])
        else:
            crumb = trimesh.creation.icosphere(subdivisions=0, radius=0.5).apply_translation(
                [50, 0, 0]
            )
            faces = np.vstack([faces, crumb.faces + len(vertices)])
            vertices = np.vstack([vertices, crumb.vertices])
        read = read_mesh(write(tmp_path / "a.ply", vertices, faces))
        assert read.closed and read.mesh.volume == pytest.approx(mesh.volume, rel=1e-6)
        assert any(kind in note for note in read.notes)
        assert (read.vertex_map[len(mesh.vertices) :] == -1).all()

    def test_large_hole_is_refused_but_of_a_bone(self, tmp_path):
        mesh = ball()
        cut = mesh.faces[mesh.triangles_center[:, 2] < 8]
        path = write(tmp_path / "large.ply", mesh.vertices, cut)
        with pytest.raises(
            MeshError, match=r"large\.ply.*open.*boundary edges, one at \(.*\); close"
        ):
            read_mesh(path)
        assert not read_mesh(path, may_be_open=True).closed

    def test_repeated_vertices_are_merged_and_keep_their_numbers(self, tmp_path):
        mesh = ball()
        soup = mesh.vertices[mesh.faces].reshape(-1, 3)
        read = read_mesh(write(tmp_path / "soup.ply", soup, np.arange(len(soup)).reshape(-1, 3)))
        assert read.closed and len(read.mesh.vertices) == len(mesh.vertices)
        mapped = read.mesh.vertices[read.vertex_map]
        assert np.abs(mapped - soup).max() < 1e-4

    def test_repeated_and_degenerate_triangles_and_loose_vertices_are_dropped(self, tmp_path):
        mesh = ball()
        vertices = np.vstack([mesh.vertices[:5], [[0, 0, 60.0]], mesh.vertices[5:]])
        faces = mesh.faces + (mesh.faces >= 5)
        a, b, _ = faces[0]
        read = read_mesh(
            write(tmp_path / "a.ply", vertices, np.vstack([faces, faces[3:4], [[a, a, b]]]))
        )
        assert read.closed and len(read.mesh.vertices) == len(mesh.vertices)
        assert read.vertex_map[5] == -1 and read.vertex_map[6] == 5
        assert any("2 degenerate or repeated" in note for note in read.notes)

    def test_few_triangles_at_edges_of_more_than_two_are_dropped_from_a_bone(self, tmp_path):
        mesh = ball()
        edges = mesh.edges_unique[[10, 300]]
        extra = np.column_stack([edges, (edges[:, 0] + 90) % len(mesh.vertices)])
        file = write(tmp_path / "bone.ply", mesh.vertices, np.vstack([mesh.faces, extra]))
        read = read_mesh(file, may_be_open=True)
        assert read.mesh.volume == pytest.approx(mesh.volume, rel=0.01)
        assert len(read.mesh.faces) <= len(mesh.faces)

    @pytest.mark.parametrize(
        ("away", "words"),
        [([10, 10, 0], "more than two triangles.*manifold"), ([60, 0, 0], "2 separate parts")],
    )
    def test_boxes_that_share_an_edge_or_nothing_are_refused(self, tmp_path, away, words):
        box = trimesh.creation.box((10, 10, 10))
        both = trimesh.util.concatenate([box, box.copy().apply_translation(away)])
        both.merge_vertices()
        with pytest.raises(MeshError, match=rf"pair\.ply.*{words}"):
            read_mesh(write(tmp_path / "pair.ply", both.vertices, both.faces))

    def test_one_sided_surface_is_refused(self, tmp_path):
        strip, angle = (
            np.array([-8.0, 8.0]),
            np.repeat(np.linspace(0, 2 * np.pi, 40, endpoint=False), 2),
        )
        width = np.tile(strip, 40)
        away = 30 + width * np.cos(angle / 2)
        rim = np.column_stack(
            [away * np.cos(angle), away * np.sin(angle), width * np.sin(angle / 2)]
        )
        faces = [face for k in range(0, 78, 2) for face in ([k, k + 1, k + 3], [k, k + 3, k + 2])]
        path = write(tmp_path / "moebius.ply", rim, [*faces, [78, 79, 0], [78, 0, 1]])
        with pytest.raises(MeshError, match="one side only"):
            read_mesh(path, may_be_open=True)


CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJ = (b"v 0 0 x\n", b"\nf a b c\n", *(CORNERS + b"f 1 2 " + n for n in (b"9", b"9" * 5000, b"-7")))


class TestUnusable:
    @pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".vtk", ".vtp"])
    def test_unreadable_and_empty_files(self, tmp_path, suffix, capfd):
        path = tmp_path / f"junk{suffix}"
        for data in (b"", b"\x00\x01junk" * 30, b"no mesh here\n", *OBJ):
            path.write_bytes(data)
            with pytest.raises(MeshError, match=f"junk\\{suffix}"):
                read_mesh(path)
        assert capfd.readouterr().err == ""


def test_a_mended_mesh_is_kept_and_comes_back_alike(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    mesh = trimesh.creation.icosphere(subdivisions=4)
    faces = np.vstack([mesh.faces[:, ::-1], mesh.faces[:1]])  # inside out, one twice
    given = {"context": "a.stl", "name": "a"}
    first, again = (prepare_mesh(np.array(mesh.vertices), faces, **given) for _ in range(2))
    for name in ("vertices", "faces", "vertex_map"):
        one, other = getattr(first, name), getattr(again, name)
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype and one.flags.c_contiguous == other.flags.c_contiguous
    assert len(first.notes) == 2 and (first.notes, first.closed) == (again.notes, again.closed)
    (entry,) = tmp_path.iterdir()
    arrays = dict(np.load(entry)) | {"notes": np.array("kept")}
    with entry.open("wb") as file:
        np.savez(file, **arrays)
    assert prepare_mesh(np.array(mesh.vertices), faces, **given).notes == ["kept"]
    moved = prepare_mesh(np.array(mesh.vertices) + 1.0, faces, **given)
    np.testing.assert_allclose(moved.vertices, first.vertices + 1.0)


@pytest.mark.parametrize("apart", [1e-6, 1e-5, 1e-4, 1e-3])
def test_corners_of_a_triangle_soup_that_lie_apart_are_joined(apart):
    """A ball of radius 14 whose triangles have corners of their own, moved by up to 1e-3."""
    ball = trimesh.creation.icosphere(3, 14.0)
    corners = ball.triangles.reshape(-1, 3)
    corners = corners + apart * np.random.default_rng(1).uniform(-1, 1, corners.shape)
    faces = np.arange(len(corners)).reshape(-1, 3)
    read = prepare_mesh(corners, faces, context="soup", name="soup", may_be_open=True)
    assert read.closed and len(read.vertices) == len(ball.vertices) and not read.doubt
    assert BoneDistance("soup", read.mesh).signed([[0.0, 0.0, 0.0]])[0] == pytest.approx(
        -14, abs=0.1
    )


def test_bone_without_an_inside_is_doubted():
    ball = trimesh.creation.icosphere(3, 14.0)
    third = ball.faces[ball.triangles_center[:, 2] < -14 / 3]
    flat = trimesh.creation.box([40, 20, 1e-9]).subdivide()
    doubts = [
        prepare_mesh(vertices, faces, context="bone", name="bone", may_be_open=True).doubt
        for vertices, faces in (
            (ball.vertices, ball.faces),
            (ball.vertices, third),
            (flat.vertices, flat.faces),
        )
    ]
    assert doubts[0] == "" and "surface is missing" in doubts[1] and "it is flat" in doubts[2]


@pytest.mark.parametrize("shift", [[250000.0, -480000.0, 1200000.0], [1e9, -1e9, 5e8]])
def test_mesh_far_from_the_origin_has_the_inside_that_it_has_there(shift):
    """Its tree of winding numbers has single precision."""
    ball = trimesh.creation.icosphere(3, 14.0)
    far = ball.vertices + shift
    assert prepare_mesh(far, ball.faces, context="far", name="far").notes == []
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 13.0], [0.0, 0.0, 15.0]])
    assert inside_test(far, ball.faces)(points + shift).tolist() == [True, True, False]
