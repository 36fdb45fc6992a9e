"""`plan` says what the run then does, and what a scene does not ask for is not done."""

import json
import subprocess
import sys

import pytest
from blend_model import BlendMuscle, arm_scene, use_blend_model

from rbfmuscle.cli import main
from rbfmuscle.run import simulate
from rbfmuscle.simulation import frame_loop as loop
from rbfmuscle.simulation.plan.contact_pairs import find_contact_pairs
from rbfmuscle.simulation.plan.plan import plan_scene


def test_plan_names_pairs_fields_and_substeps(monkeypatch):
    use_blend_model(monkeypatch)
    scene = arm_scene()
    made = plan_scene(scene)
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


def test_bone_out_of_reach_is_in_no_pair():
    import trimesh

    scene = arm_scene()
    far = trimesh.creation.box((5, 5, 5))
    far.apply_translation([0, 500, 0])
    scene.add_bone("far", far)
    made = plan_scene(scene)
    assert "far" not in {field["bone"] for field in made["fields"]} | {*made["muscles"][0]["bones"]}


@pytest.mark.parametrize("arguments", [[], ["--json", "--time"]])
def test_command_prints_the_plan(hip_data, capsys, arguments):
    with pytest.raises(SystemExit) as end:
        main(["plan", str(hip_data / "gluteus.toml"), *arguments])
    assert end.value.code == 0
    text = capsys.readouterr().out
    if arguments:
        made = json.loads(text)
        assert {field["bone"] for field in made["fields"]} == {"pelvis", "sacrum", "femur"}
        assert made["time"]["total"] > made["time"]["build"] > 0 and made["time"]["frame"] > 0
        assert "centres" in made["muscles"][0]["points"]
    else:
        assert "gluteus_maximus: rbf" in text and "field of femur" in text and "expected" not in text


def test_one_muscle_builds_no_sliding(monkeypatch):
    use_blend_model(monkeypatch)
    made = []
    monkeypatch.setattr(
        loop, "_sliding", lambda *args, real=loop._sliding: made.append(real(*args)) or made[-1]
    )
    simulate(arm_scene())
    assert made == [None]


def test_run_without_pictures_loads_no_vtk(tmp_path):
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from blend_model import arm_scene, BlendMuscle\n"
        "import rbfmuscle.models as models, rbfmuscle.run as r\n"
        "models.build_model = BlendMuscle\n"
        "run = r.simulate(arm_scene())\n"
        "assert type(run._recording.share.models[0]) is BlendMuscle\n"
        f"run.save({str(tmp_path)!r}, pictures=False)\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('vtk', 'vtkmodules', 'pyvista', 'matplotlib')])"
    )
    from conftest import ROOT

    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120, check=True
    )
    assert done.stdout.strip() == "[]", done.stderr
