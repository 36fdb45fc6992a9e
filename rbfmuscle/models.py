"""Model names and their classes, loaded on demand; the only module that knows both models."""

import importlib
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import Table
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import HEADS
from rbfmuscle.simulation.frame import MuscleModel
from rbfmuscle.validation import SceneError, UsageError, did_you_mean, shown


class _Home(NamedTuple):
    """A model's package, the names in it, and the options that its name implies."""

    package: str
    muscle: str
    options: str
    implied: dict


_PBD = "pbd_baseline", "PBDMuscle", "PBDOptions"
# Sweeps of the converged mesh models go on until none moves a vertex by more than this share of the
# muscle's size.
CONVERGED, _SUFFIX = 5e-6, "-converged"
_METHODS = ("pbd", "pbd-paper", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved")
_HOME = {"rbf": _Home("rbfmuscle.muscle", "RBFMuscle", "RBFOptions", {})}
_HOME |= {name: _Home(*_PBD, {"method": name, "tolerance": 0.0}) for name in _METHODS}
for _name in ("pbd", "xpbd", "arap-pbd", "arap-volume"):
    _HOME[f"{_name}{_SUFFIX}"] = _Home(*_PBD, {"method": _name, "tolerance": CONVERGED})

MODEL_NAMES = tuple(_HOME)
# The default of `compare`: all but the historical model, and PBD converged.
COMPARED = ("rbf", "pbd", "pbd-converged", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved")
# What models are called where it is not their name.
_TITLES = {"rbf": "RBF", "pbd": "PBD", "pbd-paper": "PBD of the paper", "xpbd": "XPBD"}
_SWEEPS = {"pbd": 3}  # where the settings name none


def model_title(muscle: Muscle) -> str:
    """What the model of a muscle is called in tables and pictures, with its sweeps where they are
    known.
    """
    base = muscle.model.removesuffix(_SUFFIX)
    title, sweeps = (
        _TITLES.get(base, base),
        muscle.options.get("iterations", 0) or _SWEEPS.get(base, 0),
    )
    if base != muscle.model:
        return f"{title}, converged"
    return f"{title}, {sweeps} sweeps" if sweeps and base != "rbf" else title


def build_model(muscle: Muscle, scene: Scene, name: str | None = None) -> MuscleModel:
    """Return the model of one muscle of a scene, of a name in ``MODEL_NAMES``, the scene's own
    choice where not given.

    The options of the scene's model table are for the class of models that it names, and are left
    out for another. UsageError on an unknown name, with the nearest right one; SceneError if a
    setting is unknown or impossible.
    """
    name = muscle.model if name is None else name
    home = _HOME[check_model_name(name)]
    same_class = _HOME[check_model_name(muscle.model)].muscle == home.muscle
    options = _read_options(muscle, home, muscle.options if same_class else {})
    return _part(home, "muscle", home.muscle)(muscle, scene, options)


def solved_points(muscle: Muscle, scene: Scene) -> str:
    """The points that the model of a muscle solves for, in words; nothing is built."""
    home = _HOME[check_model_name(muscle.model)]
    options = _read_options(muscle, home, muscle.options)
    return _part(home, "rest", "solved_points")(muscle, scene, options)


def kernel_names(scene: Scene) -> dict[str, str]:
    """Kernel of each muscle whose model has one, by the muscle's name; nothing is built."""
    homes = {muscle.name: _HOME[check_model_name(muscle.model)] for muscle in scene.muscles}
    options = {m.name: _read_options(m, homes[m.name], m.options) for m in scene.muscles}
    return {name: found.kernel for name, found in options.items() if hasattr(found, "kernel")}


def build_models(scene: Scene, names: Collection[str] | None = None) -> list[MuscleModel]:
    """Return the models of a scene's muscles, all or those named, in the scene's order, built side
    by side.
    """
    from threadpoolctl import threadpool_limits

    muscles = [muscle for muscle in scene.muscles if names is None or muscle.name in names]
    with threadpool_limits(limits=1, user_api="blas"):
        return each(lambda muscle: build_model(muscle, scene), muscles)


def configure_scene(
    scene: Scene,
    settings: Mapping[str, Any] | None = None,
    *,
    model: str | dict | None = None,
    frames: slice | str | None = None,
) -> Scene:
    """Return a scene with other settings, checked to the last key of every muscle's model; nothing
    is built.

    Arguments are those of `Scene.with_options`. SceneError if the scene itself names an unknown
    model, or an unknown or impossible setting of one; UsageError if the settings do.
    """
    check_models(scene)
    for key in settings or ():
        schemas = (_part(home, "options", home.options) for home in _HOME.values())
        if key.partition(".")[0] not in HEADS and any(
            key in schema.model_fields for schema in schemas
        ):
            raise UsageError(f"{key}: unknown setting, did you mean 'model.{key}'?")
    changed = scene.with_options(settings, model=model, frames=frames)
    for muscle in changed.muscles:
        try:
            _check_muscle(muscle)
        except SceneError as error:
            raise UsageError(str(error)) from None
    return changed


def check_models(scene: Scene) -> None:
    """Check the model and the settings of every muscle of a scene, building nothing.

    SceneError names the file, the muscle and the nearest right name.
    """
    root = f"{scene.path}: " if scene.path else ""
    for muscle in scene.muscles:
        try:
            _check_muscle(muscle)
        except UsageError as error:
            raise SceneError(f"{root}muscle {muscle.name!r}: {error}") from None
        except SceneError as error:
            raise SceneError(f"{root}{error}") from None


def check_model_name(name: str) -> str:
    """Return a model's name, or raise UsageError with the nearest right one."""
    if name in _HOME:
        return name
    hint = did_you_mean(str(name).lower()[:100].replace("_", "-"), MODEL_NAMES)
    raise UsageError(f"unknown model {shown(repr(name))}, {hint}")


def _check_muscle(muscle):
    _read_options(muscle, _HOME[check_model_name(muscle.model)], muscle.options)


def _read_options(muscle: Muscle, home: _Home, table: Mapping[str, Any]) -> Table:
    """The checked settings of a muscle's model."""
    for key in home.implied:
        if key in table:
            words = f"{key} follows from the model's name; known: {', '.join(MODEL_NAMES)}"
            raise SceneError(f"muscle {muscle.name!r}: model: {words}")
    schema = _part(home, "options", home.options)
    return schema.build({**table, **home.implied}, place=f"muscle {muscle.name!r}: model: ")


def _part(home, file, name):
    return getattr(importlib.import_module(f"{home.package}.{file}"), name)
