"""Own muscles and own bones beside a model's: names, first attachments, registration, joints that come along."""

import copy
import csv
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import rbfmuscle as rm
from rbfmuscle.app import run_command
from rbfmuscle.opensim.folder import write_scene
from rbfmuscle.opensim.match import attach, likeness, match_meshes, name_score, split_name, write_table
from rbfmuscle.opensim.register import bring_to_bones, fit_similarity, register
from rbfmuscle.opensim.scene import import_osim
from rbfmuscle.sim.joints.skeleton import all_coordinates
from rbfmuscle.sim.scene.motion import bone_poses
from rbfmuscle.validation import UsageError


@pytest.mark.parametrize(
    ("muscle", "mesh"),
    [
        ("bifemlh_r", "biceps_femoris_long_head"),
        ("glmax3_r", "gluteus_maximus"),
        ("glut_med2_l", "GluteusMedius"),
        ("med_gas_r", "gastrocnemius_medial"),
        ("addmagIsch_r", "adductor-magnus"),
        ("edl_r", "m_extensor_digitorum_longus"),
        ("peri_r", "piriformis_right"),
        ("soleus_r", "Soleus R"),
    ],
)
def test_short_names_stand_for_long_ones(muscle, mesh):
    assert name_score(muscle, *split_name(mesh)) > 0.8


@pytest.mark.parametrize(
    ("muscle", "mesh"),
    [
        ("glmed1_r", "gluteus_minimus"),
        ("per_tert_r", "peroneus_longus"),
        ("soleus_r", "soleus_left"),
        ("fdl_r", "extensor_digitorum_longus"),
    ],
)
def test_other_muscles_do_not_match(muscle, mesh):
    assert name_score(muscle, *split_name(mesh)) == 0.0


def test_likeness_is_one_for_the_word_itself_and_less_the_shorter_the_piece_of_it():
    assert likeness("gluteus", ("gluteus",)) == pytest.approx(1.0)
    assert likeness("gluteusmaximus", ("gluteus", "maximus")) == pytest.approx(1.0)
    pieces = [likeness("gluteus"[:count], ("gluteus",)) for count in range(1, 8)]
    assert pieces == sorted(set(pieces)) and pieces[0] > 0.5, (
        "a piece of a word is nearly as good as the word"
    )
    assert likeness("gluteus", ("gluteus", "maximus")) == 0.5


def test_likeness_is_quick_for_long_nonsense():
    assert likeness("a" * 60 + "b", ("a" * 30, "aa", "aaa", "aaaa")) == 0.0


def test_similarity_is_found_back_without_mirroring():
    points = np.random.default_rng(1).normal(size=(50, 3))
    turn = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    fit = fit_similarity(points, 1.7 * points @ turn.T + [1, 2, 3])
    assert fit.scale == pytest.approx(1.7) and fit.turn == pytest.approx(turn)
    assert np.linalg.det(fit_similarity(points, points * [1, 1, -1]).turn) == pytest.approx(1.0)


@pytest.fixture
def own(small):
    """The small model in mm, and a folder with a mesh along its hamstring and one of no muscle."""
    found = import_osim(small, units="mm")
    folder = small.parent / "muscles"
    folder.mkdir()
    rod = trimesh.creation.icosphere(subdivisions=3)
    rod.apply_scale([20, 260, 20])
    rod.apply_translation([-40, -220, 0])
    rod.export(folder / "hamstring_right.ply")
    rod.export(folder / "masseter.ply")
    return found, folder


def test_own_muscles_get_first_attachments_marked_as_guesses(own, tmp_path):
    found, folder = own
    # What the ground holds, the thigh does here: the ground has no mesh.
    found.model.paths[0].points[0].body = "thigh"
    matches = match_meshes(found, folder)
    for match in matches:
        attach(found, match)
    assert [[path.name for path in match.paths] for match in matches] == [["hamstring"], []]
    assert [bone for bone, _ in matches[0].ends] == ["thigh", "shank"]
    text = write_scene(found, tmp_path / "out", matches=matches).read_text()
    assert text.count("GUESS") == 3 and "masseter.ply is left out: no muscle" in text
    scene = rm.Scene.load(tmp_path / "out" / "scene.toml")
    assert {a.bone for a in scene.muscle("hamstring_right").attachments} == {"thigh", "shank"}
    write_table(matches, tmp_path / "matches.csv")
    rows = list(csv.DictReader((tmp_path / "matches.csv").read_text().splitlines()))
    rows[1]["muscles"] = "hamstring"
    with (tmp_path / "corrected.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    marked = b"\xef\xbb\xbf" + (tmp_path / "corrected.csv").read_bytes()  # as a spreadsheet writes it
    (tmp_path / "marked.csv").write_bytes(marked)
    for table in ("corrected.csv", "marked.csv"):
        again = match_meshes(found, folder, tmp_path / table)
        assert [path.name for path in again[1].paths] == ["hamstring"]
    (tmp_path / "wrong.csv").write_text("mesh,muscles\nmasseter.ply,nobody\n")
    with pytest.raises(UsageError, match="no muscle 'nobody'"):
        match_meshes(found, folder, tmp_path / "wrong.csv")
    (tmp_path / "wrong.csv").write_bytes(b"PK\x03\x04\xff\xfe\n\xff\n")
    with pytest.raises(UsageError, match="no mesh None in the folder; correct the row"):
        match_meshes(found, folder, tmp_path / "wrong.csv")


@pytest.mark.parametrize("subdivisions", [3, 4])
def test_an_end_takes_the_same_share_of_a_muscle_however_fine_it_is(own, subdivisions):
    found, folder = own
    found.model.paths[0].points[0].body = "thigh"
    rod = trimesh.creation.icosphere(subdivisions=subdivisions)
    rod.apply_scale([20, 260, 20])
    rod.apply_translation([-40, -220, 0])
    rod.export(folder / "hamstring_right.ply")
    match = match_meshes(found, folder)[0]
    attach(found, match)
    assert len(match.ends) == 2
    for _, vertices in match.ends:
        assert 0.02 < len(set(vertices)) / len(rod.vertices) < 0.04


@pytest.mark.parametrize("far", ["r", "l"])
def test_of_paths_of_both_sides_those_beside_the_mesh_hold_it(own, far):
    """A mesh without a side in its name lies beside one of two legs: in this model the other is 300 mm off."""
    found, folder = own
    (path,) = found.model.paths
    path.points[0].body = "thigh"
    found.model.paths[:] = [copy.deepcopy(path) for _ in range(4)]
    for each, name in zip(
        found.model.paths, ("hamstring1_r", "hamstring2_r", "hamstring1_l", "hamstring2_l")
    ):
        each.name = name
        for point in each.points:
            aside = (0.3 if name.endswith(far) else 0.0) + (0.01 if "2" in name else 0.0)
            point.place = point.place + np.array([0.0, 0.0, aside])
    (folder / "hamstring_right.ply").rename(folder / "hamstring.ply")
    match = match_meshes(found, folder)[0]
    assert len(match.paths) == 4
    attach(found, match)
    near = "l" if far == "r" else "r"
    assert [p.name for p in match.paths] == [f"hamstring1_{near}", f"hamstring2_{near}"]
    assert match.distance < 100.0


def test_end_on_a_bone_without_a_mesh_is_said(own):
    found, folder = own
    match = match_meshes(found, folder)[0]
    attach(found, match)
    assert match.note == "ground has no mesh to hold it" and len(match.ends) == 1


def test_model_comes_to_own_bones_with_its_joints(osim_data, tmp_path):
    """Bones of the model itself, moved in their joints, scaled and turned: the joints are found back there."""
    path = osim_data / "gait2392" / "gait2392_thelen2003muscle.osim"
    found = import_osim(path, units="mm", bodies=["tibia_r"])
    asked = {"hip_r.hip_flexion_r": 20.0, "hip_r.hip_adduction_r": -5.0, "knee_r.knee_angle_r": -30.0}
    poses = bone_poses(found.scene, {name: np.radians(value) for name, value in asked.items()})
    turn = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix()

    def scanned(points, bone):
        return 1.1 * (points @ poses[bone][:3, :3].T + poses[bone][:3, 3]) @ turn.T + [100, 200, -50]

    for bone, file in (("pelvis", "pelvis"), ("femur_r", "femur_right"), ("tibia_r", "tibia_r")):
        mesh = found.scene.bone(bone).mesh
        trimesh.Trimesh(scanned(np.asarray(mesh.vertices), bone), mesh.faces, process=False).export(
            tmp_path / f"{file}.ply"
        )
    centre = scanned(found.scene.joints[1].centre, "pelvis")
    rows = bring_to_bones(found, tmp_path)
    hip = found.scene.joints[1]
    assert hip.name == "hip_r" and hip.centre == pytest.approx(centre, abs=1e-3)
    facts = all_coordinates(found.scene.joints)
    for name, value in asked.items():
        assert np.degrees(facts[name].rest) == pytest.approx(value, abs=1e-4)
    assert all(row["scale"] == pytest.approx(1.1, rel=1e-6) and row["rms_mm"] < 1e-3 for row in rows)
    # From the scan back to the model's own pose: everything is where the model, scaled and turned, has it.
    back = bone_poses(found.scene, dict.fromkeys(asked, 0.0))
    fresh = import_osim(path, units="mm", bodies=["tibia_r"]).scene
    for bone in ("femur_r", "tibia_r"):
        points = np.asarray(found.scene.bone(bone).mesh.vertices)[:5]
        moved = points @ back[bone][:3, :3].T + back[bone][:3, 3]
        wanted = 1.1 * np.asarray(fresh.bone(bone).mesh.vertices)[:5] @ turn.T + [100, 200, -50]
        shift = poses["pelvis"][:3, 3]
        assert np.abs(moved - wanted - 1.1 * turn @ shift).max() < 0.01  # float32 in the files


def test_folder_without_bones_of_the_model_is_refused(osim_data, tmp_path):
    found = import_osim(osim_data / "leg6dof9musc" / "leg6dof9musc.osim")
    with pytest.raises(UsageError, match="no meshes there"):
        bring_to_bones(found, tmp_path)
    trimesh.creation.box().export(tmp_path / "skull.ply")
    with pytest.raises(UsageError, match="no mesh has the name of a body"):
        bring_to_bones(found, tmp_path)


@pytest.mark.parametrize("angles", [(0, 0, 0), (170, 20, 0), (10, 100, -90), (0, 0, 180)])
def test_a_bone_is_registered_however_it_lies_in_the_scan(angles):
    model = trimesh.creation.icosphere(subdivisions=3)
    place = model.vertices * [10.0, 60.0, 22.0]
    place[:, 0] += 9.0 * np.exp(
        -(((place[:, 1] - 40.0) / 15.0) ** 2)
    )  # a head, so that no half turn is like another
    place[:, 2] += 6.0 * (place[:, 1] < -30.0) * (place[:, 0] > 0.0)
    model = trimesh.Trimesh(place, model.faces, process=False)
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    scan = trimesh.Trimesh(1.3 * place @ turn.T + [100.0, -50.0, 20.0], model.faces, process=False)
    fit = register(model, scan)
    np.testing.assert_allclose(fit.turn, turn, atol=1e-6)
    assert fit.scale == pytest.approx(1.3, rel=1e-6) and fit.rms < 1e-6


def test_joint_below_a_body_that_nobody_scanned_goes_all_the_way_to_the_childs_bone(tmp_path):
    """Above a joint both bones were scanned or none: where the parent has no bone, there is nothing to meet midway."""
    scene = rm.Scene("leg", units="mm").add_link("patella")
    for name, middle in (("thigh", [0.0, 100.0, 0.0]), ("shank", [0.0, -100.0, 0.0])):
        mesh = trimesh.creation.icosphere(subdivisions=2)
        mesh.vertices = mesh.vertices * [10.0, 60.0, 20.0] + [8.0, 0.0, 0.0] * (mesh.vertices > 0.4)
        scene.add_bone(name, trimesh.Trimesh(mesh.vertices + middle, mesh.faces, process=False))
    scene.add_joint("upper", "thigh", "patella", (0, 10, 0), {"flexion": (0, 0, 1)})
    scene.add_joint("lower", "patella", "shank", (0, -10, 0), {"flexion": (0, 0, 1)})
    away = {"thigh": np.zeros(3), "shank": np.array([3.0, 7.0, -5.0])}
    for bone in scene.bones:
        mesh = trimesh.Trimesh(bone.mesh.vertices + away[bone.name], bone.mesh.faces, process=False)
        mesh.export(tmp_path / f"{bone.name}.ply")
    found = SimpleNamespace(scene=scene, names={}, places={}, notes=[])
    rows = bring_to_bones(found, tmp_path)
    upper, lower = found.scene.joints
    np.testing.assert_allclose(upper.centre, [0.0, 10.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(lower.centre, [3.0, -3.0, -5.0], atol=1e-3)
    assert [row["what"] for row in rows] == ["thigh", "shank", "joint upper"]


def test_import_takes_a_model_alone_and_refuses_matches_of_no_muscles(small, tmp_path, capsys):
    assert run_command(["import", str(small), "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "scene.toml").is_file()
    capsys.readouterr()
    assert run_command(["import", str(small), "-o", str(tmp_path / "no"), "--matches", "m.csv"]) == 2
    assert "--matches belongs to --muscles" in capsys.readouterr().err
