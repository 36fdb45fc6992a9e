"""Muscles as implicit RBF surfaces that move with the bones.

Public names are loaded when first used, so that ``import rbfmuscle`` stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rbfmuscle.bones.sdf import BoneSDF as BoneSDF
    from rbfmuscle.implicit.field import RBFField as RBFField
    from rbfmuscle.implicit.kernels import register_kernel as register_kernel
    from rbfmuscle.models import ModelKind as ModelKind
    from rbfmuscle.models import model_kind as model_kind
    from rbfmuscle.models import register_model as register_model
    from rbfmuscle.muscle.muscle import RBFMuscle as RBFMuscle
    from rbfmuscle.recording import Run as Run
    from rbfmuscle.recording import simulate as simulate
    from rbfmuscle.scene.check import check_scene as check_scene
    from rbfmuscle.scene.phantom import phantom_scene as phantom_scene
    from rbfmuscle.scene.scene import Scene as Scene
    from rbfmuscle.studies.accuracy import discretisation_error as discretisation_error
    from rbfmuscle.studies.compare import compare as compare
    from rbfmuscle.studies.kernels import reach_error as reach_error
    from rbfmuscle.studies.kernels import study_kernels as study_kernels
    from rbfmuscle.studies.sweep import sweep as sweep
    from rbfmuscle.validation import LimitExceededError as LimitExceededError
    from rbfmuscle.validation import MeshError as MeshError
    from rbfmuscle.validation import MissingDependencyError as MissingDependencyError
    from rbfmuscle.validation import NumericalWarning as NumericalWarning
    from rbfmuscle.validation import RBFMuscleError as RBFMuscleError
    from rbfmuscle.validation import SceneError as SceneError
    from rbfmuscle.validation import SceneWarning as SceneWarning
    from rbfmuscle.validation import SolveError as SolveError
    from rbfmuscle.validation import UsageError as UsageError
    from rbfmuscle.viewer.page import show as show

__version__ = "1.1.0"

_ERRORS = (
    "LimitExceededError",
    "MeshError",
    "MissingDependencyError",
    "NumericalWarning",
    "RBFMuscleError",
    "SceneError",
    "SceneWarning",
    "SolveError",
    "UsageError",
)
_HOME = {
    "BoneSDF": "rbfmuscle.bones.sdf",
    "ModelKind": "rbfmuscle.models",
    "RBFField": "rbfmuscle.implicit.field",
    "RBFMuscle": "rbfmuscle.muscle.muscle",
    "Run": "rbfmuscle.recording",
    "Scene": "rbfmuscle.scene.scene",
    "check_scene": "rbfmuscle.scene.check",
    "compare": "rbfmuscle.studies.compare",
    "discretisation_error": "rbfmuscle.studies.accuracy",
    "model_kind": "rbfmuscle.models",
    "phantom_scene": "rbfmuscle.scene.phantom",
    "register_kernel": "rbfmuscle.implicit.kernels",
    "register_model": "rbfmuscle.models",
    "reach_error": "rbfmuscle.studies.kernels",
    "show": "rbfmuscle.viewer.page",
    "simulate": "rbfmuscle.recording",
    "study_kernels": "rbfmuscle.studies.kernels",
    "sweep": "rbfmuscle.studies.sweep",
    **dict.fromkeys(_ERRORS, "rbfmuscle.validation"),
}
__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if name == "compare_models":
        raise AttributeError("rbfmuscle.compare_models is rbfmuscle.compare now")
    if home is None:
        raise AttributeError(f"module 'rbfmuscle' has no attribute {name!r}")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
