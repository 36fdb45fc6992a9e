"""Models as OpenSim reads them: reference transforms of every model given, and a small one with
known answers.
"""

import json

import numpy as np
import pytest

import rbfmuscle as rm
from rbfmuscle.importers.opensim.elements import frame_at
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.scene import import_osim, write_imported
from rbfmuscle.scene.joints import all_coordinates, rotation_about
from rbfmuscle.scene.motion import bone_poses

MODELS = (
    "arm26",
    "arm26_v20303",
    "bouncing_block",
    "gait10dof18musc",
    "gait10dof18musc_v30000",
    "Tug_of_War",
    "gait2392_thelen2003muscle",
    "leg6dof9musc",
    "subject01",
    "subject01_simbody_adjusted",
    "synthetic",
)
KINDS = {"rotational": "rotation", "translational": "translation", "coupled": "coupled"}


def reference(data, name):
    found = json.loads((data / "reference" / f"{name}.json").read_text(encoding="utf-8"))
    return next(data.rglob(f"{name}.osim")), found


def poses_of(found):
    """Every recorded pose: coordinates by name and body transforms."""
    names = [row["name"] for row in found["coordinates"]]
    sets = [(found["default"][key], *found["poses"][key]) for key in ("q", "transforms")]
    for values, transforms in zip(*sets, strict=True):
        matrices = [np.array(row).reshape(3, 4) for row in transforms]
        yield dict(zip(names, values)), dict(zip(found["bodies"], matrices))


@pytest.mark.parametrize("name", MODELS)
def test_body_transforms_are_opensims(osim_data, name):
    path, found = reference(osim_data, name)
    model = read_osim(path)
    kinds = {
        name.split(".")[1]: facts.motion for name, facts in all_coordinates(model.joints).items()
    }
    assert kinds == {row["name"]: KINDS[row["motion"]] for row in found["coordinates"]}
    for values, bodies in poses_of(found):
        got = model.transforms(values)
        for body, wanted in bodies.items():
            assert np.abs(got[body][:3, 3] - wanted[:, 3]).max() <= 1e-8
            assert np.abs(got[body][:3, :3] - wanted[:, :3]).max() <= 1e-7
        # Assembly meets couplers to 1e-10.
        resolved = model.resolved(values)
        assert all(abs(v - values[name.split(".")[1]]) < 2e-10 for name, v in resolved.items())


@pytest.mark.parametrize("name", ["leg6dof9musc", "synthetic", "gait10dof18musc"])
def test_poses_of_the_written_scene_are_opensims(osim_data, tmp_path, name):
    path, found = reference(osim_data, name)
    imported = import_osim(path)
    scene = rm.Scene.load(write_imported(imported, tmp_path), skeleton=True)
    full = {coordinate.split(".")[1]: coordinate for coordinate in all_coordinates(scene.joints)}
    for values, bodies in list(poses_of(found))[:20]:
        poses = bone_poses(scene, {full[name]: value for name, value in values.items()})
        for body in poses.keys() & bodies.keys():
            got, wanted = poses[body] @ imported.places[body], bodies[body]
            assert np.abs(got[:3, 3] - wanted[:, 3]).max() <= 1e-8
            assert np.abs(got[:3, :3] - wanted[:, :3]).max() <= 1e-7


@pytest.mark.parametrize("name", MODELS)
def test_placed_meshes_are_where_opensim_has_them(osim_data, name):
    path, found = reference(osim_data, name)
    model = read_osim(path)
    wanted = {}
    for row in found.get("meshes", []):
        key = (row["file"].lower(), row["body"].lower())
        wanted.setdefault(key, []).append((row["scale"], np.array(row["transform"]).reshape(3, 4)))
    for mesh in model.meshes:
        entries = wanted[mesh.file.lower(), mesh.body.lower()]
        places = [place for scale, place in entries if np.allclose(mesh.scale, scale, atol=1e-9)]
        assert any(np.allclose(mesh.transform[:3], place, atol=1e-9) for place in places)


class TestSmall:
    def test_known_pose(self, small):
        model = read_osim(small)
        got = model.transforms({"hip_angle": 0.3, "knee_angle": -1.0, "slide": 5.0})
        thigh = rotation_about((0, 0, 1), 0.3, np.zeros(3))
        assert got["thigh"] == pytest.approx(thigh, abs=1e-15)
        knee = frame_at((0.03, -0.424, 0)) @ rotation_about((0, 0, 1), -1.0, np.zeros(3))
        assert got["shank"] == pytest.approx(thigh @ knee, abs=1e-15)
        assert got["cap"] == pytest.approx(thigh @ frame_at((-0.16, 0, 0)), abs=1e-15)

    def test_joint_that_closes_a_loop_is_left_out_and_named(self, small):
        joint = """<PinJoint name="strut"><socket_parent_frame>/ground</socket_parent_frame>
            <socket_child_frame>shank</socket_child_frame>
            <coordinates>
            <Coordinate name="strut_angle"><range>-1 1</range></Coordinate>
            </coordinates>
            </PinJoint>"""
        assert not any("closes a loop" in doubt for doubt in read_osim(small).doubts)
        small.write_text(
            small.read_text(encoding="utf-8").replace("<SliderJoint", joint + "<SliderJoint")
        )
        (doubt,) = [doubt for doubt in read_osim(small).doubts if "closes a loop" in doubt]
        assert "strut (ground to shank) closes a loop with hip, knee" in doubt


def test_ground_may_be_the_child(small):
    text = small.read_text(encoding="utf-8").replace(
        "<socket_parent_frame>/ground</socket_parent_frame><socket_child_frame>thigh</socket_child_frame>",
        "<socket_parent_frame>/bodyset/thigh</socket_parent_frame><socket_child_frame>/ground</socket_child_frame>",
    )
    forth = read_osim(small).transforms({"hip_angle": -0.3})
    small.write_text(text)
    back = read_osim(small)
    assert back.transforms({"hip_angle": 0.3})["shank"] == pytest.approx(forth["shank"], abs=1e-15)
    imported = import_osim(small)
    pose = bone_poses(imported.scene, {"hip.hip_angle": 0.3})["shank"] @ imported.places["shank"]
    assert pose == pytest.approx(forth["shank"], abs=1e-14)


def test_a_body_keeps_the_meshes_that_can_be_read_beside_one_that_cannot(small):
    both = '<Mesh name="bad"><mesh_file>bad.obj</mesh_file></Mesh><Mesh name="n">'
    small.write_text(small.read_text(encoding="utf-8").replace('<Mesh name="n">', both))
    torn = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 99\n"
    (small.parent / "bad.obj").write_text(torn)
    found = import_osim(small)
    assert [bone.name for bone in found.scene.bones] == ["thigh", "shank"]
    assert sum("body 'thigh': mesh 'bad.obj' is not taken" in note for note in found.notes) == 1
    (small.parent / "wedge.obj").write_text(torn)
    scene = import_osim(small).scene
    assert not scene.bones and "thigh" in scene.missing_bones


def test_meshes_of_a_body_are_kept_beside_one_that_has_one_side_only(osim_data):
    """The spine of the torso cannot be oriented; ribs, skull and jaw can."""
    path = osim_data / "gait2392" / "gait2392_thelen2003muscle.osim"
    found = import_osim(path, muscles=False)
    assert {"hat_ribs.vtp", "hat_skull.vtp", "hat_jaw.vtp"} == set(
        found.scene.bone("torso").source.split(", ")
    )
    assert "torso" not in found.scene.missing_bones
    (line,) = (note for note in found.notes if "hat_spine" in note)
    assert line.startswith("body 'torso': mesh 'hat_spine.vtp' is not taken: ")
