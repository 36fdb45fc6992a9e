"""A run beside the paths of its model: what OpenSim is asked, what reports show and say without it."""

import csv
import re

import numpy as np
import pytest
import trimesh
from straight_paths import straight_length

import rbfmuscle as rm
from rbfmuscle.opensim import beside
from rbfmuscle.opensim.folder import write_scene
from rbfmuscle.opensim.match import attach, match_meshes
from rbfmuscle.opensim.read import read_osim
from rbfmuscle.opensim.scene import import_osim
from rbfmuscle.run import stream_run
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.show import model_paths
from rbfmuscle.study.show.model_paths import HEADING, coordinates_si
from rbfmuscle.validation import SceneError


@pytest.fixture
def scene_file(small):
    """The small model as a scene in mm with a rod for its hamstring, which the thigh holds instead of the ground."""
    small.write_text(
        small.read_text().replace(
            '<PathPoint name="a"><socket_parent_frame>/ground<',
            '<PathPoint name="a"><socket_parent_frame>/bodyset/thigh<',
        )
    )
    folder = small.parent / "muscles"
    folder.mkdir()
    rod = trimesh.creation.icosphere(subdivisions=2)
    rod.apply_scale([20, 260, 20])
    rod.apply_translation([-40, -220, 0])
    rod.export(folder / "hamstring.ply")
    found = import_osim(small, units="mm")
    matches = match_meshes(found, folder)
    for match in matches:
        attach(found, match)
    return write_scene(found, small.parent / "out", matches=matches)


@pytest.fixture
def run(scene_file, tmp_path):
    """A saved run of two frames without a report, knee and cap."""
    scene = rm.Scene.load(scene_file).set_motion(ramp={"knee_angle": {"from": -20, "to": -30, "step": 5}})
    scene = scene.with_options(
        {"output.report": False, "output.preview": False, "output.moment_arms": True}, model="pbd"
    )
    stream_run(scene, tmp_path / "run", pictures=False)
    return tmp_path / "run"


def make_strict(file):
    """What OpenSim itself asks for: a name without a space, masses, no constraint that is not whole."""
    text = (
        file.read_text().replace("small leg", "small_leg").replace('<PointOnLineConstraint name="rail"/>', "")
    )
    text = text.replace('<Body name="cap"/>', '<Body name="cap"></Body>')
    still = [
        ("rotation2", "0 1 0"),
        ("rotation3", "1 0 0"),
        ("translation2", "0 1 0"),
        ("translation3", "0 0 1"),
    ]
    axes = "".join(
        f'<TransformAxis name="{name}"><axis>{axis}</axis><Constant><value>0</value></Constant></TransformAxis>'
        for name, axis in still
    )
    text = text.replace("<socket_child_frame>thigh", "<socket_child_frame>/bodyset/thigh")
    text = text.replace("</SpatialTransform>", axes + "</SpatialTransform>")
    mass = "<mass>1</mass><inertia>1 1 1 0 0 0</inertia>"
    file.write_text(re.sub(r'(<Body name="\w+">)', rf"\1{mass}", text))


def test_an_imported_scene_knows_its_model(scene_file, small):
    table = rm.Scene.load(scene_file).opensim
    assert table.muscles == {"hamstring": ["hamstring"]}
    assert (scene_file.parent / table.model).samefile(small)
    text = scene_file.read_text().replace('{ hamstring = ["hamstring"] }', '{ hamstrin = ["hamstring"] }')
    scene_file.write_text(text)
    with pytest.raises(SceneError, match=r"\[opensim\]: unknown muscle 'hamstrin', did you mean 'hamstring'"):
        rm.Scene.load(scene_file)


def test_resting_coordinates_are_told_in_radians_and_metres(run):
    values = coordinates_si(SavedRun(run))
    assert [row["knee.knee_angle"] for row in values] == pytest.approx(np.radians([-20, -25, -30]).tolist())
    assert values[0]["hip.hip_angle"] == 0.0
    # The slide follows the knee: 0.1 of its angle and 20 mm.
    assert values[0]["cap_joint.slide"] == pytest.approx(0.02 - 0.05)


def test_without_opensim_the_report_says_so_in_one_line(run, monkeypatch):
    monkeypatch.setattr(beside, "_installed", lambda: False)
    section = model_paths.beside_section({"run": SavedRun(run)})
    assert HEADING in section and section.count("<p") == 1 and "pip install" in section
    assert not (run / "opensim.csv").exists()


def test_a_scene_without_a_model_has_no_section(run):
    saved = SavedRun(run)
    saved.info["scene"]["opensim"] = None
    assert model_paths.beside_section({"run": saved}) == ""


def test_opensim_answers_are_in_the_tables_and_the_report(small, scene_file, run):
    pytest.importorskip("opensim.simulation")
    make_strict(small)
    saved = SavedRun(run)
    section = model_paths.beside_section({"run": saved})
    assert section.count("<figure>") == 2 and "Moment arm: hamstring, knee.knee_angle" in section
    rows = list(csv.DictReader((run / "opensim.csv").read_text().splitlines()))
    model = read_osim(small)
    angles = np.radians([-20, -25, -30])
    lengths = [float(row["value"]) for row in rows if row["quantity"] == "length"]
    assert lengths == pytest.approx(
        [1000 * straight_length(model, model.paths[0], {"knee_angle": a}) for a in angles]
    )
    arms = [float(row["value"]) for row in rows if row["quantity"] == "moment_arm"]
    h = 1e-5
    ends = [
        [straight_length(model, model.paths[0], {"knee_angle": a + s * h}) for s in (-1, 1)] for a in angles
    ]
    assert arms == pytest.approx([-1000 * (high - low) / (2 * h) for low, high in ends], rel=1e-6)
    assert {row["unit"] for row in rows} == {"mm"}


def test_a_model_that_opensim_refuses_is_one_line(run):
    pytest.importorskip("opensim.simulation")
    section = model_paths.beside_section({"run": SavedRun(run)})  # its name has a space
    assert section.count("<p") == 1 and "OpenSim refused small.osim" in section
