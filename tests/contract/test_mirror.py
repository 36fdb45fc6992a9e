"""Both models are what the frame loop asks for, with the same signatures."""

import inspect
from typing import get_args

from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.options import PBDOptions
from pbd_baseline.shapes import METHODS
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.simulation.frame import MuscleModel


def signatures(model):
    """Positional parameters of each method; keyword-only ones are a model's own affair."""
    methods = inspect.getmembers(model, inspect.isfunction)
    return {n: inspect.getfullargspec(m).args for n, m in methods if n == "__init__" or not n.startswith("_")}


def test_both_muscles_are_the_model_that_the_loop_asks_for():
    asked = signatures(MuscleModel)
    asked.pop("__init__", None)
    for muscle in (RBFMuscle, PBDMuscle):
        found = signatures(muscle)
        assert asked == {name: found.get(name) for name in asked}
    assert signatures(RBFMuscle)["__init__"] == ["self", "muscle", "scene", "options"]
    assert set(METHODS) == set(get_args(PBDOptions.model_fields["method"].annotation))
