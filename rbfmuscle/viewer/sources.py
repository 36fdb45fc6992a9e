"""What a viewer shows: a scene moved by hand, or saved runs scrubbed by frame; no browser here."""

import copy
import math
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rbfmuscle.anatomy.bones import orient_scene
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.fibres import build_bundles
from rbfmuscle.geometry.arrays import Floats, unit
from rbfmuscle.geometry.surfaces import clustered
from rbfmuscle.metrics.centreline import Centreline
from rbfmuscle.metrics.rows import ARM_REACH, moment_arms
from rbfmuscle.metrics.verdict import describe_doubts
from rbfmuscle.models import build_models, configure_scene, model_names
from rbfmuscle.run.appearance import muscle_colours, muscle_groups, tendon_mesh
from rbfmuscle.run.data import RunData, frame_caption
from rbfmuscle.scene.activation import STEP
from rbfmuscle.scene.check import stated_doubts
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.motion import (
    SHIFT_LEVER,
    bone_poses,
    coordinate_limits,
    inner_value,
    shown_value,
    unit_sign,
)
from rbfmuscle.scene.objects import Motion, body_axes, from_mm
from rbfmuscle.scene.scene import Scene, doubtful, require_complete
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.frame import FibreLines, Frame, Mesh, MuscleModel
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.validation import UsageError

REACH = 25.0  # of a joint's axis to either side of its centre [mm]


class Mark(NamedTuple):
    """Points at rest that move with a bone, and the joint or muscle that they are of: ends
    (k, 2, 3) of lines along the joint's axes, or vertices (n, 3) of the muscle.
    """

    name: str
    bone: str
    points: Floats


class Marks(NamedTuple):
    """What can be marked: axes of joints, held vertices, and sentences on what is doubtful."""

    axes: list[Mark]
    held: list[Mark]
    doubts: list[str]


def scene_marks(scene: Scene) -> Marks:
    """The marks of a scene; attachments that tendons hold are left out."""
    axes = []
    for joint in scene.joints:
        moving = [a for a in (*joint.rotations, *joint.translations) if a.coordinates]
        if moving:
            along = from_mm(REACH, scene.units) * unit(np.array([a.direction for a in moving]))
            ends = np.stack([joint.centre - along, joint.centre + along], axis=1)
            axes.append(Mark(joint.name, joint.parent, ends))
    held = [
        Mark(muscle.name, end.bone, np.asarray(muscle.mesh.vertices)[end.vertices])
        for muscle in scene.muscles
        for end in muscle.attachments
        if end.tendon is None
    ]
    guesses = [
        f"{guess.table} {guess.name}: {guess.text}"
        for table in ("joint", "muscle")
        for guess in doubtful(scene.guesses, table)
    ]
    stated = [f"{name}: {text}" if name else text for name, text in stated_doubts(scene)]
    return Marks(axes, held, [*stated, *guesses])


REST_TRIANGLES = 3000  # of a muscle, until its model is built
TRAIL = 16  # pictures along which moment arms are measured
ACTIVATION = "activation "  # what the name of a muscle's control begins with


class Control(NamedTuple):
    """A number set by hand [degree, scene unit, activation or frame]: its group, label, limits and
    first value.
    """

    group: str
    label: str
    low: float
    high: float
    value: float


class Picture(NamedTuple):
    """One picture's content by bone or muscle; tendons, activation, depth [scene unit], fibres and
    moment arm about the coordinate that moved [scene unit] of those that have them.
    """

    poses: dict[str, Floats]
    surfaces: dict[str, Mesh]
    tendons: dict[str, Mesh]
    activation: dict[str, float]
    depth: dict[str, float]
    text: str
    fibres: Mapping[str, FibreLines] = MappingProxyType({})
    moment_arms: Mapping[str, float] = MappingProxyType({})


class LiveSource:
    """A scene whose coordinates and activations are set by hand, by its own model or the one named.

    ``choices`` are models; bones and muscles (vertices, faces) by name are those at rest; ``body``
    (3, 3) is left, posterior and superior; ``rest`` is shown until a model is built. ``motion``
    holds what the controls are set to in each frame of the scene's motion.
    """

    def __init__(self, scene: Scene, model: str | None = None) -> None:
        self.scene = scene = orient_scene(require_complete(configure_scene(scene, model=model)))
        self.title = scene.name
        self.units = scene.units
        self.millimetre = from_mm(1.0, scene.units)
        self.body = body_axes(scene.superior, scene.anterior)
        first = scene.muscles[0].model
        self.choices = [first, *(name for name in model_names() if name != first)]
        self.bones, self.muscles = (
            {
                item.name: (np.asarray(item.mesh.vertices), np.asarray(item.mesh.faces))
                for item in items
            }
            for items in (scene.bones, scene.muscles)
        )
        groups = muscle_groups(
            scene.joints, {m.name: [a.bone for a in m.attachments] for m in scene.muscles}
        )
        self.colours = muscle_colours(list(self.muscles), groups)
        coarse = {name: clustered(*mesh, REST_TRIANGLES) for name, mesh in self.muscles.items()}
        self.rest = Picture(bone_poses(scene, {}), coarse, {}, {}, {}, "")
        self.marks = scene_marks(scene)
        known, limits = all_coordinates(scene.joints), coordinate_limits(scene)
        self.controls: dict[str, Control] = {}
        for name, ends in limits.items():
            group, _, label = name.rpartition(".")
            unit = unit_sign(scene, name).strip()
            shown = (round(shown_value(scene, name, x), 9) for x in (*ends, known[name].rest))
            self.controls[name] = Control(group, f"{label} [{unit}]" if unit else label, *shown)
        for muscle in scene.muscles:
            if muscle.contraction is not None:
                name = ACTIVATION + muscle.name
                self.controls[name] = Control("Activation", muscle.name, 0.0, 1.0, 0.0)
        self.motion = [
            {n: shown_value(scene, n, x) for n, x in frame.items() if n in limits}
            for frame in scene.motion.frames
        ]

    @cached_property
    def fields(self) -> Mapping[str, BoneSDF]:
        """Distance fields of the bones in reach of a muscle within the coordinates' limits, built
        when a model first asks for them.
        """
        return build_fields(self.scene, find_contact_pairs(_wide_scene(self.scene)))

    def figure(self, choice: str) -> "LiveFigure":
        """A model of every muscle, at rest."""
        scene = self.scene if choice == self.choices[0] else self.scene.with_options(model=choice)
        return LiveFigure(scene, build_models(scene), self.fields)


class LiveFigure:
    """New models of a scene's muscles that follow coordinates and activations set by hand.

    Coordinates, ``here`` and at their ``target``, are in radian or scene unit; ``activation`` holds
    the target, 0 to 1, of the muscles that contract.
    """

    def __init__(
        self, scene: Scene, models: list[MuscleModel], fields: Mapping[str, BoneSDF]
    ) -> None:
        self.scene = scene
        self.models = models
        self._loop = FrameLoop(_wide_scene(scene), models, bone_sdfs=fields)
        self._limits = coordinate_limits(scene)
        known = all_coordinates(scene.joints)
        self._rest = {name: known[name].rest for name in self._limits}
        self.here, self.target = dict(self._rest), dict(self._rest)
        self.activation = {m.name: 0.0 for m in scene.muscles if m.contraction is not None}
        self._unfinished = True
        self._bundles = build_bundles(scene, models)
        shifts = {name for name, fact in known.items() if fact.motion == "translation"}
        #: A shift counts as the turn that moves a place at this lever as far.
        self._lever = dict.fromkeys(shifts, from_mm(SHIFT_LEVER, scene.units))
        self._reach = dict.fromkeys(shifts, from_mm(ARM_REACH, scene.units))
        meshes = {model.name: model.material_mesh() for model in models}
        self._lines = {
            muscle.name: Centreline(muscle, scene.joints, *meshes[muscle.name])
            for muscle in scene.muscles
            if sum(not held.via for held in muscle.attachments) > 1
        }
        # Coordinates and lengths of muscles in the last pictures.
        self._trail: list[tuple[dict[str, float], list[float]]] = []
        self._stride = math.radians(scene.contact.substep_angle)

    def set(self, name: str, value: float) -> None:
        """Give a control a new target, kept within its limits."""
        if name in self._limits:
            low, high = self._limits[name]
            self.target[name] = min(max(inner_value(self.scene, name, value), low), high)
        else:
            self.activation[name.removeprefix(ACTIVATION)] = min(max(value, 0.0), 1.0)

    def rest(self) -> None:
        """Put models and bones back to rest; the target stays."""
        self._loop.return_to_rest()
        self.here = dict(self._rest)
        self._trail = []
        self._unfinished = True

    @property
    def arrived(self) -> bool:
        """Whether coordinates and activations have reached their targets."""
        return self._within(1e-9, 1e-9)

    @property
    def pending(self) -> bool:
        """Whether there is something new to show."""
        return self._unfinished or not self.arrived

    @property
    def near(self) -> bool:
        """Whether the next picture shows the target."""
        return self._within(self._stride, STEP)

    def advance(self, *, coarse: bool = False) -> Picture:
        """Go one sub-step further; coarse shows the material where it is and leaves fit and cut for
        later.

        Raises SolveError if a muscle cannot be solved; `rest` goes back to rest.
        """
        self._loop.surfaces = not coarse
        active = self._loop.activations
        for name, wanted in self.activation.items():
            now = active.here[name]
            active.target[name] = now + min(max(wanted - now, -STEP), STEP)
        farthest, stop = self._farthest(), dict(self.target)
        if farthest > self._stride:
            share = self._stride / farthest
            stop = {n: here + share * (stop[n] - here) for n, here in self.here.items()}
        frame = self._loop.advance(stop)
        self.here = dict(frame.coordinates)
        self._unfinished = coarse
        surfaces = {
            n: (s.vertices, s.faces) for n, s in frame.surfaces.items()
        } or frame.material_meshes
        meshes = {m.name: tendon_mesh(m, frame.tendons) for m in self.scene.muscles}
        depths = {n: s.quantities.get("solver_penetration_max") for n, s in frame.surfaces.items()}
        return Picture(
            poses=frame.poses,
            surfaces=surfaces,
            tendons={name: mesh for name, mesh in meshes.items() if mesh is not None},
            activation=frame.activations,
            depth={name: depth for name, depth in depths.items() if depth is not None},
            text="",
            fibres={n: b.at(frame.poses, frame.tendons) for n, b in self._bundles.items()},
            moment_arms=self._moment_arms(frame),
        )

    def _within(self, stride: float, step: float) -> bool:
        """Whether no coordinate is farther than ``stride`` [radian] from its target, no activation
        than ``step``.
        """
        active = self._loop.activations.here
        return self._farthest() <= stride and all(
            abs(value - active[name]) <= step for name, value in self.activation.items()
        )

    def _farthest(self) -> float:
        """How far coordinates are from their targets, at most [radian]."""
        return max(
            (abs(x - self.here[n]) / self._lever.get(n, 1.0) for n, x in self.target.items()),
            default=0.0,
        )

    def _moment_arms(self, frame: Frame) -> dict[str, float]:
        """Moment arm of each muscle about the coordinate that moved alone to reach a frame [scene
        unit]; none where several moved.
        """
        if self._trail and self._trail[-1][0] == frame.coordinates:
            self._trail.pop()
        vertices = {name: frame.material_meshes[name][0] for name in self._lines}
        lengths = [
            line.length(vertices[name], frame.poses) + line.tendon_length(frame.tendons)
            for name, line in self._lines.items()
        ]
        self._trail = [*self._trail, (dict(frame.coordinates), lengths)][-TRAIL:]
        path, before = zip(*self._trail)
        found = moment_arms(path, before, self._reach)[-1]
        return {name: float(arm) for arms in found.values() for name, arm in zip(self._lines, arms)}


def _wide_scene(scene: Scene) -> Scene:
    """The scene with a motion that takes each coordinate to its limits."""
    known, limits = all_coordinates(scene.joints), coordinate_limits(scene)
    rest, stops = {name: known[name].rest for name in limits}, [{}]
    for name, ends in limits.items():
        stops += [{name: value} for end in ends for value in np.linspace(rest[name], end, 4)[1:]]
    wide = copy.copy(scene)
    wide.motion = Motion([rest | stop for stop in stops])
    return wide


class SavedSource:
    """Saved runs of one scene by name, scrubbed by frame; as `LiveSource`. UsageError if one holds
    no surfaces.
    """

    def __init__(self, runs: dict[str, RunData]) -> None:
        for saved in runs.values():
            if not saved.has_surfaces:
                name = saved.directory or "the run"
                raise UsageError(f"{name} has no surfaces to show; run it with output.surfaces")
        self.runs = runs
        self.choices = list(runs)
        first = next(iter(runs.values()))
        self.title = str(first.directory or first.info.scene.name)
        self.units = first.units
        self.body = first.body
        self.millimetre = from_mm(1.0, first.units)
        self.bones = {name: first.meshes.bone(name) for name in first.bones}
        self.muscles = {name: first.mesh(name, first.frame_numbers[0]) for name in first.muscles}
        self.colours, self.rest = first.colours, SavedFigure(first).advance()
        self.motion = [{"frame": float(frame)} for frame in first.frame_numbers]
        self.marks = Marks([], [], describe_doubts(first.info.doubts))
        self.controls = {
            "frame": Control("Run", "frame", *(first.frames[k].index for k in (0, -1, 0)))
        }

    def figure(self, choice: str) -> "SavedFigure":
        """A run at its first frame."""
        return SavedFigure(self.runs[choice])


class SavedFigure:
    """A saved run at one of its frames."""

    near = True

    def __init__(self, saved: RunData) -> None:
        self.saved = saved
        self.frame = saved.frame_numbers[0]
        self.pending = True

    def set(self, name: str, value: float) -> None:
        """Go to the frame nearest to a number."""
        frame = min(self.saved.frame_numbers, key=lambda known: abs(known - value))
        self.pending, self.frame = self.pending or frame != self.frame, frame

    def rest(self) -> None:
        """Nothing: a frame does not depend on those before."""

    def advance(self, *, coarse: bool = False) -> Picture:
        """Read the frame."""
        self.pending = False
        saved = self.saved
        number = self.frame
        frame = saved.frame(number)
        named = {name: tendon_name(name) for name in saved.muscles}
        return Picture(
            poses=frame.poses,
            surfaces={name: saved.mesh(name, number) for name in saved.muscles},
            tendons={
                n: saved.mesh(mesh, number) for n, mesh in named.items() if mesh in saved.tendons
            },
            activation=self._known("activation"),
            depth=self._known("penetration_max"),
            text=frame_caption(saved, number),
            fibres=dict(frame.fibres),
            moment_arms=self._known("moment_arm"),
        )

    def _known(self, quantity: str) -> dict[str, float]:
        series = {name: self.saved.series(name, quantity) for name in self.saved.muscles}
        return {
            n: float(x[k == self.frame][0])
            for n, (k, x) in series.items()
            if (k == self.frame).any()
        }
