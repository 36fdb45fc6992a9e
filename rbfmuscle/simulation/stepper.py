"""One muscle in motion: its model, its obstacles, its times and its events."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.motion import shown_value, unit_sign
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import AT_REST, Poses
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import Event, ModelSurface, MuscleModel
from rbfmuscle.simulation.rigid_transport import (
    IDENTITY,
    NEVER_SOLVED,
    MuscleStatus,
    RigidTransport,
)
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.simulation.tunnelling import Crossing, find_crossings
from rbfmuscle.validation import SceneError, SolveError

# Depth [mm] below which a path through a bone counts as touching it.
TOUCH = 0.1
# Depth [mm] below which a muscle does not overlap a bone at rest.
OVERLAP = 0.02


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


class MuscleStepper:
    """One model among obstacles of its own, which a `Group` takes through sub-steps.

    ``substeps`` gives sub-steps by the relative motion of the bones that the muscle meets;
    ``rigid_transport`` moves the muscle rigidly where it need not be solved. ``times`` has the time
    spent on each stage since the last `collect` [s], ``cost`` what was spent before that on
    sub-steps and on surfaces [s].
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
        self.times: dict[str, float] = defaultdict(float)
        self.cost = (0.0, 0.0)
        self.events: dict[tuple[int, str, str], int] = {}
        self.frame, self.solves = 0, 0
        muscle, met = scene.muscle(self.name), contacts.bones.names
        self.contracts = muscle.contraction is not None
        self.substeps = SubSteps(scene, muscle, bones=met, poses=self.poses)
        self.rigid_transport = RigidTransport(muscle, scene)
        # The surface since the last solve, where later ones are that one moved rigidly.
        self._shown: ModelSurface | None = None
        # Whether points crossed a bone in this frame or the last that no step resolved: halving is
        # not tried again.
        self.unresolved = False
        self._rest = model.snapshot()

    def split(self, before: dict[str, float], after: dict[str, float]) -> list[dict[str, float]]:
        """Coordinates of the sub-steps to the next frame; SolveError where there are too many."""
        try:
            return self.substeps.split(before, after)
        except SceneError as error:
            raise SolveError(f"{self.place(after)}: {error}") from None

    def follow(self, path: Path) -> None:
        """Move the bones, and let the model predict."""
        started = perf_counter()
        self._shown = None
        self.contacts.move(path.new)
        self.model.predict(path.old, path.new)
        self.times["time_predict"] += perf_counter() - started

    def crossings(self, path: Path, start: Floats, *, flag: bool = True) -> list[Crossing]:
        """What crossed a bone on the way from contact points (n, 3) to the present ones."""
        started, contacts = perf_counter(), self.contacts
        found = find_crossings(
            contacts,
            start,
            self.model.contact_points(),
            path.old,
            path.new,
            self.scene.detect.tunnelling,
            tolerance=from_mm(TOUCH, self.scene.units),
        )
        self.times["time_tunnelling"] += perf_counter() - started
        crossings = []
        for crossing in found:
            if flag and crossing.flagged:
                self.report(contacts.bones.names[crossing.bone], crossing.flagged, "angle_flag")
            if len(crossing.index):
                crossings.append(crossing)
        return crossings

    def surface(self) -> ModelSurface:
        """The surface of the present state: the earlier one, moved, where the muscle was not solved
        since.
        """
        started, rigid_transport = perf_counter(), self.rigid_transport
        shown = self._shown
        if shown is not None:
            drawn = shown.moved(rigid_transport.state.since)
        else:
            drawn = self._shown = self.model.surface(self.contacts)
            rigid_transport.state = rigid_transport.state._replace(since=IDENTITY)
        self.times["time_surface"] += perf_counter() - started
        return drawn

    def report_all(self, crossings: Sequence[Crossing], action: str) -> None:
        """Record crossings as events of the present frame."""
        for crossing in crossings:
            self.report(self.contacts.bones.names[crossing.bone], len(crossing.index), action)

    def place(self, coordinates: Mapping[str, float]) -> str:
        """Muscle, frame and coordinates, for messages."""
        where = ", ".join(
            f"{name} = {shown_value(self.scene, name, value):.6g}"
            f"{unit_sign(self.scene, name).replace('°', ' deg')}"
            for name, value in coordinates.items()
        )
        return f"muscle {self.name!r}, frame {self.frame} ({where or 'rest'})"

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
        moved = self.rigid_transport.state.moved
        self.rigid_transport.state = self.rigid_transport.state._replace(moved=False)
        self.times.clear()
        self.events = {}
        self.solves = 0
        return (
            times,
            events,
            MuscleStatus("solved" if solves else "carried" if moved else "skipped", solves),
        )

    def return_to_rest(self) -> None:
        """Return to the state before the first sub-step; times stay."""
        self.model.restore(self._rest)
        self.contacts.move(AT_REST)
        self.rigid_transport.state = NEVER_SOLVED
        self._shown = None
        self.events = {}
        self.frame, self.solves = 0, 0
        self.unresolved = False


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
        contacts.allowed[row] = depth
        stepper.report(bone, int(deep.sum()), "overlap_kept")
