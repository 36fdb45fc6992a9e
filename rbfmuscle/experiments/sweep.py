"""A sweep: one or several scenes under a grid of settings, laid out as points that are run once each."""

from __future__ import annotations

import hashlib
import itertools
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rbfmuscle.scene.settings import parse_value
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene

# Model ("" for all), key and values of each setting that is varied.
Grid = list[tuple[str, str, list[Any]]]

# Of these keys the reference takes the greatest value of the grid, or the least; of all others the scene's own.
FINER_UP = ("model.centres", "model.samples", "model.nodes", "model.iterations", "model.resolution")
FINER_DOWN = ("contact.substep_angle", "motion.step")


@dataclass(frozen=True)
class SweepPoint:
    """One combination of settings of one scene.

    ``settings`` are dotted keys with their values, the model first; ``scene`` is a name. ``key`` is a hash of the
    scene's content and the settings; ``model`` the model that they choose, "" where they choose none; ``role``
    "reference", "default" (the scene's own settings, of this model) or ""; ``reference`` the key of the point that the
    error is measured against, "" without a grid.
    """

    key: str
    scene: str
    settings: dict[str, Any]
    model: str
    role: str
    reference: str

    @property
    def label(self) -> str:
        """The settings in words."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items()) or "default"


def parse_grid(texts: Sequence[str]) -> Grid:
    """Return the grid of ``["KEY=a,b,c", ...]``; "MODEL:KEY=a,b" holds for the points of that model only.

    UsageError on text of another form, or a key given twice or without values.
    """
    grid: Grid = []
    for text in texts:
        name, found, values = text.partition("=")
        model, has_model, key = name.strip().rpartition(":")
        if not found or not key or not values.strip() or (has_model and not model):
            raise UsageError(f"{text!r} is not KEY=a,b,c, for instance model.centres=100,200,300")
        if any(key == other and model in ("", m) for m, other, _ in grid):
            raise UsageError(f"{key} is given twice in the grid")
        grid.append((model, key, list(dict.fromkeys(_values(key, values)))))
    for model, key, _ in grid:
        if model and model not in _models(grid):
            raise UsageError(f"{model}:{key} needs {model!r} among the grid's models (--grid model=...)")
    return grid


def _values(key, text):
    try:
        return tomllib.loads(f"value = [{text}]")["value"]
    except tomllib.TOMLDecodeError:
        return [parse_value(part.strip(), place=key) for part in text.split(",") if part.strip()]


def _models(grid):
    return next((values for _, key, values in grid if key == "model"), [""])


def plan_sweep(
    scenes: Mapping[str, Scene],
    grid: Grid,
    *,
    frames: str | None = None,
    reference: Mapping[str, Any] | None = None,
) -> list[SweepPoint]:
    """Lay out a sweep scene by scene: references, the scene's own settings, the grid; nothing is run.

    Parameters
    ----------
    scenes : dict of str to Scene
        By name.
    grid : list of (model, key, values)
        From `parse_grid`; empty where scenes are compared as they are.
    frames : str, optional
        Frames of the motion, "A:B:S".
    reference : dict, optional
        Settings of the reference, over those that follow from the grid: the greatest number of centres, samples,
        nodes, iterations and cells in it and the least angle and step. With a ``model``, one reference serves all
        models; else each model of the grid has its own.
    """
    return [point for n, s in scenes.items() for point in _points(n, s, grid, frames, dict(reference or {}))]


def _points(name, scene, grid, frames, reference):
    content = scene_content(scene, frames)
    if not grid:
        return [SweepPoint(point_key(content, {}), name, {}, "", "default", "")]
    found = {}
    for model in _models(grid):
        best = reference.get("model", model)
        finest = _settings(best, {**_finest(_axes(grid, best)), **reference})
        target = point_key(content, finest)
        found[target] = SweepPoint(target, name, finest, best, "reference", target)
        axes = _axes(grid, model)
        for number, values in enumerate([(), *itertools.product(*axes.values())]):
            settings = _settings(model, dict(zip(axes, values)))
            key = point_key(content, settings)
            role = "default" if number == 0 else ""
            found.setdefault(key, SweepPoint(key, name, settings, model, role, target))
    return sorted(found.values(), key=lambda point: ("reference", "default", "").index(point.role))


def _axes(grid, model):
    return {key: values for only, key, values in grid if key != "model" and only in ("", model)}


def _settings(model, others):
    """The model first, as choosing another one drops its options."""
    return {**({"model": model} if model else {}), **others}


def _finest(axes):
    up = {key: max(values) for key, values in axes.items() if key in FINER_UP}
    return up | {key: min(values) for key, values in axes.items() if key in FINER_DOWN}


def scene_content(scene: Scene, frames: str | None = None) -> str:
    """Hash of what a scene would simulate, wherever its files lie."""
    facts = scene.resolved()
    for part in ("file", "output"):
        facts.pop(part)
    for item in [*facts["bones"], *facts["muscles"]]:
        item.pop("mesh")
    held = [
        [
            (a.bone, [int(v) for v in a.vertices], a.tendon and a.tendon.model_dump())
            for a in muscle.attachments
        ]
        for muscle in scene.muscles
    ]
    fibres = [[line.tolist() for line in muscle.fibres or []] for muscle in scene.muscles]
    track = [sorted(frame.items()) for frame in scene.motion.frames]
    return _hash([facts, held, fibres, track, str(frames or "")])


def point_key(content: str, settings: Mapping[str, Any]) -> str:
    """Key of a point: 16 hexadecimal digits."""
    return _hash([content, sorted(settings.items())])[:16]


def _hash(facts):
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()
