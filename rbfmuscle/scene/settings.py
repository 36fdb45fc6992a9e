"""Changing a scene by dotted keys: ``--set KEY=VALUE``, grids of a sweep,
``Scene.with_options``.
"""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from rbfmuscle.scene.activation.keys import KEYS, contraction_keys
from rbfmuscle.scene.build import split_model
from rbfmuscle.scene.motion import make_motion, slice_motion
from rbfmuscle.scene.objects import Muscle, SceneData
from rbfmuscle.scene.options import (
    DetectOptions,
    MotionOptions,
    SlidingOptions,
    check_plain,
    set_dotted,
)
from rbfmuscle.validation import SceneError, UsageError, did_you_mean

S = TypeVar("S", bound=SceneData)
TABLES = ("contact", "sliding", "detect", "output", "motion")
HEADS = ("model", "muscle", *KEYS, *TABLES)


def change_scene(
    scene: S,
    settings: Mapping[str, Any] | None = None,
    *,
    model: str | dict[str, Any] | None = None,
    frames: slice | str | None = None,
) -> S:
    """Return a copy of a scene with other settings, another model or other frames; meshes are
    shared.

    Parameters
    ----------
    settings : mapping, optional
        Dotted keys with their values: ``{"model.centres": 200, "contact.substep_angle": 1}``.
        ``model`` and ``model.KEY`` change every muscle, ``muscle.NAME.model.KEY`` one; so do the
        keys of contraction. ``contact.KEY``, ``sliding.KEY``, ``detect.KEY`` and ``output.KEY``
        change a table, one that the scene lacks is switched on. ``motion.step`` changes the step of
        every ramp, ``motion.ramp.NAME.COORDINATE.KEY`` one key of one. Whole models come first, as
        another model drops the settings of the one before.
    model : str or dict, optional
        For every muscle. Options of another model are dropped.
    frames : slice or str, optional
        Which frames of the motion, as a slice or "A:B:S".

    Raises
    ------
    UsageError
        If a key is unknown, with the nearest right one, or a value is not allowed.
    """
    changed, settings = scene.copy(), settings or {}
    try:
        if model is not None:
            _set_models(changed.muscles, model)
        for key in sorted(settings, key=lambda key: not chooses_model(key)):
            value = settings[key]
            _apply(changed, key, value.item() if isinstance(value, np.generic) else value)
        if frames is not None:
            chosen = parse_slice(frames) if isinstance(frames, str) else frames
            changed.motion = slice_motion(changed.motion, chosen)
    except SceneError as error:
        raise UsageError(str(error)) from None
    return changed


def chooses_model(key: str) -> bool:
    """Whether a dotted key gives muscles another model as a whole."""
    return key == "model" or (key.startswith("muscle.") and key.endswith(".model"))


def _apply(scene, key, value):
    head, _, rest = key.partition(".")
    muscles, folder = scene.muscles, scene.path.parent if scene.path else None
    if head == "muscle":
        name, _, inner = rest.partition(".")
        head, _, rest = inner.partition(".")
        muscles = [scene.muscle(name)]
        if head != "model" and head not in KEYS:
            allowed = f"its model (muscle.{name}.model.KEY) and {', '.join(KEYS)}"
            raise SceneError(f"{key}: of a muscle {allowed} can be set")
    if head == "model" and not rest:
        _set_models(muscles, value)
    elif head == "model":
        for muscle in muscles:
            set_dotted(muscle.options, rest, value, place=key)
    elif head in KEYS:
        for muscle in muscles:
            _set_contraction(muscle, head, rest, value)
    elif head not in TABLES:
        raise SceneError(f"{key}: unknown setting, {did_you_mean(head, HEADS)}")
    elif not rest:
        raise SceneError(f"{key}: name a key of the table, for instance {head}.KEY=VALUE")
    elif head == "motion":
        values = _changed_motion(scene.motion.options, rest, value, key)
        options = MotionOptions.build(values, place=f"{key}: motion ", folder=folder)
        scene.motion = make_motion(scene, options)
    else:
        table = getattr(scene, head) or {"sliding": SlidingOptions, "detect": DetectOptions}[head]()
        values = table.model_dump(by_alias=True, exclude_unset=True)
        set_dotted(values, rest, value, place=key)
        setattr(scene, head, table.build(values, place=f"{key}: "))


def _set_models(muscles: Sequence[Muscle], model: str | dict[str, Any]) -> None:
    """Give muscles another model; options of a different model are dropped."""
    name, options = split_model(model, place="model")
    for muscle in muscles:
        kept = muscle.options if muscle.model == name else {}
        muscle.model, muscle.options = name, kept | options


def _set_contraction(muscle, key, rest, value):
    given = {} if muscle.contraction is None else muscle.contraction.model_dump(exclude_unset=True)
    if rest and not isinstance(given.get(key), dict):
        given[key] = {}
    set_dotted(given, f"{key}.{rest}" if rest else key, value, place=key)
    muscle.contraction = contraction_keys(given, muscle=muscle.name)


def _changed_motion(options, rest, value, key):
    """Values of a motion's table with one key changed; names of coordinates hold full stops."""
    values = options.model_dump(by_alias=True, exclude_unset=True)
    if rest == "step" and options.ramp is not None:
        for ramp in values["ramp"].values():
            ramp["step"] = value
    elif rest.startswith("ramp.") and rest.count(".") >= 2:
        name, _, last = rest.removeprefix("ramp.").rpartition(".")
        ramps = values.setdefault("ramp", {})
        if name not in ramps:
            raise SceneError(f"{key}: the motion has no ramp {name!r}, {did_you_mean(name, ramps)}")
        ramps[name][last] = value
    else:
        values[rest] = value
    return values


def parse_settings(texts: Sequence[str] | None) -> dict[str, Any]:
    """Return the settings of several "KEY=VALUE", of which the last of a key counts; values are as
    in TOML, or text.
    """
    found = {}
    for text in texts or ():
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not key:
            raise UsageError(f"{text!r} is not KEY=VALUE, for instance model.centres=200")
        found[key] = parse_value(value, place=key)
    return found


def parse_value(text: str, *, place: str) -> dict[str, Any] | int | str:
    """Return the value of a TOML literal (number, true, list, table), or the text itself.

    NaN, infinity, numbers beyond 2^53 and deep nesting raise a UsageError that begins with
    ``place``.
    """
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
    try:
        check_plain(value, place=place)
    except SceneError as error:
        raise UsageError(str(error)) from None
    return value


def parse_slice(text: str) -> slice:
    """Return the slice of "A:B:S" (each part may be empty), or of a single frame "A"."""
    try:
        numbers = [int(part) if part.strip() else None for part in text.split(":")]
        if len(numbers) == 1:
            first = int(text)
            return slice(first, first + 1 or None)
        if len(numbers) > 3 or numbers[2:] == [0]:
            raise ValueError
    except ValueError:
        example = "A:B:S (whole numbers, S not 0), for instance 0:46:5"
        raise UsageError(f"frames {text!r} must look like {example}") from None
    return slice(*numbers)
