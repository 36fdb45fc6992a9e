"""Small inputs after public bug reports, where their scripts are: each gives what its script says.

The scripts stand beside the real data, in ``reference/cases``; they need nothing of this package.
"""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import call
from conftest import find_data

import rbfmuscle as rm
from rbfmuscle.geometry.lines import line_length
from rbfmuscle.importers.guess.guess import guess_scene
from rbfmuscle.importers.opensim import tubes
from rbfmuscle.importers.opensim.scene import import_osim
from rbfmuscle.importers.volumes import label_surface, read_labels
from rbfmuscle.metrics.rows import moment_arms
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.validation import MeshError


@pytest.fixture
def folder():
    """The folder of the scripts."""
    cases = find_data("leg").parents[1] / "reference" / "cases"
    if not cases.is_dir():
        pytest.skip("reference/cases is not here")
    return cases


@pytest.fixture
def write_case(folder, tmp_path, monkeypatch):
    """Runs a script by its number; the folder with what it wrote."""

    def write(number, *arguments):
        (script,) = folder.glob(f"case{number:02d}_*.py")
        monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments), str(tmp_path)])
        runpy.run_path(str(script), run_name="__main__")
        return tmp_path

    return write


def test_every_script_has_a_test(folder):
    tested = set(re.findall(r"^def test_case_(\d+)_", Path(__file__).read_text(), re.M))
    assert {path.name[4:6] for path in folder.glob("case*.py")} == tested


def test_case_02_empty_masks(write_case, capsys):
    out = write_case(2)
    truth = json.loads((out / "truth.json").read_text())
    volume = read_labels(out / "masks")
    found = [label_surface(volume, int(label)) for label in volume.values()]
    assert {surface.name for surface in found} == set(truth)
    for surface in found:
        assert surface.mesh.volume == pytest.approx(truth[surface.name]["volume"], rel=0.01)
    for folder in ("all_empty", "other_shape"):
        code, _, said = call(capsys, "new", out / folder)
        assert code == 4 and len(said.strip().splitlines()) == 1


def test_case_03_float_labels(write_case):
    out = write_case(3)
    truth = json.loads((out / "truth.json").read_text())
    for name in ("almost", "cut", "slope", "four", "large"):
        names = out / ("names_large.csv" if name == "large" else "names.csv")
        volume = read_labels(out / f"{name}.nii.gz", names=names)
        found = {volume.name(k): label_surface(volume, int(k)).volume for k in volume.values()}
        assert found == pytest.approx(truth, rel=0.01), name
    for name in ("mixed", "vector"):
        with pytest.raises(MeshError):
            read_labels(out / f"{name}.nii.gz", names=out / "names.csv")


def test_case_06_dialects_of_stl(write_case):
    out = write_case(6)
    plain = read_mesh(out / "single" / "plain.stl")
    for path in (out / "single").iterdir():
        read = read_mesh(path)
        assert len(read.vertices) == len(plain.vertices), path.name
        assert read.mesh.volume == pytest.approx(plain.mesh.volume, rel=1e-4)
    for path in (out / "broken" / "truncated.stl", out / "several" / "femur_tibia.stl"):
        with pytest.raises(MeshError):
            read_mesh(path)
    femur = read_mesh(out / "several" / "second_empty.stl")
    assert any("tibia" in note for note in femur.notes)


def test_case_08_polygons_of_obj(write_case):
    out = write_case(8)
    for path in out.glob("*.obj"):
        if path.stem in ("bad", "two"):
            with pytest.raises(MeshError):
                read_mesh(path)
            continue
        mesh = read_mesh(path).mesh
        assert mesh.volume == pytest.approx(20000.0, rel=1e-6), path.name
        assert mesh.area == pytest.approx(5800.0, rel=1e-6), path.name


def test_case_09_marrow_cavities(write_case):
    out = write_case(9)
    for name in ("solid", "inwards", "outwards", "touching", "beside", "three"):
        bone = BoneDistance(name, read_mesh(out / f"{name}.ply", may_be_open=True).mesh)
        points = [[0, 0, 0], [13, 0, 0], [11, 0, 0], [25, 0, 0]]
        # 2562 vertices on a ball of radius 20.
        np.testing.assert_allclose(bone.signed(points), [-20, -7, -9, 5], atol=0.05)
        if name == "beside":
            np.testing.assert_allclose(bone.signed([[0, 40, 0]]), [-5], atol=0.05)


def test_case_10_loops_of_joints(write_case, capsys):
    out = write_case(10)
    for path in sorted(out.glob("*.osim")):
        code, _, said = call(capsys, "import", path, "-o", out / path.stem)
        assert code in (0, 3) and "Traceback" not in said, path.stem
        assert path.stem != "plain" or code == 0


def test_case_11_no_joint_to_the_ground(write_case):
    out = write_case(11)
    for name in ("one_tree", "v3"):
        found = import_osim(out / f"{name}.osim")
        np.testing.assert_allclose(found.places["lower"][:3, 3], [0.0, -0.4, 0.0], atol=1e-6)
    # The script has the sign of its x otherwise; OpenSim 4.6 has this.
    exchanged = import_osim(out / "exchanged.osim")
    np.testing.assert_allclose(
        exchanged.places["upper"][:3, 3], [0.191770, 0.351033, 0.0], atol=1e-6
    )


def test_case_24_far_from_the_origin(write_case):
    out = write_case(24)
    near, far, very_far = (rm.Scene.load(out / f"{n}.toml") for n in ("near", "far", "veryfar"))
    for scene in (far, very_far):
        assert scene.muscles[0].notes == []
        assert scene.muscles[0].mesh.volume == pytest.approx(near.muscles[0].mesh.volume, rel=1e-8)
    said = [" ".join(map(str, rm.check_scene(scene))) for scene in (near, far, very_far)]
    assert "single precision" not in said[0] and "single precision" in said[1]
    assert "lose digits" not in said[1] and "lose digits" in said[2]


def test_case_29_points_that_move_are_said(write_case):
    found = import_osim(write_case(29) / "points.osim")
    for name in ("conditional", "moving", "scaledmove"):
        assert any(f"'{name}'" in doubt for doubt in found.scene.doubts)
    assert not any("'always'" in doubt for doubt in found.scene.doubts)


def test_case_34_voxels_that_touch(write_case):
    out = write_case(34)
    truth = json.loads((out / "truth.json").read_text())
    for name, volume in truth.items():
        labels = read_labels(out / f"{name}.nii.gz", names=out / "names.csv")
        surface = label_surface(labels, 2)
        share = 0.5 if name == "corner" else 1.0
        assert surface.mesh.volume == pytest.approx(share * volume, rel=0.05), name
        assert surface.mesh.is_volume and surface.mesh.body_count == 1
        assert share == 1.0 or any("50 %" in note for note in surface.notes)
    labels = read_labels(out / "slice.nii.gz", names=out / "slice.csv")
    patella = label_surface(labels, 5, pieces=True)
    assert patella.mesh.is_volume and patella.mesh.extents.max() < 15.0


@pytest.mark.parametrize("name", ["follow", "plain"])
def test_case_42_a_coordinate_that_follows(write_case, name):
    truth = json.loads((write_case(42) / "truth.json").read_text())[name]
    path = [{"hip.flexion": np.radians(row["angle"])} for row in truth]
    arms = moment_arms(path, [row["distance"] for row in truth])
    for row, found in zip(truth, arms):
        assert found["hip.flexion"] == pytest.approx(row["effective"], rel=0.05), row["angle"]


def test_case_42_settles_where_the_ends_of_a_slender_muscle_approach(write_case):
    run = rm.simulate(write_case(42) / "coupled.toml", settings={"output.surfaces": False})
    assert max(row.value for row in run.metrics if row.quantity == "solver_residual") < 1e-4


def test_case_45_ends_in_what_a_path_goes_around(write_case, monkeypatch):
    """Lengths of OpenSim 4.6, as the script has them where OpenSim is there."""
    lines = {}
    make, fitted = tubes.make_tube, tubes._clear_line

    def keep(*given):
        lines["last"] = fitted(*given)
        return lines["last"]

    monkeypatch.setattr(tubes, "_clear_line", keep)

    def remember(muscle, *given):
        tube = make(muscle, *given)
        lines[muscle.name] = line_length(lines["last"])
        assert tube.volume_error < tubes.MOST_MISSED
        return tube

    monkeypatch.setattr("rbfmuscle.importers.opensim.scene.make_tube", remember)
    found = import_osim(write_case(45) / "wraps.osim")
    known = {
        "outside": 0.33002,
        "inside": 0.24828,
        "on": 0.24563,
        "behind": 0.31102,
        "sphere": 0.22204,
        "ell": 0.31629,
    }
    assert {muscle.name for muscle in found.scene.muscles} == set(known)
    assert {name: lines[name] for name in known} == pytest.approx(known, rel=0.03)


def test_case_46_bones_cut_by_the_field_of_view(write_case, tmp_path_factory, leg_data):
    pytest.importorskip("shapely")  # the script cuts with it
    right = tmp_path_factory.mktemp("right")
    for path in (*(leg_data / "bones").glob("*.ply"), *(leg_data / "muscles").glob("*.ply")):
        trimesh.load(path, process=False).export(right / path.name)
    out = write_case(46, right)
    whole = guess_scene(out / "whole_hip", "mm", out)
    for name in ("hip50", "hip30", "hip20", "hip_open"):
        cut = guess_scene(out / name, "mm", out)
        assert cut.orientation.superior @ whole.orientation.superior > np.cos(np.radians(5))
        assert cut.orientation.anterior @ whole.orientation.anterior > np.cos(np.radians(5))
        assert any("femur: it is cut off" in doubt for doubt in cut.doubts())
        np.testing.assert_allclose(cut.joints[0].centre, whole.joints[0].centre, atol=1.0)
    axes = [
        next(
            j.axes["flexion"]
            for j in guess_scene(out / name, "mm", out).joints
            if j.kind == "hinge"
        )
        for name in ("knee", "whole_knee")
    ]
    assert axes[0] @ axes[1] > np.cos(np.radians(5))
