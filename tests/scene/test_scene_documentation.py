"""docs/scene_file.md names every key and choice of every table."""

import re
import tomllib
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest

from rbfmuscle.scene import attachments, options
from rbfmuscle.scene import file as scene_file
from rbfmuscle.scene.activation import keys
from rbfmuscle.scene.joints import tables as joint_tables

TEXT = (Path(__file__).parents[2] / "docs" / "scene_file.md").read_text(encoding="utf-8")
SECTIONS = dict(part.split("\n", 1) for part in TEXT.split("\n## ")[1:])
CONTRACTION = "docs/contraction.md"
SECTIONS[CONTRACTION] = (Path(__file__).parents[2] / CONTRACTION).read_text(encoding="utf-8")


def documented_tables():
    """Each table of settings with the heading of docs/scene_file.md that describes it."""
    return {
        scene_file.SceneTable: "`[scene]`",
        scene_file.BoneTable: "`[[bone]]`",
        joint_tables.JointTable: "`[[joint]]`",
        joint_tables.CoordinateTable: "`[[joint]]`",
        joint_tables.AxisTable: "`[[joint]]`",
        joint_tables.FunctionTable: "`[[joint]]`",
        joint_tables.PointsTable: "`[[joint]]`",
        joint_tables.CouplingTable: "`[[coupling]]`",
        options.MotionOptions: "`[motion]`",
        options.RampOptions: "`[motion]`",
        scene_file.MuscleTable: "`[[muscle]]`, `[defaults]`",
        scene_file.DefaultsTable: "`[[muscle]]`, `[defaults]`",
        attachments.AttachTable: "`[[muscle]]`, `[defaults]`",
        attachments.SphereTable: "`[[muscle]]`, `[defaults]`",
        options.ContactOptions: "`[contact]`",
        options.SlidingOptions: "`[sliding]`",
        options.DetectOptions: "`[detect]`",
        options.TunnellingOptions: "`[detect]`",
        options.OutputOptions: "`[output]`",
        options.SurfaceOptions: "`[output]`",
        keys.ContractionTable: CONTRACTION,
        keys.CurveTable: CONTRACTION,
        keys.TendonTable: CONTRACTION,
    }


def test_every_table_of_the_schema_is_covered():
    known, waiting = set(), [options.Table]
    while waiting:
        waiting.extend(found := waiting.pop().__subclasses__())
        known.update(table for table in found if table.__module__.startswith("rbfmuscle.scene."))
    assert known - {scene_file.SceneFile} == set(documented_tables())
    headings = " ".join(SECTIONS)
    for key in scene_file.SceneFile.model_fields:
        assert f"[{key}]" in headings


@pytest.mark.parametrize("table", documented_tables(), ids=lambda table: table.__name__)
def test_every_key_and_choice_is_in_its_section(table):
    section = SECTIONS[documented_tables()[table]]
    for name, field in table.model_fields.items():
        key = field.alias or name
        assert any(mark in section for mark in (f"`{key}`", f"{key} = ")), key
        for choice in get_args(field.annotation) if get_origin(field.annotation) is Literal else ():
            assert any(mark in section for mark in (f"`{choice}`", f'"{choice}"', f"| {choice},")), (
                key,
                choice,
            )


def test_example_is_a_valid_scene_file():
    example = re.search(r"```toml\n(.*?)```", TEXT, re.DOTALL).group(1)
    scene_file.SceneFile.build(tomllib.loads(example), place="docs")
