"""The two models mirror each other: the same files, and in them the same names with the same signatures."""

import dataclasses
import importlib
import inspect
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"rbfmuscle.muscle": ROOT / "rbfmuscle" / "muscle", "pbd_baseline": ROOT / "pbd_baseline"}
# What a reader who knows one model finds in the other. A class is named after its model where both are imported.
SHARED = {
    "muscle": {"RBFMuscle": "PBDMuscle"},
    "options": {"RBFOptions": "PBDOptions"},
    "rest": {"RestState": "RestState", "solved_points": "solved_points"},
    "fibres": {"fibre_directions": "fibre_directions"},
}


def files(folder):
    return {path.stem for path in folder.glob("*.py")} - {"__init__"}


def public(module):
    """Classes and functions that a module defines itself."""
    return {
        name: item
        for name, item in vars(module).items()
        if not name.startswith("_") and getattr(item, "__module__", "") == module.__name__ and callable(item)
    }


def positional(function):
    """Names of the positional parameters; what is keyword-only is a model's own affair."""
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [p.name for p in inspect.signature(function).parameters.values() if p.kind in kinds]


def methods(cls):
    return {
        name: item
        for name, item in inspect.getmembers(cls, callable)
        # A dataclass is made by its own functions; its fields are compared by themselves.
        if (name == "__init__" and not dataclasses.is_dataclass(cls))
        or (not name.startswith("_") and name in _own_names(cls))
    }


def _own_names(cls):
    return {
        name for base in cls.__mro__ if base.__module__.startswith(tuple(PACKAGES)) for name in vars(base)
    }


def differences(one, other):
    """Where two classes or functions that stand for each other disagree."""
    if not inspect.isclass(one):
        return [] if positional(one) == positional(other) else [(positional(one), positional(other))]
    first, second = methods(one), methods(other)
    return [
        (name, positional(first[name]), positional(second[name]))
        for name in sorted(first.keys() & second.keys())
        if positional(first[name]) != positional(second[name])
    ]


def test_every_file_that_both_have_is_compared():
    assert files(PACKAGES["rbfmuscle.muscle"]) & files(PACKAGES["pbd_baseline"]) == set(SHARED)


@pytest.mark.parametrize("file", SHARED)
def test_every_name_that_both_have_is_compared(file):
    one, other = (public(importlib.import_module(f"{package}.{file}")) for package in PACKAGES)
    assert one.keys() & other.keys() == {name for name, twin in SHARED[file].items() if name == twin}


@pytest.mark.parametrize(
    ("file", "name", "twin"), [(file, *pair) for file, pairs in SHARED.items() for pair in pairs.items()]
)
def test_the_same_names_have_the_same_signatures(file, name, twin):
    one = getattr(importlib.import_module(f"rbfmuscle.muscle.{file}"), name)
    other = getattr(importlib.import_module(f"pbd_baseline.{file}"), twin)
    assert differences(one, other) == []


def test_what_is_known_at_rest_has_the_same_names_and_types():
    fields = [
        {f.name: f.type for f in dataclasses.fields(importlib.import_module(f"{package}.rest").RestState)}
        for package in PACKAGES
    ]
    shared = fields[0].keys() & fields[1].keys()
    assert shared >= {"bones", "attached_bone"}
    assert [name for name in shared if fields[0][name] != fields[1][name]] == []


def test_both_muscles_are_the_model_that_the_loop_asks_for():
    from pbd_baseline.muscle import PBDMuscle
    from rbfmuscle.muscle.muscle import RBFMuscle
    from rbfmuscle.simulation.frame import MuscleModel

    asked = methods(MuscleModel)
    asked.pop("__init__")
    for muscle in (RBFMuscle, PBDMuscle):
        found = methods(muscle)
        assert asked.keys() <= found.keys()
        assert [n for n in asked if positional(asked[n]) != positional(found[n])] == []
    assert positional(RBFMuscle.__init__) == ["self", "muscle", "scene", "options"]


def test_a_planted_difference_is_found():
    bases = {"__module__": "pbd_baseline.planted"}
    one = type(
        "One", (), {**bases, "__init__": lambda self, points: None, "solve": lambda self, contacts: None}
    )
    other = type(
        "Other", (), {**bases, "__init__": lambda self, points, *, reach: None, "solve": lambda self, p: 0}
    )
    assert differences(one, other) == [("solve", ["self", "contacts"], ["self", "p"])]


def test_every_way_of_the_mesh_models_is_one_row():
    from typing import get_args

    from pbd_baseline.options import PBDOptions
    from pbd_baseline.shapes import METHODS

    assert set(METHODS) == set(get_args(PBDOptions.model_fields["method"].annotation))
