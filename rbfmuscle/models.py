"""Model name -> model, loaded on demand: the only file that names both models."""

import difflib
import importlib
from concurrent.futures import ThreadPoolExecutor

from rbfmuscle.validation import SceneError, UsageError

# Name: module, class, options that the name itself stands for.
_HOME = {
    "rbf": ("rbfmuscle.model.muscle", "RBFMuscle", {}),
    "pbd": ("pbd_baseline.muscle", "PBDMuscle", {"method": "pbd"}),
    "xpbd": ("pbd_baseline.muscle", "PBDMuscle", {"method": "xpbd"}),
    "arap-pbd": ("pbd_baseline.muscle", "PBDMuscle", {"method": "arap-pbd"}),
    "arap-volume": ("pbd_baseline.muscle", "PBDMuscle", {"method": "arap-volume"}),
    "arap-interleaved": ("pbd_baseline.muscle", "PBDMuscle", {"method": "arap-interleaved"}),
}

MODEL_NAMES = tuple(_HOME)

# What says beforehand how much a model takes, by the module that holds the model.
_COST = {"rbfmuscle.model.muscle": "rbfmuscle.model.cost", "pbd_baseline.muscle": "pbd_baseline.cost"}


def build_model(muscle, scene, name=None):
    """Return the model of one muscle of a scene.

    Parameters
    ----------
    muscle : Muscle
    scene : Scene
    name : str, optional
        One of ``MODEL_NAMES``; the scene's own choice where not given. The options of the scene's model
        table are for the class of models that it names, and are left out for another.

    Raises
    ------
    UsageError
        On an unknown name, with the nearest right one.
    """
    name = muscle.model if name is None else name
    module, class_name, implied = _HOME[check_model_name(name)]
    same_class = _HOME[check_model_name(muscle.model)][1] == class_name
    options = {**(muscle.options if same_class else {}), **implied}
    return getattr(importlib.import_module(module), class_name)(muscle, scene, **options)


def estimate_model(muscle, scene, rates):
    """What the model of one muscle will take, without building it.

    Parameters
    ----------
    muscle : Muscle
    scene : Scene
    rates : dict of str to float
        From `rbfmuscle.sim.plan.rates.measure_rates`.

    Returns
    -------
    MuscleCost
    """
    module, _, implied = _HOME[check_model_name(muscle.model)]
    cost = importlib.import_module(_COST[module])
    return cost.estimate_muscle(muscle, scene, rates, **{**muscle.options, **implied})


def build_models(scene):
    """Return the models of all muscles of a scene, in their order, built side by side."""
    import numba

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        return list(pool.map(lambda muscle: build_model(muscle, scene), scene.muscles))


def check_models(scene):
    """Check the model and the settings of every muscle of a scene, building nothing.

    Raises
    ------
    SceneError
        Naming the file, the muscle and the nearest right name.
    """
    root = f"{scene.path}: " if scene.path else ""
    for muscle in scene.muscles:
        try:
            module, class_name, implied = _HOME[check_model_name(muscle.model)]
        except UsageError as error:
            raise SceneError(f"{root}muscle {muscle.name!r}: {error}") from None
        model = getattr(importlib.import_module(module), class_name)
        try:
            model.read_options({**muscle.options, **implied}, muscle.name)
        except SceneError as error:
            raise SceneError(f"{root}{error}") from None


def check_model_name(name):
    """Return a model's name, or raise UsageError with the nearest right one."""
    if name in _HOME:
        return name
    near = difflib.get_close_matches(str(name).lower().replace("_", "-"), MODEL_NAMES, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(MODEL_NAMES)}"
    raise UsageError(f"unknown model {name!r}, {hint}")
