"""Muscles as implicit RBF surfaces that move with the bones.

Public names are loaded when first used, so that ``import rbfmuscle`` stays light.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "BoneSDF": "rbfmuscle.bones.sdf",
    "LimitExceededError": "rbfmuscle.validation",
    "MeshError": "rbfmuscle.validation",
    "MissingPartError": "rbfmuscle.validation",
    "NumericalWarning": "rbfmuscle.validation",
    "RBFField": "rbfmuscle.implicit.field",
    "RBFMuscle": "rbfmuscle.muscle.muscle",
    "RBFMuscleError": "rbfmuscle.validation",
    "Run": "rbfmuscle.run",
    "Scene": "rbfmuscle.scene.scene",
    "SceneError": "rbfmuscle.validation",
    "SolveError": "rbfmuscle.validation",
    "compare_models": "rbfmuscle.compare",
    "phantom_scene": "rbfmuscle.scene.phantom",
    "reach_error": "rbfmuscle.experiments.wanted_error",
    "show": "rbfmuscle.viewer.page",
    "simulate": "rbfmuscle.run",
    "study_kernels": "rbfmuscle.experiments.kernel_study",
}

__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Callable[..., Any]:
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'rbfmuscle' has no attribute {name!r}")


def __dir__() -> Any:
    return sorted(__all__)
