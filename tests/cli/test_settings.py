"""``--set``: every key that the schemas document, from the command line into the run."""

import json
import re
from typing import get_args

import pytest
from blend_model import arm_files
from command_line import call
from conftest import ROOT
from pydantic import BaseModel

from pbd_baseline.rest import PBDOptions
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.scene import options
from rbfmuscle.scene.file import MuscleTable, SceneFile
from rbfmuscle.scene.options import KEYS
from rbfmuscle.scene.settings import HEADS

# A value for every key, other than its default; model settings of quick muscles.
PAIRS = [["biceps", "brachialis"]]
TABLES = {
    "contact": (options.ContactOptions, {"initial": "error", "substep_angle": 4.0}),
    "neighbours": (
        options.NeighbourOptions,
        {"pairs": PAIRS, "together": True, "bones": [["biceps", "upper"]]},
    ),
    "detect.tunnelling": (
        options.TunnellingOptions,
        {"angle": 120.0, "action": "report"},
    ),
    "output": (
        options.OutputOptions,
        {"surfaces": False, "fibres": 5, "report": False},
    ),
}
MODELS = {
    "rbf": (
        RBFOptions,
        {
            "centres": 60,
            "samples": 300,
            "iterations": 3,
            "nodes": 60,
            "resolution": 16,
            "kernel": "quintic",
            "epsilon": 0.02,
            "slack_ratio": 1.3,
            "surface": "marching",
            "fibre_ratio": 2.0,
            "condition": 1e12,
            "rest_error": 0.4,
        },
    ),
    "pbd": (
        PBDOptions,
        {
            "iterations": 2,
            "fibre_exponent": 1.0,
            "bending": 0.8,
            "edge_compliance": 0.1,
            "bending_compliance": 0.1,
            "slack_ratio": 1.2,
        },
    ),
}
# The name of the model decides it, so it is no key of the scene's.
IMPLIED = {"method", "tolerance"}

OTHERS = [
    ("model", "xpbd", ["xpbd", "xpbd"]),
    ("model", {"name": "pbd", "iterations": 2}, ["pbd", "pbd"]),
    ("muscle.biceps.model", "arap-volume", ["arap-volume", "rbf"]),
    ("muscle.brachialis.model.centres", 80, ["rbf", "rbf"]),
    ("motion.step", 3.0, ["rbf", "rbf"]),
]


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """Two small muscles beside each other over one hinge, as files."""
    model = 'model = { name = "rbf", centres = 60, samples = 200, resolution = 12 }\n'
    muscles = (("biceps", -5.5), ("brachialis", 5.5))
    return arm_files(tmp_path_factory.mktemp("arm"), end=6, step=2, muscles=muscles, defaults=model)


def run(capsys, scene_file, folder, *settings, model=None):
    """Facts in ``run.json`` after two frames; settings are (key, value)."""
    texts = [f"{key}={value if isinstance(value, str) else toml(value)}" for key, value in settings]
    arguments = [part for text in texts for part in ("--set", text)] + (
        ["--model", model] if model else []
    )
    code, _, err = call(capsys, "run", scene_file, "-o", folder, "--frames", "0:2", *arguments)
    assert code == 0, err
    info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert len(info["frames"]) == 2
    return info


def toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


@pytest.mark.parametrize(
    ("table", "values"), [*TABLES.values(), *MODELS.values()], ids=[*TABLES, *MODELS]
)
def test_every_documented_key_has_a_value_here(table, values):
    fields = {name: field for name, field in table.model_fields.items() if name not in IMPLIED}
    assert set(values) == set(fields)
    same = [k for k, v in values.items() if v == fields[k].get_default(call_default_factory=True)]
    assert same == []


def tables_in(annotation):
    """Tables that a value of this type may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from tables_in(part)


def keys_of(table, names):
    """Dotted keys of some fields of a table, those of inner tables in place of the tables."""
    for name in names:
        field = table.model_fields[name]
        inner = list(tables_in(field.annotation))
        for part in inner:
            yield from (f"{name}.{key}" for key in keys_of(part, part.model_fields))
        if not inner:
            yield field.alias or name


def test_few_settings_are_to_be_known_and_the_glossary_counts_them():
    tables = {head for head in HEADS if head in SceneFile.model_fields} - {"muscle"}
    assert set(HEADS) == {"model", "muscle", *KEYS, *tables}
    found = [*keys_of(SceneFile, tables), *keys_of(MuscleTable, KEYS)]
    found += [f"model.{name}.{key}" for name, (_, values) in MODELS.items() for key in values]
    assert len(set(found)) == len(found) <= 75
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    assert re.search(r"^\| setting \|.*; (\d+) in all", text, flags=re.M)[1] == str(len(found))


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
def test_keys_of_a_table_reach_the_run(scene_file, tmp_path, capsys, table):
    settings = [(f"{table}.{key}", value) for key, value in TABLES[table][1].items()]
    found = run(capsys, scene_file, tmp_path, *settings, model="pbd")["scene"]
    for part in table.split("."):
        found = found[part]
    assert {key: found[key] for key in TABLES[table][1]} == TABLES[table][1]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.NumericalWarning")
def test_keys_of_a_model_reach_the_run(scene_file, tmp_path, capsys, name):
    settings = [(f"model.{key}", value) for key, value in MODELS[name][1].items()]
    info = run(capsys, scene_file, tmp_path, *settings, model=name)
    for muscle in info["scene"]["muscles"]:
        assert muscle["model"] == {"name": name, **MODELS[name][1]}


@pytest.mark.parametrize(("key", "value", "models"), OTHERS, ids=[str(case[:2]) for case in OTHERS])
def test_models_and_motion_are_set(scene_file, tmp_path, capsys, key, value, models):
    info = run(capsys, scene_file, tmp_path, (key, value))
    assert [muscle["model"]["name"] for muscle in info["scene"]["muscles"]] == models
    if key.endswith("centres"):
        assert [m["model"]["centres"] for m in info["scene"]["muscles"]] == [60, 80]
    if key.startswith("motion"):
        motion = info["scene"]["motion"]
        assert {**motion, **motion["ramp"]["elbow.flexion"]}[key.rsplit(".", 1)[-1]] == value


def test_a_whole_model_comes_before_its_settings_whatever_the_order(scene_file, tmp_path, capsys):
    info = run(capsys, scene_file, tmp_path, ("model.iterations", 2), ("model", "xpbd"))
    assert info["scene"]["muscles"][0]["model"] == {"name": "xpbd", "iterations": 2}


@pytest.mark.filterwarnings("ignore::rbfmuscle.validation.SceneWarning")
def test_compare_takes_a_whole_model_as_the_file_would_give_it(scene_file, tmp_path, capsys):
    code, _, err = call(
        capsys,
        "compare",
        scene_file,
        "-o",
        tmp_path,
        "--models",
        "pbd,xpbd",
        "--no-pictures",
        "--frames",
        "0:2",
        "--set",
        'model={name = "xpbd", iterations = 4}',
        "--set",
        "pbd:model.bending=0.8",
    )
    assert code == 0, err
    for name, wanted in (("pbd", {"bending": 0.8}), ("xpbd", {"iterations": 4})):
        info = json.loads((tmp_path / name / "run.json").read_text(encoding="utf-8"))
        assert info["scene"]["muscles"][0]["model"] == {"name": name, **wanted}


def test_the_name_of_a_model_decides_its_method(scene_file, tmp_path, capsys):
    words = ("--model", "pbd", "--set", "model.method=xpbd")
    code, _, err = call(capsys, "run", scene_file, "-o", tmp_path, *words)
    assert code == 2 and "unknown key 'method'" in err
