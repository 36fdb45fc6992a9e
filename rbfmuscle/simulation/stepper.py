"""The sub-steps of one muscle: its model, its obstacles, its times and its events."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.motion import shown_value, step_angle, unit_sign
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.simulation.contact import BoneContacts, Neighbour, Planes
from rbfmuscle.simulation.frame import Event, ModelSurface, MuscleModel
from rbfmuscle.simulation.rigid_transport import MuscleStatus, RigidState, RigidTransport
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.simulation.tunnelling import (
    find_crossings,
    one_sided_planes,
    only_grazed,
)
from rbfmuscle.validation import NotFiniteError, SceneError, SolveError

# Depth [mm] below which a path through a bone counts as touching it; above the error of a bone's
# field.
TOUCH = 0.1
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


class StepperState(NamedTuple):
    """What changes of a muscle, its obstacles and its events between sub-steps."""

    model: object
    poses: dict[str, Floats]
    neighbours: tuple[Planes, ...]
    beside: tuple[Neighbour, ...]  # sliding pairs, as the contacts have them
    rigid_transport: RigidState | None
    shown: ModelSurface | None
    events: dict[tuple[int, str, str], int]
    frame: int
    solves: int
    unresolved: bool


class _Stage:
    """Adds the time spent inside to an entry of ``times`` [s]."""

    def __init__(self, times: dict[str, float], key: str) -> None:
        self.times, self.key = times, key

    def __enter__(self) -> None:
        self.start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        spent = time.perf_counter() - self.start
        self.times[self.key] = self.times.get(self.key, 0.0) + spent


class MuscleStepper:
    """Advances one model through sub-steps, against obstacles of its own.

    ``substeps`` gives sub-steps by the relative motion of the bones that the muscle meets;
    ``rigid_transport`` moves the muscle rigidly where it need not be solved, None where it is
    always solved.
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
        self.detect = scene.detect.tunnelling if scene.detect is not None else None
        self.tolerance = scene.length(TOUCH)
        self.times: dict[str, float] = {}
        self.events: dict[tuple[int, str, str], int] = {}
        self.frame, self.solves = 0, 0
        self.contracts = scene.muscle(self.name).contraction is not None
        met = [contacts.names[b] for b in contacts.reached]
        self.substeps = SubSteps(scene, scene.muscle(self.name), bones=met, poses=self.poses)
        self.rigid_transport: RigidTransport | None = None
        self._path: Path
        # The model and its contact points before the sub-step, where it may be taken back.
        self._saved: tuple[object, Floats]
        # The surface since the last solve, where later ones are that one moved rigidly.
        self._shown: ModelSurface | None = None
        # Whether points crossed a bone in this frame or the last that no step resolved: halving is
        # not tried again.
        self._unresolved = False

    def timed(self, stage: str) -> _Stage:
        """Add the time spent inside to ``time_<stage>``."""
        return _Stage(self.times, f"time_{stage}")

    def split(self, before: dict[str, float], after: dict[str, float]) -> list[dict[str, float]]:
        """Coordinates of the sub-steps to the next frame; SolveError where there are too many."""
        try:
            return self.substeps.split(before, after)
        except SceneError as error:
            raise SolveError(f"{self._place(after)}: {error}") from None

    def advance(
        self, stops: list[dict[str, float]], activations: Sequence[Mapping[str, float]] = ()
    ) -> MuscleStepper:
        """Advance through a list of coordinates, the present ones first; ``activations`` by muscle
        at each end.
        """
        for before, after, activation in itertools.zip_longest(stops[:-1], stops[1:], activations):
            self.set_activation(activation or {})
            path = self.path(before, after)
            if self.rigid_transport is None or not self.rigid_transport.try_carry(
                self.model, self.contacts, path.old, path.new
            ):
                self.step(path)
        return self

    def path(self, before: dict[str, float], after: dict[str, float]) -> Path:
        """A way from coordinates to others."""
        return Path(before, after, self.poses(before), self.poses(after))

    def set_activation(self, activation: Mapping[str, float]) -> None:
        """Set the model's activation from a dict by muscle, where it is in there."""
        if self.name in activation:
            self.model.activate(activation[self.name])

    def step(self, path: Path) -> None:
        """One sub-step, with the tunnelling test where the scene has one."""
        self.predict(path)
        self.correct()

    def predict(self, path: Path) -> None:
        """First half of a sub-step: the bones move and the model predicts."""
        self._path = path
        self._shown = None
        if self.detect is not None:
            self._saved = self.model.snapshot(), self.model.contact_points().copy()
        self._predict()

    def correct(self) -> None:
        """Second half: the model solves, and points that passed through a bone are corrected."""
        path = self._path
        self.solve(path.after)
        self.solves += 1
        if self.detect is not None:
            crossings = self._crossings(path, self._saved[1])
            if crossings:
                self._correct(path, crossings)
        if self.rigid_transport is not None:
            self.rigid_transport.solved = path.new

    def solve(self, coordinates: Mapping[str, float]) -> None:
        """Solve; raise SolveError with muscle, mesh, frame and coordinates where that fails or is
        not finite.
        """
        try:
            with self.timed("solve"):
                self.model.solve(self.contacts)
            points = self.model.contact_points()
            if not math.isfinite(points.sum()):
                bad = ~np.isfinite(points).all(axis=1)
                raise NotFiniteError(f"{int(bad.sum())} of {len(bad)} positions are not finite")
        except (np.linalg.LinAlgError, FloatingPointError, NotFiniteError) as error:
            source = self.scene.muscle(self.name).source
            raise SolveError(
                f"{self._place(coordinates)}: {error}; look for spikes and thin triangles in "
                "its mesh"
                f"{f' ({source})' if source else ''} and remesh it, or try a smaller "
                "substep_angle in [contact]"
            ) from error

    def surface(self) -> ModelSurface:
        """The surface of the present state: the earlier one, moved, where the muscle was not solved
        since and has no neighbours that slide.
        """
        rigid_transport = self.rigid_transport
        with self.timed("surface"):
            if self._shown is not None and not self.contacts.beside:
                return self._shown.moved(
                    np.eye(4) if rigid_transport is None else rigid_transport.since
                )
            self._shown = self.model.surface(self.contacts)
        if rigid_transport is not None:
            rigid_transport.since = np.eye(4)
        return self._shown

    def report(self, bone: str, count: int, action: str) -> None:
        """Record an event of the present frame; of one kind the greatest number of points is
        kept.
        """
        key = (self.frame, bone, action)
        self.events[key] = max(count, self.events.get(key, 0))

    def collect(self) -> tuple[dict[str, float], list[Event], MuscleStatus]:
        """Times, events and status since the last call."""
        times, solves = self.times, self.solves
        times["time_frame"] = sum(times.values())
        self._unresolved = any(action == "unresolved" for _, _, action in self.events)
        events = [
            Event(k, self.name, bone, n, action) for (k, bone, action), n in self.events.items()
        ]
        moved = self.rigid_transport is not None and self.rigid_transport.collect()
        self.times = {}
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
            self._unresolved,
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
        self._unresolved = state.unresolved

    def _predict(self):
        path = self._path
        with self.timed("predict"):
            self.contacts.move(path.new)
            self.model.predict(path.old, path.new)

    def _crossings(self, path, start, *, flag=True):
        """What crossed a bone on the way from contact points (n, 3) to the present ones."""
        with self.timed("tunnelling"):
            end = self.model.contact_points()
            found = find_crossings(
                self.contacts, start, end, *path[2:], self.detect, tolerance=self.tolerance
            )
        for crossing in found:
            if flag and crossing.flagged:
                self.report(self.contacts.names[crossing.bone], crossing.flagged, "angle_flag")
        return [crossing for crossing in found if len(crossing.index)]

    def _correct(self, path, crossings):
        """Halve the step, down to the smallest, and then hold points on their side by planes."""
        if self.detect.action == "report":
            self._report_all(crossings, "reported")
            return
        state, start = self._saved
        if step_angle(self.scene, path.before, path.after) > 2.0 * SMALLEST_STEP and (
            not self._unresolved
        ):
            self._report_all(crossings, "halved")
            self.model.restore(state)
            middle = interpolate(path.before, path.after, 0.5)
            self.step(self.path(path.before, middle))
            self.step(self.path(middle, path.after))
            return
        for crossing in self._held_back(path, state, start, crossings):
            name = self.contacts.names[crossing.bone]
            paths, ends = (start, self.model.contact_points()), (path.old[name], path.new[name])
            mesh = self.scene.bone(name).mesh
            touched = only_grazed(crossing, mesh, paths, *ends, self.tolerance)
            self.report(name, len(crossing.index), "grazed" if touched else "unresolved")
            self._unresolved |= not touched

    def _held_back(self, path, state, start, crossings):
        """Solve with crossing points held on their side by planes; return what crosses all the
        same.
        """
        neighbours = self.contacts.neighbours
        fenced = [*neighbours]
        self._path = path
        try:
            for _ in range(FENCES):
                fenced += [
                    one_sided_planes(self.contacts, crossing, start, path.old, path.new)
                    for crossing in crossings
                ]
                self.contacts.neighbours = fenced
                self.model.restore(state)
                self._predict()
                self.solve(path.after)
                held, crossings = crossings, self._crossings(path, start, flag=False)
                self._report_all(held, "held_back")
                if not crossings:
                    break
        finally:
            self.contacts.neighbours = neighbours
        return crossings

    def _report_all(self, crossings, action):
        for crossing in crossings:
            self.report(self.contacts.names[crossing.bone], len(crossing.index), action)

    def _place(self, coordinates):
        scene = self.scene
        where = ", ".join(
            f"{name} = "
            f"{shown_value(scene, name, value):.6g}{unit_sign(scene, name).replace('°', ' deg')}"
            for name, value in coordinates.items()
        )
        return f"muscle {self.name!r}, frame {self.frame} ({where or 'rest'})"
