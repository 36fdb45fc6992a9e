"""Model names and what builds them; the only module that knows both models."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import NamedTuple

from rbfmuscle.geometry.threads import blas_limited, each
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import Table
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import HEADS
from rbfmuscle.simulation.frame import MuscleModel
from rbfmuscle.validation import SceneError, UsageError, did_you_mean, shown

# Sweeps of the converged mesh models go on until none moves a vertex by more than this share of the
# muscle's size.
CONVERGED = 5e-6


class ModelKind(NamedTuple):
    """What a model's name stands for.

    ``build`` makes the model of a muscle of a scene from the checked table of its settings,
    ``options`` is that table's class, ``points`` says in words what the model solves for, building
    nothing. ``title`` is its name in tables and pictures, with ``{}`` for its number of sweeps,
    ``solver_sweeps``.

    Examples
    --------
    >>> import rbfmuscle as rm
    >>> isinstance(rm.model_kind("pbd"), rm.ModelKind)
    True
    """

    # Both take the options' own class, which a type of a function cannot say.
    build: Callable[..., MuscleModel]
    options: type[Table]
    points: Callable[..., str]
    title: str
    sweeps: int = 0


@cache
def _rbf() -> ModelKind:
    from rbfmuscle.muscle.muscle import RBFMuscle
    from rbfmuscle.muscle.rest import RBFOptions, solved_points

    return ModelKind(RBFMuscle, RBFOptions, solved_points, "RBF")


@cache
def _mesh(method: str, title: str, tolerance: float = 0.0) -> ModelKind:
    from pbd_baseline.muscle import PBDMuscle
    from pbd_baseline.rest import PBDOptions, solved_points
    from pbd_baseline.shapes import METHODS

    chosen = METHODS[method]._replace(tolerance=tolerance)
    build = partial(PBDMuscle, method=chosen)
    sweeps = 0 if tolerance else chosen.sweeps
    return ModelKind(build, PBDOptions, solved_points, title, sweeps)


# What loads a kind, by name: a model's package is imported when it is first asked for.
_KINDS: dict[str, Callable[[], ModelKind]] = {
    "rbf": _rbf,
    "pbd": lambda: _mesh("pbd", "PBD, {} sweeps"),
    "xpbd": lambda: _mesh("xpbd", "XPBD, {} sweeps"),
    "arap-pbd": lambda: _mesh("arap-pbd", "arap-pbd, {} sweeps"),
    "arap-volume": lambda: _mesh("arap-volume", "arap-volume, {} sweeps"),
    "pbd-converged": lambda: _mesh("pbd", "PBD, converged", CONVERGED),
    "xpbd-converged": lambda: _mesh("xpbd", "XPBD, converged", CONVERGED),
    "arap-pbd-converged": lambda: _mesh("arap-pbd", "arap-pbd, converged", CONVERGED),
    "arap-volume-converged": lambda: _mesh("arap-volume", "arap-volume, converged", CONVERGED),
}


def register_model(name: str, kind: ModelKind) -> None:
    """Add a model under a name of its own, for scenes, `simulate` and `compare`.

    Parameters
    ----------
    name : str
        UsageError if it is taken.
    kind : ModelKind

    Examples
    --------
    >>> import rbfmuscle as rm
    >>> rm.register_model("my-pbd", rm.model_kind("pbd")._replace(title="PBD of mine"))
    >>> rm.model_kind("my-pbd").title
    'PBD of mine'
    """
    if name in _KINDS:
        raise UsageError(f"model {shown(repr(name))} is known already, choose another name")
    _KINDS[name] = lambda: kind


def model_names() -> tuple[str, ...]:
    """Names of all models, those registered last."""
    return tuple(_KINDS)


def model_kind(name: str) -> ModelKind:
    """What a model's name stands for.

    Parameters
    ----------
    name : str
        UsageError with the nearest right name on an unknown one.

    Examples
    --------
    >>> model_kind("rbf").title
    'RBF'
    """
    if name not in _KINDS:
        hint = did_you_mean(str(name).lower()[:100].replace("_", "-"), model_names())
        raise UsageError(f"unknown model {shown(repr(name))}, {hint}")
    return _KINDS[name]()


def model_title(muscle: Muscle) -> str:
    """Name of a muscle's model in tables and pictures, with its number of sweeps where it has
    one.
    """
    kind = model_kind(muscle.model)
    return kind.title.format(muscle.options.get("iterations", 0) or kind.sweeps)


def build_model(muscle: Muscle, scene: Scene, name: str | None = None) -> MuscleModel:
    """Return the model of one muscle of a scene; the scene's own choice where no name is given.

    The options of the scene's model table are for models with the same settings, and are left out
    for another. UsageError on an unknown name, with the nearest right one; SceneError if a setting
    is unknown or impossible.
    """
    kind, own = model_kind(muscle.model if name is None else name), model_kind(muscle.model)
    given = muscle.options if own.options is kind.options else {}
    return kind.build(muscle, scene, _read_options(muscle, kind, given))


def solved_points(muscle: Muscle, scene: Scene) -> str:
    """The points that the model of a muscle solves for, in words; nothing is built."""
    return model_kind(muscle.model).points(muscle, scene, _own_options(muscle))


def kernel_names(scene: Scene) -> dict[str, str]:
    """Kernel of each muscle whose model has one, by the muscle's name; nothing is built."""
    options = {muscle.name: _own_options(muscle) for muscle in scene.muscles}
    return {name: found.kernel for name, found in options.items() if hasattr(found, "kernel")}


def build_models(scene: Scene) -> list[MuscleModel]:
    """Return the models of a scene's muscles, in the scene's order, built side by side."""
    with blas_limited(1):
        return each(lambda muscle: build_model(muscle, scene), scene.muscles)


def configure_scene(
    scene: Scene,
    settings: Mapping[str, object] | None = None,
    *,
    model: str | dict[str, object] | None = None,
    frames: slice | str | None = None,
) -> Scene:
    """Return a scene with other settings, checked to the last key of every muscle's model; nothing
    is built.

    Arguments are those of `Scene.with_options`. SceneError if the scene itself names an unknown
    model, or an unknown or impossible setting of one; UsageError if the settings do.
    """
    check_models(scene)
    for key in settings or ():
        schemas = (model_kind(name).options for name in model_names())
        if key.partition(".")[0] not in HEADS and any(
            key in schema.model_fields for schema in schemas
        ):
            raise UsageError(f"{key}: unknown setting, did you mean 'model.{key}'?")
    changed = scene.with_options(settings, model=model, frames=frames)
    for muscle in changed.muscles:
        try:
            _own_options(muscle)
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
            _own_options(muscle)
        except UsageError as error:
            raise SceneError(f"{root}muscle {muscle.name!r}: {error}") from None
        except SceneError as error:
            raise SceneError(f"{root}{error}") from None


def _own_options(muscle: Muscle) -> Table:
    """The checked settings of a muscle's own model."""
    return _read_options(muscle, model_kind(muscle.model), muscle.options)


def _read_options(muscle: Muscle, kind: ModelKind, table: Mapping[str, object]) -> Table:
    """The checked settings of a muscle's model."""
    return kind.options.build(table, context=f"muscle {muscle.name!r}: model: ")
