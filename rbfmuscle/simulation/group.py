"""Muscles that are solved together, as they may touch: sub-steps in which none passes through a
bone.

Most groups are one muscle. A muscle alone that need not be solved is moved rigidly with its bones.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.motion import step_angle
from rbfmuscle.simulation.contact import NO_FENCES, Fences
from rbfmuscle.simulation.neighbours import Link, Neighbours, NeighbourState
from rbfmuscle.simulation.stepper import MuscleStepper, Path
from rbfmuscle.simulation.substeps import Coordinates
from rbfmuscle.simulation.touching import settle
from rbfmuscle.simulation.tunnelling import Crossing, one_sided_planes
from rbfmuscle.validation import NotFiniteError, SolveError

# Rounds in which points that still cross at the smallest step are held by planes.
FENCES = 4
# Sub-steps are not halved below this angle [radian].
SMALLEST_STEP = math.radians(0.1)
FAILURES = np.linalg.LinAlgError, FloatingPointError, NotFiniteError


class Saved(NamedTuple):
    """What a sub-step is taken back to: the models' states, their contact points (n, 3) and what is
    between them.
    """

    models: list[object]
    points: list[Floats]
    neighbours: NeighbourState


class Group:
    """Muscles that are solved together.

    Parameters
    ----------
    steppers : list of MuscleStepper
        In their rest state.
    links : sequence of (int, int), optional
        Which of them may touch which, by number.
    """

    def __init__(self, steppers: Sequence[MuscleStepper], links: Sequence[Link] = ()) -> None:
        self.steppers = list(steppers)
        self.scene = self.steppers[0].scene
        #: Whether a muscle of the group contracts.
        self.contracts = any(stepper.contracts for stepper in self.steppers)
        self.detects = self.scene.detect.tunnelling.action
        self.neighbours = Neighbours(self.steppers, links)
        for number, stepper in enumerate(self.steppers if links else ()):
            stepper.contacts.out_of_neighbours = partial(self.neighbours.out_of_neighbours, number)

    def split(self, before: Coordinates, after: Coordinates) -> list[Coordinates]:
        """Coordinates of the sub-steps to the next frame: as many as the muscle asks for that needs
        most; SolveError where there are too many.
        """
        return max((stepper.split(before, after) for stepper in self.steppers), key=len)

    def advance(
        self, stops: Sequence[Coordinates], activations: Sequence[Mapping[str, float]] = ()
    ) -> None:
        """Advance through coordinates, the present ones first; ``activations`` by muscle at the end
        of each sub-step.
        """
        first = self.steppers[0]
        # One that slides on neighbours or contracts is always solved.
        may_be_carried = len(self.steppers) == 1 and not self.contracts
        for before, after, activation in itertools.zip_longest(stops[:-1], stops[1:], activations):
            for stepper in self.steppers:
                if activation and stepper.name in activation:
                    stepper.model.activate(activation[stepper.name])
            path = Path.between(before, after, first.poses)
            carried = may_be_carried and first.rigid_transport.try_carry(
                first.model, first.contacts, path.old, path.new
            )
            if not carried:
                self.step(path)

    def step(self, path: Path) -> None:
        """One sub-step, in which no point passes through a bone."""
        if self.detects == "off":
            self._follow(path)
            return
        models = [stepper.model for stepper in self.steppers]
        saved = Saved(
            [model.snapshot() for model in models],
            [model.contact_points().copy() for model in models],
            self.neighbours.state,
        )
        self._follow(path)
        crossings = [
            stepper.crossings(path, start) for stepper, start in zip(self.steppers, saved.points)
        ]
        if any(crossings):
            self._correct(path, saved, crossings)

    def solve(self, coordinates: Mapping[str, float]) -> None:
        """Bring the muscles to rest at the present poses; SolveError with muscle, mesh, frame and
        coordinates where that fails or is not finite.
        """
        started = perf_counter()
        solids = []
        for stepper in self.steppers:
            try:
                solids.append(stepper.model.begin(stepper.contacts))
            except FAILURES as error:
                raise _failure(stepper, coordinates, error) from error
        bodies = [*solids, *self.neighbours.bones]
        meeting = self.neighbours.find(bodies)
        try:
            settle(bodies, meeting)
        except FAILURES as error:
            lost = [not np.isfinite(solid.step).all() for solid in solids]
            raise _failure(self.steppers[int(np.argmax(lost))], coordinates, error) from error
        self.neighbours.keep(meeting, bodies)
        for stepper, solid in zip(self.steppers, solids):
            try:
                stepper.model.take(solid)
                points = stepper.model.contact_points()
                if not math.isfinite(points.sum()):
                    bad = ~np.isfinite(points).all(axis=1)
                    raise NotFiniteError(f"{int(bad.sum())} of {len(bad)} positions are not finite")
            except FAILURES as error:
                raise _failure(stepper, coordinates, error) from error
        elapsed = perf_counter() - started
        total = sum(solid.iterations for solid in solids)
        for stepper, solid in zip(self.steppers, solids):
            stepper.times["time_solve"] += elapsed * solid.iterations / total
            stepper.solves += 1

    def _take_back(self, saved: Saved) -> None:
        for stepper, state in zip(self.steppers, saved.models):
            stepper.model.restore(state)
        self.neighbours.state = saved.neighbours

    def _follow(self, path: Path) -> None:
        """Predict and solve."""
        each(lambda stepper: stepper.follow(path), self.steppers)
        self.solve(path.after)

    def _correct(self, path: Path, saved: Saved, crossings: Sequence[Sequence[Crossing]]) -> None:
        """Halve the step, down to the smallest, and then hold points on their side by planes."""
        crossed = [(s, found) for s, found in zip(self.steppers, crossings) if found]
        if self.detects == "report":
            for stepper, found in crossed:
                stepper.report_all(found, "reported")
            return
        large = step_angle(self.scene, path.before, path.after) > 2.0 * SMALLEST_STEP
        if large and any(not stepper.unresolved for stepper, _ in crossed):
            for stepper, found in crossed:
                stepper.report_all(found, "halved")
            self._take_back(saved)
            middle = interpolate(path.before, path.after, 0.5)
            self.step(Path.between(path.before, middle, self.steppers[0].poses))
            self.step(Path.between(middle, path.after, self.steppers[0].poses))
            return
        for stepper, found in zip(self.steppers, self._held_back(path, saved, crossings)):
            stepper.report_all(found, "unresolved")
            stepper.unresolved |= len(found) > 0

    def _held_back(
        self, path: Path, saved: Saved, crossings: Sequence[Sequence[Crossing]]
    ) -> Sequence[Sequence[Crossing]]:
        """Solve with crossing points held on their side by planes; return what crosses all the
        same.
        """
        try:
            for _ in range(FENCES):
                for stepper, found, start in zip(self.steppers, crossings, saved.points):
                    contacts = stepper.contacts
                    planes = [
                        one_sided_planes(contacts, crossing, start, path.old, path.new)
                        for crossing in found
                    ]
                    parts = zip(contacts.fences, *planes)
                    contacts.fences = Fences(*map(np.concatenate, parts))
                self._take_back(saved)
                self._follow(path)
                for stepper, found in zip(self.steppers, crossings):
                    stepper.report_all(found, "held_back")
                crossings = [
                    stepper.crossings(path, start, flag=False)
                    for stepper, start in zip(self.steppers, saved.points)
                ]
                if not any(crossings):
                    break
        finally:
            for stepper in self.steppers:
                stepper.contacts.fences = NO_FENCES
        return crossings


def _failure(
    stepper: MuscleStepper, coordinates: Mapping[str, float], error: Exception
) -> SolveError:
    source = stepper.scene.muscle(stepper.name).source
    return SolveError(
        f"{stepper.place(coordinates)}: {error}; look for spikes and thin triangles in its mesh"
        f"{f' ({source})' if source else ''} and remesh it, or try a smaller substep_angle in "
        "[contact]"
    )
