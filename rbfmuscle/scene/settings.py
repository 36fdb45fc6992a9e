"""Changing a scene by dotted keys: ``--set KEY=VALUE``, grids of a sweep,
``Scene.with_options``.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rbfmuscle.scene.activation import contraction_keys
from rbfmuscle.scene.objects import Muscle, find_named, split_model
from rbfmuscle.scene.options import (
    KEYS,
    MotionOptions,
    NeighbourOptions,
    Table,
    check_plain,
    set_dotted,
)
from rbfmuscle.validation import SceneError, UsageError, did_you_mean

TABLES = ("contact", "neighbours", "detect", "output", "motion")
HEADS = ("model", "muscle", *KEYS, *TABLES)


def chooses_model(key: str) -> bool:
    """Whether a dotted key gives muscles another model as a whole."""
    return key == "model" or (key.startswith("muscle.") and key.endswith(".model"))


def change_settings(
    settings: Mapping[str, object],
    tables: dict[str, Table | None],
    muscles: Sequence[Muscle],
    *,
    folder: Path | None,
) -> None:
    """Set dotted keys of the tables and of the muscles of a scene, in place;
    `Scene.with_options` says what they are. Whole models come first.

    Relative names of files are relative to ``folder``.
    """
    for key in sorted(settings, key=lambda key: not chooses_model(key)):
        value = settings[key]
        value = value.item() if isinstance(value, np.generic) else value
        head, _, rest = key.partition(".")
        chosen = muscles
        if head == "muscle":
            name, _, inner = rest.partition(".")
            head, _, rest = inner.partition(".")
            if head != "model" and head not in KEYS:
                raise SceneError(
                    f"{key}: of a muscle its model (muscle.{name}.model.KEY) and "
                    f"{', '.join(KEYS)} can be set"
                )
            chosen = [find_named(muscles, name, "muscle")]
        if head == "model" or head in KEYS:
            set_on_muscles(chosen, head, rest, value, key)
        elif head not in tables:
            raise SceneError(f"{key}: unknown setting, {did_you_mean(head, HEADS)}")
        elif head == "neighbours" and isinstance(value, bool) and not rest:
            tables[head] = NeighbourOptions() if value else None
        elif not rest:
            raise SceneError(f"{key}: name a key of the table, for instance {head}.KEY=VALUE")
        else:
            tables[head] = changed_table(tables[head], rest, value, key, folder)


def set_on_muscles(
    muscles: Sequence[Muscle], head: str, rest: str, value: object, context: str
) -> None:
    """Set a model, an option of it, or a key of contraction of muscles, in place."""
    for muscle in muscles:
        if head == "model" and not rest:
            name, options = split_model(value, context="model")
            # Options of a different model are dropped.
            muscle.options = (muscle.options if muscle.model == name else {}) | options
            muscle.model = name
        elif head == "model":
            set_dotted(muscle.options, rest, value, context=context)
        else:
            keys = muscle.contraction
            given = {} if keys is None else keys.model_dump(exclude_unset=True)
            if rest and not isinstance(given.get(head), dict):
                given[head] = {}
            set_dotted(given, f"{head}.{rest}" if rest else head, value, context=head)
            muscle.contraction = contraction_keys(given, muscle=muscle.name)


def changed_table(
    table: Table | None,
    rest: str,
    value: object,
    context: str,
    folder: Path | None,
) -> Table:
    """A table of settings with one key changed; one that the scene lacks begins with defaults."""
    table = NeighbourOptions() if table is None else table
    values = table.model_dump(by_alias=True, exclude_unset=True)
    if isinstance(table, MotionOptions):
        _change_motion(values, rest, value, context)
        context = f"{context}: motion "
    else:
        set_dotted(values, rest, value, context=context)
        context = f"{context}: "
    return table.build(values, context=context, folder=folder)


def _change_motion(values, rest, value, context):
    """Set one key of ``[motion]``, in place; names of coordinates hold full stops."""
    if rest == "step" and "ramp" in values:
        for ramp in values["ramp"].values():
            ramp["step"] = value
    elif rest.startswith("ramp.") and rest.count(".") >= 2:
        name, _, last = rest.removeprefix("ramp.").rpartition(".")
        ramps = values.setdefault("ramp", {})
        if name not in ramps:
            raise SceneError(
                f"{context}: the motion has no ramp {name!r}, {did_you_mean(name, ramps)}"
            )
        ramps[name][last] = value
    else:
        values[rest] = value


def parse_settings(texts: Sequence[str] | None) -> dict[str, object]:
    """Return the settings of several "KEY=VALUE", of which the last of a key counts; values are as
    in TOML, or text.
    """
    found: dict[str, object] = {}
    for text in texts or ():
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not key:
            raise UsageError(f"{text!r} is not KEY=VALUE, for instance model.centres=200")
        found[key] = parse_value(value, context=key)
    return found


def parse_value(text: str, *, context: str) -> dict[str, object] | int | str:
    """Return the value of a TOML literal (number, true, list, table), or the text itself.

    NaN, infinity, numbers beyond 2^53 and deep nesting raise a UsageError that begins with
    ``context``.
    """
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
    try:
        check_plain(value, context=context)
    except SceneError as error:
        raise UsageError(str(error)) from None
    return value
