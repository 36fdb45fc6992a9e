"""A sweep: one scene under a grid of settings, each point measured once and kept in a file of its own.

A folder of a sweep holds ``plan.json`` (what was asked for), ``points/KEY.json`` (a result each, written in one
move), ``references/KEY.npz`` (surfaces that errors are measured against) and the tables. A point's key is a hash
of the scene's content and the point's settings, so what is there is never computed again, whoever computed it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.sim.scene.settings import parse_value
from rbfmuscle.study.files.writer import write_json
from rbfmuscle.validation import UsageError, did_you_mean

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene


FORMAT = 1
# Of these keys the reference takes the greatest value of the grid, or the least; of all others the scene's own.
FINER_UP = ("model.centres", "model.samples", "model.iterations", "model.resolution", "model.substeps")
FINER_DOWN = ("contact.substep_angle", "contact.tolerance", "motion.step")


@dataclass(frozen=True)
class SweepPoint:
    """One combination of settings.

    Attributes
    ----------
    key : str
        Hash of the scene and the settings.
    settings : dict
        Dotted keys with their values, the model first.
    model : str
        Name of the model that the settings choose, "" where they choose none.
    default : bool
        The scene's own settings (of this model).
    reference : str
        Key of the point that its error is measured against.
    """

    key: str
    settings: dict
    model: str
    default: bool
    reference: str

    @property
    def is_reference(self) -> bool:
        """Whether others are compared with this point."""
        return self.key == self.reference

    @property
    def label(self) -> str:
        """The settings in words."""
        return " ".join(f"{key}={value}" for key, value in self.settings.items()) or "default"


def parse_grid(texts: list[Any]) -> list[tuple[str, str, list[Any]]]:
    """Return the grid of ``["KEY=a,b,c", ...]`` as a list of (model, key, values).

    "MODEL:KEY=a,b" holds for the points of that model only; model is "" where the key holds for all.

    Raises
    ------
    UsageError
        On text of another form, a key given twice or without values.
    """
    grid = []
    for text in texts:
        name, found, values = text.partition("=")
        model, has_model, key = name.strip().rpartition(":")
        if not found or not key or not values.strip() or (has_model and not model):
            raise UsageError(f"{text!r} is not KEY=a,b,c, for instance model.centres=100,200,300")
        if any(key == other and model in ("", m) for m, other, _ in grid):
            raise UsageError(f"{key} is given twice in the grid")
        grid.append((model, key, list(dict.fromkeys(_values(key, values)))))
    if not grid:
        raise UsageError("a sweep needs a grid, for instance --grid model.centres=100,200,300")
    models = next((values for _, key, values in grid if key == "model"), [])
    for model, key, _ in grid:
        if model and model not in models:
            raise UsageError(f"{model}:{key} needs {model!r} among the grid's models (--grid model=...)")
    return grid


def _values(key, text):
    try:
        return tomllib.loads(f"value = [{text}]")["value"]
    except tomllib.TOMLDecodeError:
        return [parse_value(part.strip(), place=key) for part in text.split(",") if part.strip()]


@dataclass(frozen=True)
class SweepPlan:
    """All points of a sweep, in the order of its table.

    Attributes
    ----------
    points : list of SweepPoint
        References first, then the scene's own settings, then the grid.
    facts : dict
        What ``plan.json`` holds besides.
    """

    points: list
    facts: dict

    @property
    def references(self) -> list[SweepPoint]:
        """Points that others are compared with."""
        return [point for point in self.points if point.is_reference]

    def slice(self, part: tuple[int, int] | None) -> list[Any]:
        """Points of an array job's task ``(i, n)``, the references left out; ``i = 0`` has none."""
        others = [point for point in self.points if not point.is_reference]
        if part is None:
            return others
        i, n = part
        return others[i - 1 :: n] if i else []

    def point(self, key: Any) -> Any:
        """The point of a key."""
        return next(point for point in self.points if point.key == key)

    def as_dict(self) -> dict[str, Any]:
        """What ``plan.json`` holds."""
        points = [
            {
                "key": p.key,
                "settings": p.settings,
                "model": p.model,
                "default": p.default,
                "reference": p.reference,
            }
            for p in self.points
        ]
        return {"format": FORMAT, **self.facts, "points": points}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> SweepPlan:
        """The plan that ``plan.json`` holds."""
        values = dict(values)
        if values.pop("format", None) != FORMAT:
            raise UsageError(f"this sweep's plan has another format than {FORMAT}; run the sweep again")
        return cls([SweepPoint(**point) for point in values.pop("points")], values)


def plan_sweep(
    scene: Scene,
    grid: list[tuple[str, str, list[Any]]],
    *,
    frames: str | None = None,
    reference: dict[str, Any] | None = None,
) -> SweepPlan:
    """Lay out a sweep; nothing is run.

    Parameters
    ----------
    scene : Scene
    grid : list of (model, key, values)
        From `parse_grid`.
    frames : str, optional
        Frames of the motion, "A:B:S".
    reference : dict, optional
        Settings of the reference, over those that follow from the grid: the greatest number of centres,
        samples, iterations and cells in it and the least angle and step. With a ``model``, one reference
        serves all models; else each model of the grid has its own.

    Returns
    -------
    SweepPlan

    Raises
    ------
    UsageError
        If a key or value of the grid is not one that the scene takes.
    """
    reference = dict(reference or {})
    models = next((values for _, key, values in grid if key == "model"), [""])
    content = scene_content(scene, frames)
    references, points = {}, {}
    for model in models:
        lead = {"model": model} if model else {}
        axes = {key: values for only, key, values in grid if key != "model" and only in ("", model)}
        finest = _finest(axes) if reference.get("model", model) == model else {}
        settings = _ordered({**lead, **finest, **reference})
        target = point_key(content, settings)
        references[target] = SweepPoint(target, settings, settings.get("model", ""), settings == lead, target)
        own = [lead, *(lead | dict(zip(axes, values)) for values in itertools.product(*axes.values()))]
        for number, settings in enumerate(own):
            key = point_key(content, _ordered(settings))
            if key not in points:
                points[key] = SweepPoint(key, _ordered(settings), model, number == 0, target)
    if "model" in reference and len(references) > 1:
        references = _one(references, points)
    for point in [*references.values(), *points.values()]:
        scene.with_options(point.settings, frames=frames)
    chosen = list(references.values()) + [p for k, p in points.items() if k not in references]
    facts = {
        "scene": scene.name,
        "units": scene.units,
        "content": content,
        "frames": str(frames or ""),
        "grid": [[model, key, values] for model, key, values in grid],
    }
    return SweepPlan(chosen, facts)


def _one(references, points):
    """With a reference of one model for all, the settings that its own model's axes gave are the finest."""
    most = max(references.values(), key=lambda point: len(point.settings))
    for key, point in points.items():
        points[key] = SweepPoint(point.key, point.settings, point.model, point.default, most.key)
    return {most.key: most}


def _finest(axes):
    finest = {}
    for key, values in axes.items():
        if key in FINER_UP:
            finest[key] = max(values)
        elif key in FINER_DOWN:
            finest[key] = min(values)
    return finest


def _ordered(settings):
    """The model first, as choosing another one drops its options."""
    return dict(sorted(settings.items(), key=lambda item: item[0] != "model"))


def scene_content(scene: Scene, frames: str | None = None) -> str:
    """Hash of what a scene would simulate, wherever its files lie."""
    facts = scene.resolved()
    for part in ("file", "output"):
        facts.pop(part)
    for item in [*facts["bones"], *facts["muscles"]]:
        item.pop("mesh")
    places = {muscle.name: _attachments(muscle) for muscle in scene.muscles}
    track = [sorted(frame.items()) for frame in scene.motion.frames]
    return _hash([facts, places, track, str(frames or "")])


def _attachments(muscle):
    lines = [line.tolist() for line in muscle.fibres or []]
    return [[a.bone, [int(v) for v in a.vertices]] for a in muscle.attachments], lines


def point_key(content: str, settings: dict[str, Any]) -> str:
    """Key of a point: 16 hexadecimal digits."""
    return _hash([FORMAT, content, sorted(settings.items())])[:16]


def _hash(facts):
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


class SweepFolder:
    """The files of a sweep.

    Parameters
    ----------
    directory : path
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        self.points = self.directory / "points"
        self.surfaces = self.directory / "references"

    def prepare(self, plan: SweepPlan) -> None:
        """Make the folder and keep the plan.

        Raises
        ------
        UsageError
            If the folder holds another sweep, or cannot be written to.
        """
        try:
            for folder in (self.points, self.surfaces):
                folder.mkdir(parents=True, exist_ok=True)
            if (self.directory / "plan.json").exists():
                if self.read_plan().as_dict() != json.loads(json.dumps(plan.as_dict())):
                    raise UsageError(
                        f"{self.directory} holds a sweep of another scene or grid; choose another folder (-o)"
                    )
            else:
                write_json(self.directory / "plan.json", plan.as_dict())
        except OSError as error:
            raise UsageError(f"cannot write to {self.directory}: {error.strerror}") from None

    def read_plan(self) -> SweepPlan:
        """The sweep's plan; raises UsageError where there is none."""
        try:
            return SweepPlan.from_dict(json.loads((self.directory / "plan.json").read_text(encoding="utf-8")))
        except (OSError, json.JSONDecodeError):
            raise UsageError(f"{self.directory} is not the folder of a sweep (no plan.json)") from None

    def read(self, key: str, *, waiting: bool = False) -> dict[str, Any] | None:
        """A point's result, None where there is none yet; ``waiting`` for one that is not compared yet."""
        try:
            return json.loads(self._result_file(key, waiting).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None

    def write(self, result: dict[str, Any]) -> None:
        """Keep a point's result: whole or not at all."""
        waiting = result["status"] == "waiting"
        write_json(self._result_file(result["key"], waiting), result)
        if not waiting:
            self._result_file(result["key"], True).unlink(missing_ok=True)
            self.waiting_file(result["key"]).unlink(missing_ok=True)

    def _result_file(self, key, waiting):
        return self.surfaces / f"{key}.waiting.json" if waiting else self.points / f"{key}.json"

    def is_waiting(self, key: str) -> bool:
        """Whether a point was run and waits for its reference."""
        return self._result_file(key, True).exists()

    def forget(self, key: str) -> None:
        """Take a point's result away."""
        (self.points / f"{key}.json").unlink(missing_ok=True)

    def surface_file(self, key: str) -> Path:
        """Surfaces of a reference."""
        return self.surfaces / f"{key}.npz"

    def waiting_file(self, key: str) -> Path:
        """Surfaces of a point that waits for its reference."""
        return self.surfaces / f"{key}.waiting.npz"


def parse_task(text: str) -> tuple[int, int]:
    """Return (i, n) of "I/N"; I = 0 stands for the references alone.

    Raises
    ------
    UsageError
        On any other text.
    """
    first, _, last = text.partition("/")
    if not (first.strip().isdigit() and last.strip().isdigit() and 0 <= int(first) <= int(last) > 0):
        raise UsageError(f"--task {text!r} must look like I/N with I from 1 to N (or 0/N), for instance 3/8")
    return int(first), int(last)


def check_key(name: str, known: tuple[Any, ...]) -> None:
    """Raise UsageError naming the nearest right key of a table."""
    if name not in known:
        raise UsageError(f"unknown quantity {name!r}, {did_you_mean(name, known)}")
