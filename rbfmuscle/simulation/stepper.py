"""The sub-steps of one muscle: its model, its obstacles, its times and its events."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.motion import shown_value, step_angle, unit_sign
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.simulation.contact import BoneContacts, Neighbour, Planes
from rbfmuscle.simulation.frame import Event, ModelSurface, MuscleModel
from rbfmuscle.simulation.rigid_transport import (
    IDENTITY,
    MuscleStatus,
    RigidState,
    RigidTransport,
)
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.simulation.tunnelling import (
    Crossing,
    find_crossings,
    one_sided_planes,
)
from rbfmuscle.validation import NotFiniteError, SceneError, SolveError

# Depth [mm] below which a path through a bone counts as touching it.
TOUCH = 0.1
# Depth [mm] below which a muscle does not overlap a bone at rest.
OVERLAP = 0.02
# Rounds in which points that still cross at the smallest step are held by planes.
FENCES = 4
# Sub-steps are not halved below this angle [radian].
SMALLEST_STEP = math.radians(0.1)


class Path(NamedTuple):
    """A way between two sets of coordinates, and the bones' poses at its ends."""

    before: dict[str, float]
    after: dict[str, float]
    old: Poses
    new: Poses

    @classmethod
    def between(
        cls, before: dict[str, float], after: dict[str, float], poses: Callable[..., Poses]
    ) -> Path:
        """The way from coordinates to others, whose poses a function gives."""
        return cls(before, after, poses(before), poses(after))


class StepperState(NamedTuple):
    """What changes of a muscle, its obstacles and its events between sub-steps."""

    model: object
    poses: Mapping[str, Floats]
    neighbours: tuple[Planes, ...]
    beside: tuple[Neighbour, ...]  # sliding pairs, as the contacts have them
    rigid_transport: RigidState | None
    shown: ModelSurface | None
    events: dict[tuple[int, str, str], int]
    frame: int
    solves: int
    unresolved: bool


class MuscleStepper:
    """Advances one model through sub-steps, against obstacles of its own.

    ``substeps`` gives sub-steps by the relative motion of the bones that the muscle meets;
    ``rigid_transport`` moves the muscle rigidly where it need not be solved, None where it is
    always solved. ``times`` has the time spent on each stage since the last `collect` [s], ``cost``
    what was spent before that on sub-steps and on surfaces [s].
    """

    def __init__(
        self,
        model: MuscleModel,
        contacts: BoneContacts,
        scene: Scene,
        *,
        poses: Callable[[Mapping[str, float]], Poses] | None = None,
    ) -> None:
        self.model = model
        self.contacts = contacts
        self.scene = scene
        self.name = model.name
        self.poses = poses or PoseCache(scene)
        self.detect = scene.detect.tunnelling
        self.tolerance = from_mm(TOUCH, scene.units)
        self.times: dict[str, float] = defaultdict(float)
        self.cost = (0.0, 0.0)
        self.events: dict[tuple[int, str, str], int] = {}
        self.frame, self.solves = 0, 0
        self.contracts = scene.muscle(self.name).contraction is not None
        met = contacts.bones.names
        self.substeps = SubSteps(scene, scene.muscle(self.name), bones=met, poses=self.poses)
        self.rigid_transport: RigidTransport | None = None
        self._path: Path
        # The model and its contact points before the sub-step, where it may be taken back.
        self._saved: tuple[object, Floats]
        # The surface since the last solve, where later ones are that one moved rigidly.
        self._shown: ModelSurface | None = None
        # Whether points crossed a bone in this frame or the last that no step resolved: halving is
        # not tried again.
        self.unresolved = False

    def split(self, before: dict[str, float], after: dict[str, float]) -> list[dict[str, float]]:
        """Coordinates of the sub-steps to the next frame; SolveError where there are too many."""
        try:
            return self.substeps.split(before, after)
        except SceneError as error:
            raise SolveError(f"{_place(self, after)}: {error}") from None

    def advance(
        self, stops: list[dict[str, float]], activations: Sequence[Mapping[str, float]] = ()
    ) -> None:
        """Advance through a list of coordinates, the present ones first; ``activations`` by muscle
        at each end.
        """
        rigid_transport = self.rigid_transport
        for before, after, activation in itertools.zip_longest(stops[:-1], stops[1:], activations):
            if activation and self.name in activation:
                self.model.activate(activation[self.name])
            path = Path.between(before, after, self.poses)
            if rigid_transport is None or not rigid_transport.try_carry(
                self.model, self.contacts, path.old, path.new
            ):
                self.step(path)

    def step(self, path: Path) -> None:
        """One sub-step, in which no point passes through a bone."""
        self.predict(path)
        self.correct()

    def predict(self, path: Path) -> None:
        """First half of a sub-step: the bones move and the model predicts."""
        self._path = path
        self._shown = None
        if self.detect.action != "off":
            self._saved = self.model.snapshot(), self.model.contact_points().copy()
        _follow_bones(self, path)

    def correct(self) -> None:
        """Second half: the model solves, and points that passed through a bone are corrected."""
        path = self._path
        self.solve(path.after)
        self.solves += 1
        if self.detect.action != "off":
            crossings = _crossings(self, path, self._saved[1])
            if crossings:
                _correct(self, path, self._saved, crossings)

    def solve(self, coordinates: Mapping[str, float]) -> None:
        """Solve; raise SolveError with muscle, mesh, frame and coordinates where that fails or is
        not finite.
        """
        started = perf_counter()
        try:
            self.model.solve(self.contacts)
            points = self.model.contact_points()
            if not math.isfinite(points.sum()):
                bad = ~np.isfinite(points).all(axis=1)
                raise NotFiniteError(f"{int(bad.sum())} of {len(bad)} positions are not finite")
        except (np.linalg.LinAlgError, FloatingPointError, NotFiniteError) as error:
            source = self.scene.muscle(self.name).source
            raise SolveError(
                f"{_place(self, coordinates)}: {error}; look for spikes and thin triangles in "
                "its mesh"
                f"{f' ({source})' if source else ''} and remesh it, or try a smaller "
                "substep_angle in [contact]"
            ) from error
        self.times["time_solve"] += perf_counter() - started

    def surface(self) -> ModelSurface:
        """The surface of the present state: the earlier one, moved, where the muscle was not solved
        since and has no neighbours that slide.
        """
        started, rigid_transport = perf_counter(), self.rigid_transport
        shown = self._shown
        if shown is not None and not self.contacts.beside:
            drawn = shown.moved(IDENTITY if rigid_transport is None else rigid_transport.since)
        else:
            drawn = self._shown = self.model.surface(self.contacts)
            if rigid_transport is not None:
                rigid_transport.since = IDENTITY
        self.times["time_surface"] += perf_counter() - started
        return drawn

    def report(self, bone: str, count: int, action: str) -> None:
        """Record an event of the present frame; of one kind the greatest number of points is
        kept.
        """
        key = (self.frame, bone, action)
        self.events[key] = max(count, self.events.get(key, 0))

    def collect(self) -> tuple[dict[str, float], list[Event], MuscleStatus]:
        """Times, events and status since the last call."""
        times, solves = dict(self.times), self.solves
        times["time_frame"] = sum(times.values())
        drawing = times.get("time_surface", 0.0)
        self.cost = (times["time_frame"] - drawing, drawing)
        self.unresolved = any(action == "unresolved" for _, _, action in self.events)
        events = [
            Event(k, self.name, bone, n, action) for (k, bone, action), n in self.events.items()
        ]
        moved = self.rigid_transport is not None and self.rigid_transport.collect()
        self.times.clear()
        self.events = {}
        self.solves = 0
        return (
            times,
            events,
            MuscleStatus("solved" if solves else "carried" if moved else "skipped", solves),
        )

    def snapshot(self) -> StepperState:
        """The state, for :meth:`restore`; times are none of it."""
        contacts, rigid_transport = self.contacts, self.rigid_transport
        return StepperState(
            self.model.snapshot(),
            contacts.poses,
            tuple(contacts.neighbours),
            tuple(contacts.beside),
            None if rigid_transport is None else rigid_transport.snapshot(),
            self._shown,
            dict(self.events),
            self.frame,
            self.solves,
            self.unresolved,
        )

    def restore(self, state: StepperState) -> None:
        """Return to a snapshot, which stays valid."""
        self.model.restore(state.model)
        self.contacts.move(state.poses)
        self.contacts.neighbours = list(state.neighbours)
        self.contacts.beside = list(state.beside)
        if self.rigid_transport is not None and state.rigid_transport is not None:
            self.rigid_transport.restore(state.rigid_transport)
        self._shown = state.shown
        self.events = dict(state.events)
        self.frame = state.frame
        self.solves = state.solves
        self.unresolved = state.unresolved


def keep_initial_overlap(stepper: MuscleStepper) -> None:
    """Take what overlaps bones at rest, as these come from other sources than the muscle, for the
    zero of the contact there; SceneError where the scene's ``[contact] initial`` is ``"error"``.
    """
    contacts, scene = stepper.contacts, stepper.scene
    free = contacts.free
    points = stepper.model.contact_points()[free]
    for row, (bone, field) in enumerate(zip(contacts.bones.names, contacts.bones.fields)):
        depth = np.zeros(len(free))
        depth[free] = np.maximum(-field.distance(points, contacts.placed[row], reach=0.0), 0.0)
        deep = depth > from_mm(OVERLAP, scene.units)
        if not deep.any():
            continue
        if scene.contact.initial == "error":
            raise SceneError(
                f"muscle {stepper.name!r} overlaps bone {bone!r} at rest: {int(deep.sum())} "
                f"points, {depth.max():.3g} {scene.units} deep; set [contact] initial to 'keep'"
            )
        contacts.allow(row, depth)
        stepper.report(bone, int(deep.sum()), "overlap_kept")


def _follow_bones(stepper: MuscleStepper, path: Path) -> None:
    """Move the bones, and let the model predict."""
    started = perf_counter()
    stepper.contacts.move(path.new)
    stepper.model.predict(path.old, path.new)
    stepper.times["time_predict"] += perf_counter() - started


def _crossings(
    stepper: MuscleStepper, path: Path, start: Floats, *, flag: bool = True
) -> list[Crossing]:
    """What crossed a bone on the way from contact points (n, 3) to the present ones."""
    started, contacts = perf_counter(), stepper.contacts
    found = find_crossings(
        contacts,
        start,
        stepper.model.contact_points(),
        path.old,
        path.new,
        stepper.detect,
        tolerance=stepper.tolerance,
    )
    stepper.times["time_tunnelling"] += perf_counter() - started
    crossings = []
    for crossing in found:
        if flag and crossing.flagged:
            stepper.report(contacts.bones.names[crossing.bone], crossing.flagged, "angle_flag")
        if len(crossing.index):
            crossings.append(crossing)
    return crossings


def _correct(
    stepper: MuscleStepper,
    path: Path,
    saved: tuple[object, Floats],
    crossings: Sequence[Crossing],
) -> None:
    """Halve the step, down to the smallest, and then hold points on their side by planes."""
    state = saved[0]
    if stepper.detect.action == "report":
        _report_all(stepper, crossings, "reported")
        return
    if step_angle(stepper.scene, path.before, path.after) > 2.0 * SMALLEST_STEP and (
        not stepper.unresolved
    ):
        _report_all(stepper, crossings, "halved")
        stepper.model.restore(state)
        middle = interpolate(path.before, path.after, 0.5)
        stepper.step(Path.between(path.before, middle, stepper.poses))
        stepper.step(Path.between(middle, path.after, stepper.poses))
        return
    for crossing in _held_back(stepper, path, saved, crossings):
        name = stepper.contacts.bones.names[crossing.bone]
        stepper.report(name, len(crossing.index), "unresolved")
        stepper.unresolved = True


def _held_back(
    stepper: MuscleStepper,
    path: Path,
    saved: tuple[object, Floats],
    crossings: Sequence[Crossing],
) -> Sequence[Crossing]:
    """Solve with crossing points held on their side by planes; return what crosses all the
    same.
    """
    contacts, (state, start) = stepper.contacts, saved
    neighbours = contacts.neighbours
    fenced = [*neighbours]
    try:
        for _ in range(FENCES):
            fenced += [
                one_sided_planes(contacts, crossing, start, path.old, path.new)
                for crossing in crossings
            ]
            contacts.neighbours = fenced
            stepper.model.restore(state)
            _follow_bones(stepper, path)
            stepper.solve(path.after)
            held, crossings = crossings, _crossings(stepper, path, start, flag=False)
            _report_all(stepper, held, "held_back")
            if not crossings:
                break
    finally:
        contacts.neighbours = neighbours
    return crossings


def _report_all(stepper: MuscleStepper, crossings: Sequence[Crossing], action: str) -> None:
    for crossing in crossings:
        name = stepper.contacts.bones.names[crossing.bone]
        stepper.report(name, len(crossing.index), action)


def _place(stepper: MuscleStepper, coordinates: Mapping[str, float]) -> str:
    """Muscle, frame and coordinates, for messages."""
    scene = stepper.scene
    where = ", ".join(
        f"{name} = "
        f"{shown_value(scene, name, value):.6g}{unit_sign(scene, name).replace('°', ' deg')}"
        for name, value in coordinates.items()
    )
    return f"muscle {stepper.name!r}, frame {stepper.frame} ({where or 'rest'})"
