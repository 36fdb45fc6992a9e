"""`plan` says what the run then does, and what a scene does not ask for is not done."""

import json

import pytest

from rbfmuscle.cli import main


def test_command_prints_the_plan(capsys):
    with pytest.raises(SystemExit) as end:
        main(["plan", "phantom", "--json", "--time"])
    assert end.value.code == 0
    made = json.loads(capsys.readouterr().out)
    assert {field["bone"] for field in made["fields"]} == {"pelvis", "femur"}
    assert made["time"]["total"] > made["time"]["build"] > 0 and made["time"]["frame"] > 0
    assert "centres" in made["muscles"][0]["points"]
