"""The ways to say which vertices a bone holds, and fibres of VTP files: known answers."""

import json

import numpy as np
import pytest
import pyvista
import trimesh

from rbfmuscle.scene.meshes.read import read_fibres
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import SceneError

EGG = trimesh.creation.icosphere(subdivisions=3).apply_scale([40, 10, 10])
BONE = trimesh.creation.box((20, 20, 20)).apply_translation([-50, 0, 0])
END = np.flatnonzero(EGG.vertices[:, 0] < -25)
RED, GREY = (255, 0, 0, 255), (128, 128, 128, 255)


def held(mesh, attach, **place):
    """Vertices that the first entry of ``attach`` holds."""
    scene = Scene("s").add_bone("a", BONE).add_muscle("m", mesh, attach=[attach], **place)
    return scene.muscles[0].attachments[0].vertices


def write_ply(path, values, *, double=()):
    """The egg with a vertex array; the vertices ``double`` are written twice, for two faces."""
    order = [*range(len(EGG.vertices)), *double]
    faces = EGG.faces.copy()
    for copy, vertex in enumerate(double, len(EGG.vertices)):
        first = np.argwhere(faces == vertex)[0]
        faces[tuple(first)] = copy
    head = f"ply\nformat ascii 1.0\nelement vertex {len(order)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "property uchar end\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, map(float, EGG.vertices[k]))) + f" {values[k]}" for k in order]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def marks():
    values = np.zeros(len(EGG.vertices), dtype=int)
    values[END] = 7
    return values


class TestArrays:
    def test_of_a_ply_file(self, tmp_path):
        file = write_ply(tmp_path / "egg.ply", marks())
        assert np.array_equal(held(file, {"bone": "a", "array": "end"}), END)

    def test_of_a_vtp_file(self, tmp_path):
        data = pyvista.make_tri_mesh(np.array(EGG.vertices), EGG.faces)
        data.point_data["end"] = marks().astype(float)
        data.save(tmp_path / "egg.vtp")
        assert np.array_equal(held(tmp_path / "egg.vtp", {"bone": "a", "array": "end"}), END)

    def test_numbers_are_those_of_the_file_where_vertices_are_merged(self, tmp_path):
        double = END[:3].tolist()
        file = write_ply(tmp_path / "egg.ply", marks(), double=double)
        copies = list(range(len(EGG.vertices), len(EGG.vertices) + len(double)))
        by_array = held(file, {"bone": "a", "array": "end"})
        points = Scene("s").add_muscle("m", file).muscles[0].mesh.vertices
        assert len(points) == len(EGG.vertices)
        assert np.array_equal(np.sort(points[by_array], axis=0), np.sort(EGG.vertices[END], axis=0))
        by_copies = held(file, {"bone": "a", "vertices": copies})
        assert np.allclose(np.sort(points[by_copies]), np.sort(EGG.vertices[double]), atol=1e-5)

    @pytest.mark.parametrize(
        ("values", "name", "words"),
        [
            (marks(), "ends", "no vertex array 'ends', did you mean 'end'"),
            (0 * marks(), "end", "zero"),
        ],
    )
    def test_missing_or_empty_arrays_are_named(self, tmp_path, values, name, words):
        file = write_ply(tmp_path / "egg.ply", values)
        with pytest.raises(SceneError, match=f"'m' attach 1: .*{words}"):
            held(file, {"bone": "a", "array": name})

    def test_arrays_need_a_file_that_has_them(self, tmp_path):
        EGG.export(tmp_path / "egg.stl")
        for mesh, words in ((EGG, "read from a file"), (tmp_path / "egg.stl", "PLY or VTP")):
            with pytest.raises(SceneError, match=words):
                held(mesh, {"bone": "a", "array": "end"})


class TestLandmarks:
    def test_within_a_radius_of_any(self, tmp_path):
        points = [[-40, 0, 0], [40, 0, 0]]
        away = np.min([np.linalg.norm(EGG.vertices - p, axis=1) for p in points], axis=0)
        expected = np.flatnonzero(away <= 12)
        assert np.array_equal(held(EGG, {"bone": "a", "points": points, "radius": 12}), expected)
        (tmp_path / "p.csv").write_text("x,y,z\n-40,0,0\n40,0,0\n")
        file = {"bone": "a", "points": tmp_path / "p.csv", "radius": 12}
        assert np.array_equal(held(EGG, file), expected)

    def test_too_few_points_need_a_radius(self):
        with pytest.raises(SceneError, match=r"2 points, at least 3 .* radius"):
            held(EGG, {"bone": "a", "points": [[-40, 0, 0], [40, 0, 0]]})


class TestRegions:
    def test_patch_of_the_same_mesh(self, tmp_path):
        patch = EGG.submesh([np.isin(EGG.faces, END).all(axis=1)], append=True)
        patch.export(tmp_path / "patch.ply")
        assert np.array_equal(held(EGG, {"bone": "a", "region": tmp_path / "patch.ply"}), END)

    def test_painted_in_a_finer_mesh_that_lies_as_the_muscle_does(self, tmp_path):
        """The colour's edge is blurred over one triangle of the finer mesh."""
        fine = EGG.subdivide()
        colours = np.array([RED if x < -25 else GREY for x in fine.vertices[:, 0]], dtype=np.uint8)
        fine.visual.vertex_colors = colours
        fine.export(tmp_path / "fine.ply")
        EGG.export(tmp_path / "egg.ply")
        place = {"scale": 0.1, "mirror": "x", "transform": {"translate": [-2, 0, 0]}}
        entry = {"bone": "a", "region": tmp_path / "fine.ply", "colour": "#ff0000"}
        assert set(held(tmp_path / "egg.ply", entry, **place)) ^ set(END) <= set(
            np.flatnonzero(abs(EGG.vertices[:, 0] + 25) < 2.5)
        )
        assert len(held(tmp_path / "egg.ply", entry, **place)) > 20

    def test_region_elsewhere_is_named(self, tmp_path):
        EGG.copy().apply_translation([0, 0, 90]).export(tmp_path / "far.ply")
        with pytest.raises(SceneError, match=r"no vertex of the muscle lies on .*far.ply"):
            held(EGG, {"bone": "a", "region": tmp_path / "far.ply"})


class TestFibres:
    LINES = (((0, 0, 0), (1, 2, 3), (4, 5, 6)), ((7, 8, 9), (1, 1, 1)))

    def test_polylines_of_a_vtp_file_are_those_of_json(self, tmp_path):
        points = np.array([point for line in self.LINES for point in line], dtype=float)
        data = pyvista.PolyData(points, lines=[3, 0, 1, 2, 2, 3, 4])
        data.save(tmp_path / "f.vtp")
        (tmp_path / "f.json").write_text(json.dumps({"polylines": self.LINES}))
        pairs = zip(read_fibres(tmp_path / "f.vtp"), read_fibres(tmp_path / "f.json"), strict=True)
        assert all(np.array_equal(*pair) for pair in pairs)

    def test_a_surface_has_no_polylines(self, tmp_path):
        pyvista.make_tri_mesh(np.array(EGG.vertices), EGG.faces).save(tmp_path / "f.vtp")
        for name, words in (("f.vtp", "no polylines"), ("g.vtp", "no such file")):
            with pytest.raises(SceneError, match=words):
                read_fibres(tmp_path / name)
