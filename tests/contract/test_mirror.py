"""The two models mirror each other: both are what the frame loop asks for, and twins have the same signatures."""

import inspect
from typing import get_args

import pytest

from pbd_baseline import fibres as mesh_fibres
from pbd_baseline import rest as mesh_rest
from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.options import PBDOptions
from pbd_baseline.shapes import METHODS
from rbfmuscle.muscle import fibres, rest
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.simulation.frame import MuscleModel

TWINS = {
    "the models": (RBFMuscle, PBDMuscle),
    "the fibres": (fibres.fibre_directions, mesh_fibres.fibre_directions),
    "the points": (rest.solved_points, mesh_rest.solved_points),
}


def signatures(thing):
    """Positional parameters of a function, or of each method of a class; keyword-only ones are a model's own affair."""
    if inspect.isfunction(thing):
        kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        return {"": [p.name for p in inspect.signature(thing).parameters.values() if p.kind in kinds]}
    methods = inspect.getmembers(thing, inspect.isfunction)
    return {n: signatures(m)[""] for n, m in methods if n == "__init__" or not n.startswith("_")}


def differences(one, other):
    first, second = signatures(one), signatures(other)
    return [name for name in first.keys() & second.keys() if first[name] != second[name]]


@pytest.mark.parametrize("twins", TWINS.values(), ids=TWINS)
def test_the_same_names_have_the_same_signatures(twins):
    assert differences(*twins) == []


def test_both_muscles_are_the_model_that_the_loop_asks_for():
    asked = signatures(MuscleModel)
    asked.pop("__init__", None)
    for muscle in (RBFMuscle, PBDMuscle):
        found = signatures(muscle)
        assert asked == {name: found.get(name) for name in asked}
    assert signatures(RBFMuscle)["__init__"] == ["self", "muscle", "scene", "options"]


def test_a_planted_difference_is_found():
    one = type("One", (), {"__init__": lambda self, points: None, "solve": lambda self, contacts: None})
    other = type("Other", (), {"__init__": lambda self, points, *, reach: None, "solve": lambda self, p: 0})
    assert differences(one, other) == ["solve"]


def test_every_way_of_the_mesh_models_is_one_row():
    assert set(METHODS) == set(get_args(PBDOptions.model_fields["method"].annotation))
