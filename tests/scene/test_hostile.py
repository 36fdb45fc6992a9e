"""Scenes and meshes made to break the program: each ends in one line with its code, before anything
grows.
"""

import numpy as np
import pytest
from fuzz.harness import check_volume
from fuzz.meshes import KINDS, base_scene, damaged_shape, muscle_mesh, write_base
from fuzz.scenes import Raw, nested, to_toml

from rbfmuscle.models import build_model, check_models
from rbfmuscle.scene.check import check_initial
from rbfmuscle.scene.meshes.read import prepare_mesh, read_mesh
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation import substeps
from rbfmuscle.simulation.substeps import check_substeps
from rbfmuscle.validation import MeshError, SceneError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    write_base(folder)
    return folder


def refused(folder, change, words):
    """The one line with which the base scene is refused once it was changed."""
    tables = base_scene()
    change(tables)
    path = folder / "scene.toml"
    path.write_text(to_toml(tables))
    with pytest.raises(SceneError, match=words) as caught:
        scene = Scene.load(path)
        check_models(scene)
        check_substeps(scene)
        check_initial(scene)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 1000
    return text


def put(*path):
    """A change of the tables: the last of ``path`` is the value, the others lead to its place."""
    *keys, last, value = path

    def change(tables):
        for key in keys:
            tables = tables[key]
        tables[last] = value

    return change


class TestNumbers:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (put("contact", "substep_angle", Raw("9" * 5000)), "not valid TOML"),
            (put("muscle", 0, "attach", 0, "vertices", [10**19]), "2\\^53"),
            (put("muscle", 0, "attach", 0, "vertices", [2**52]), "out of range"),
            (put("joint", 0, "centre", nested(1000)), "nested"),
            (
                put("classes", "main", "model", float("inf")),
                "classes.main.model: must be a finite number, got inf",
            ),
            (put("contact", "substep_angle", float("nan")), "finite"),
            (put("muscle", 0, "mesh", "/dev/zero"), "not a mesh|no such"),
        ],
    )
    def test_value_that_no_key_can_mean(self, folder, change, words):
        try:
            refused(folder, change, words)
        except MeshError as error:  # of meshes the mesh is at fault
            assert "no such" in str(error) or "not a mesh" in str(error)

    def test_numbers_of_files(self, folder):
        (folder / "huge.txt").write_text("1 2 99999999999999999999")
        refused(folder, put("muscle", 0, "attach", 0, "vertices", "huge.txt"), "out of range")
        (folder / "long.txt").write_text("9" * 5000)
        refused(
            folder, put("muscle", 0, "attach", 0, "vertices", "long.txt"), "not a vertex number"
        )
        (folder / "deep.json").write_text("[" * 100_000)
        refused(folder, put("muscle", 0, "fibres", "deep.json"), "not JSON")
        for lines in ("[[[1e400, 0, 0], [1, 0, 0]]]", '[["a"]]', "[[1]]", "[[[0, 0, 1]]]"):
            (folder / "odd.json").write_text(lines)
            refused(folder, put("muscle", 0, "fibres", "odd.json"), "polyline 0")


STOPS = [{"hip.flexion": 0.0}, {"hip.flexion": 80.0}] * 1000


class TestMotions:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (
                put("motion", {"ramp": {"hip.flexion": {"to": 1e6, "step": 100.0}}}),
                "takes about|frames",
            ),
            (put("joint", 0, "centre", [1e12, 0.0, 0.0]), r"1e\+12 mm away from all bones"),
            (
                put("joint", 0, "centre", [1e5, 0.0, 0.0]),
                "more than 1000.*far from the joint's centre",
            ),
            (put("contact", "substep_angle", 1e-9), "substep_angle = 1e-09 is small"),
            (put("motion", {"waypoints": STOPS, "step": 1e-300}), "more than 100000"),
            # No pair of stops is too far apart by itself.
            (put("motion", {"waypoints": STOPS, "step": 0.1}), "more than 100000"),
        ],
    )
    def test_motion_without_end(self, folder, monkeypatch, change, words):
        monkeypatch.setattr(substeps, "MOST_SUBSTEPS", 1000)
        refused(folder, change, words)

    def test_one_frame_that_needs_too_many(self, monkeypatch):
        monkeypatch.setattr(substeps, "MOST_SUBSTEPS", 5)
        with pytest.raises(SceneError, match="more than 5"):
            check_substeps(phantom_scene())
        monkeypatch.setattr(substeps, "MOST_IN_FRAME", 5)
        with pytest.raises(SceneError, match="more than 5"):
            substeps.SubSteps(phantom_scene()).split({}, {"hip.flexion": 0.5, "hip.adduction": 0.5})


MESH = muscle_mesh()


class TestMeshes:
    @pytest.mark.parametrize("kind", range(KINDS))
    @pytest.mark.parametrize("seed", range(3))
    def test_damaged_mesh_is_mended_with_its_volume_or_refused_in_one_line(
        self, kind, seed, tmp_path
    ):
        path = tmp_path / "a.stl"
        damaged_shape(np.random.default_rng(seed), kind).export(path)
        try:
            mesh = read_mesh(path).mesh
        except MeshError as error:
            assert "a.stl" in str(error) and "\n" not in str(error)
        else:
            assert mesh.is_watertight
            check_volume(np.asarray(mesh.vertices), np.asarray(mesh.faces), "a.stl")

    def test_surface_without_an_inside_is_refused(self):
        x, y, z = MESH.vertices.T
        folded = np.where(z > -10, -20 - z, z)
        for columns in ((34.0 + 0 * x, y, z), (34.0 + 0 * x, 34.0 + 0 * x, z), (x, y, folded)):
            with pytest.raises(MeshError, match="passes through itself"):
                prepare_mesh(
                    np.column_stack(columns), np.array(MESH.faces), context="a.ply", name="a"
                )

    @pytest.mark.parametrize("value", [1e300, -1e38, np.nan, np.inf])
    def test_vertex_beyond_all_lengths(self, value):
        vertices = np.array(MESH.vertices)
        vertices[5, 1] = value
        with pytest.raises(MeshError, match=r"vertices are (further away|not finite).*number 5"):
            prepare_mesh(vertices, np.array(MESH.faces), context="a.ply", name="a")

    def test_surface_that_crosses_itself_a_little_is_noted(self):
        vertices = np.array(MESH.vertices)
        vertices[:40] += np.random.default_rng(1).normal(size=(40, 3)) * 6
        notes = prepare_mesh(vertices, np.array(MESH.faces), context="", name="").notes
        assert any("passes through itself" in note for note in notes)

    @pytest.mark.parametrize("kind", [0, 1, 2], ids=["points", "edges", "lines"])
    @pytest.mark.parametrize("model", ["rbf", "pbd"])
    def test_collapsed_triangles_make_a_muscle(self, folder, kind, model):
        damaged_shape(np.random.default_rng(0), kind).export(folder / "collapsed.ply")
        few = {"centres": 40, "samples": 100} if model == "rbf" else {}
        tables = base_scene()
        tables["muscle"][0] |= {"mesh": "collapsed.ply", "model": {"name": model, **few}}
        (folder / "collapsed.toml").write_text(to_toml(tables))
        scene = Scene.load(folder / "collapsed.toml")
        assert np.isfinite(build_model(scene.muscles[0], scene).contact_points()).all()
        assert scene.muscles[0].mesh.volume == pytest.approx(MESH.volume, rel=0.1)

    def test_damaged_stl_says_nothing_of_its_own(self, tmp_path, capfd):
        text, binary = MESH.export(file_type="stl_ascii").encode(), MESH.export(file_type="stl")
        path, many = tmp_path / "a.stl", binary[:80] + b"\xff\xff\xff\xff" + binary[84:]
        for data in (text[:9000], text.replace(b"vertex", b"vertex x", 1), binary[:9000], many):
            path.write_bytes(data)
            with pytest.raises(MeshError, match=r"a\.stl"):
                read_mesh(path)
        assert capfd.readouterr() == ("", "")
