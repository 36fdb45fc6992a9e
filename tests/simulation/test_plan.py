"""`plan` says what the run then does, and what a scene does not ask for is not done."""

import json

import pytest
import trimesh
from blend_model import BlendMuscle, arm_scene, use_blend_model

from rbfmuscle.cli import main
from rbfmuscle.run import simulate
from rbfmuscle.simulation.plan.contact_pairs import find_contact_pairs
from rbfmuscle.simulation.plan.plan import plan_scene


def test_plan_names_pairs_fields_and_substeps(monkeypatch):
    use_blend_model(monkeypatch)
    scene = arm_scene()
    far = trimesh.creation.box((5, 5, 5))
    far.apply_translation([0, 500, 0])
    scene.add_bone("far", far)
    made = plan_scene(scene)
    assert "far" not in {field["bone"] for field in made["fields"]} | {*made["muscles"][0]["bones"]}
    assert {(m["name"], bone) for m in made["muscles"] for bone in m["bones"]} == set(
        find_contact_pairs(scene)
    )
    assert all(0 < field["share"] <= 1 for field in made["fields"])
    steps = []
    solve = BlendMuscle.predict
    monkeypatch.setattr(
        BlendMuscle, "predict", lambda self, *poses: (steps.append(1), solve(self, *poses))[1]
    )
    frames = simulate(scene).frames
    assert (made["frames"], made["substeps"]) == (len(frames), len(steps))


def test_command_prints_the_plan(hip_data, capsys):
    with pytest.raises(SystemExit) as end:
        main(["plan", str(hip_data / "gluteus.toml"), "--json", "--time"])
    assert end.value.code == 0
    made = json.loads(capsys.readouterr().out)
    assert {field["bone"] for field in made["fields"]} == {"pelvis", "sacrum", "femur"}
    assert made["time"]["total"] > made["time"]["build"] > 0 and made["time"]["frame"] > 0
    assert "centres" in made["muscles"][0]["points"]
