"""A sweep: one or several scenes under a grid of settings, laid out as points that are run once
each.
"""

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rbfmuscle.output.writer import versions
from rbfmuscle.scene.content import content_hash
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.settings import parse_value
from rbfmuscle.validation import UsageError

# Values of each setting that is varied.
Grid = Mapping[str, Sequence[object]]

# Of these keys the reference takes the greatest value of the grid, or the least; of all others the
# scene's own.
FINER_UP = ("model.centres", "model.samples", "model.nodes", "model.iterations", "model.resolution")
FINER_DOWN = ("contact.substep_angle", "motion.step")


@dataclass(frozen=True)
class SweepPoint:
    """One combination of settings of one scene.

    ``key`` is a hash of the library's version, the scene's content and the settings; ``scene`` a
    name; ``settings`` are dotted keys with their values, the model first; ``role`` is "reference",
    "default" (the scene's own settings) or ""; ``reference`` is the key of the point that the error
    is measured against, "" without a grid.
    """

    key: str
    scene: str
    settings: dict[str, object]
    role: str
    reference: str

    @property
    def label(self) -> str:
        """The settings in words."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items()) or "default"


def parse_grid(texts: Sequence[str]) -> Grid:
    """Return the grid of ``["KEY=a,b,c", ...]``; UsageError on other text, or a key given twice or
    without values.
    """
    grid: dict[str, list[object]] = {}
    for text in texts:
        name, found, values = text.partition("=")
        key = name.strip()
        if not found or not key or not values.strip():
            raise UsageError(f"{text!r} is not KEY=a,b,c, for instance model.centres=100,200,300")
        if key in grid:
            raise UsageError(f"{key} is given twice in the grid")
        try:
            parts = tomllib.loads(f"value = [{values}]")["value"]
        except tomllib.TOMLDecodeError:
            parts = [
                parse_value(part.strip(), context=key) for part in values.split(",") if part.strip()
            ]
        if key in (*FINER_UP, *FINER_DOWN) and not all(
            isinstance(part, int | float) for part in parts
        ):
            raise UsageError(f"{key}: {values} are not all numbers")
        grid[key] = [part for k, part in enumerate(parts) if part not in parts[:k]]
    return grid


def plan_sweep(
    scenes: Mapping[str, Scene],
    grid: Grid,
    *,
    frames: str | None = None,
    reference: Mapping[str, object] | None = None,
) -> list[SweepPoint]:
    """Lay out a sweep scene by scene: reference, the scene's own settings, the grid; nothing is
    run.

    Without a grid scenes (by name) are compared as they are. ``frames`` are those of the motion,
    "A:B:S". ``reference`` holds settings of the reference, over those that follow from the grid:
    the greatest number of centres, samples, nodes, iterations and cells in it and the least angle
    and step.
    """
    return [
        point
        for n, s in scenes.items()
        for point in _points(n, s, grid, frames, dict(reference or {}))
    ]


def _points(name, scene, grid, frames, reference):
    content = scene_content(scene, frames)
    found = {}
    target = ""
    if grid:
        up = {key: max(values) for key, values in grid.items() if key in FINER_UP}
        down = {key: min(values) for key, values in grid.items() if key in FINER_DOWN}
        finest = _model_first(up | down | reference)
        target = point_key(content, finest)
        found[target] = SweepPoint(target, name, finest, "reference", target)
    for number, values in enumerate([(), *itertools.product(*grid.values())]):
        settings = _model_first(dict(zip(grid, values)))
        key = point_key(content, settings)
        found.setdefault(key, SweepPoint(key, name, settings, "" if number else "default", target))
    return list(found.values())


def _model_first(settings):
    """As choosing another model drops its options."""
    return dict(sorted(settings.items(), key=lambda item: item[0] != "model"))


def scene_content(scene: Scene, frames: str | None = None) -> str:
    """Hash of what a scene would simulate, wherever its files lie, and of the library's version."""
    return content_hash(scene, str(frames or ""), versions()["rbfmuscle"])


def point_key(content: str, settings: Mapping[str, object]) -> str:
    """Key of a point: 16 hexadecimal digits."""
    return content_hash(content, settings)[:16]
