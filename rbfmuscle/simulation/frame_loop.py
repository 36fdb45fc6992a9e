"""The frame loop: any muscle model against any bones."""

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.scene.activation.curve import Activations
from rbfmuscle.scene.motion import completed, rest_coordinates
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.coupled_stepper import CoupledStepper
from rbfmuscle.simulation.frame import Event, FinishedDrawing, Frame, ModelSurface, MuscleModel
from rbfmuscle.simulation.overlap import resolve_initial_overlap
from rbfmuscle.simulation.plan.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.rigid_transport import RigidTransport
from rbfmuscle.simulation.stepper import MuscleStepper, TimedDrawing
from rbfmuscle.simulation.substeps import PoseCache, SubSteps
from rbfmuscle.simulation.workers import Workers

__all__ = [
    "Event",
    "FinishedDrawing",
    "Frame",
    "FrameLoop",
    "ModelSurface",
    "MuscleModel",
    "simulate_frames",
]


class FrameLoop:
    """Moves muscles with the bones, one frame at a time, from the rest pose on.

    Call `advance` for each frame. Close the loop, or use it in a ``with`` block: it holds threads.

    Parameters
    ----------
    scene : Scene
        Its motion only determines which bones and neighbours a muscle can meet.
    models : sequence of MuscleModel, or mapping of str to MuscleModel
        In their rest state.
    fields : mapping of str to BoneSDF, optional
        Distance fields of the bones; built for the bones in reach where not given.
    surfaces : bool
        Whether surfaces are extracted.

    Attributes
    ----------
    here : dict of str to float
        Present coordinates [radian]; empty before the first frame.
    activations : Activations
        Of the muscles that contract.

    Raises
    ------
    SceneError
        If muscles overlap bones at rest and the scene's ``initial`` is ``"error"``.
    SolveError
        If an overlap at rest cannot be solved.
    """

    def __init__(
        self,
        scene: Scene,
        models: Sequence[MuscleModel] | Mapping[str, MuscleModel],
        *,
        fields: Mapping[str, BoneField] | None = None,
        surfaces: bool = True,
    ) -> None:
        models = list(models.values()) if isinstance(models, Mapping) else list(models)
        self.scene, self.surfaces, self._poses = scene, surfaces, PoseCache(scene)
        self.steppers = [
            MuscleStepper(model, contacts, scene, poses=self._poses)
            for model, contacts in zip(models, _obstacles(scene, models, fields))
        ]
        self.here: dict[str, float] = {}
        self.activations = Activations(scene)
        self._sub_steps, self._own_sub_steps = SubSteps(scene, poses=self._poses), {}
        for stepper in self.steppers:
            carrier = stepper.carrier = RigidTransport(stepper, scene)
            if not carrier.never:
                self._own_sub_steps[stepper.name] = self._cut_for(carrier)
        self._next_index, self._wall = 0, 0.0
        self._pairs: dict[tuple[str, str], tuple[float, float]] = {}
        self.workers = Workers(len(self.steppers))
        try:
            with self.clocked(), self.workers.one_thread_each():
                self.workers.each(resolve_initial_overlap, self.steppers)
                self._sliding = _sliding(scene, self.steppers)
                self._together = self._side_by_side()
        except BaseException:
            self.close()
            raise

    def advance(self, coordinates: Mapping[str, float]) -> Frame:
        """Advance to the given coordinates and return the frame.

        Parameters
        ----------
        coordinates : mapping of str to float
            Target coordinates [radian]; absent ones are at rest.

        Returns
        -------
        Frame

        Raises
        ------
        SolveError
            If a muscle cannot be solved, naming muscle, frame and coordinates.
        """
        with self.clocked(), self.workers.one_thread_each():
            paths = self._path_to(coordinates)
            if self.surfaces and self._sliding is None and self.workers.parallel:
                # No muscle waits for another: each thread takes one through all its sub-steps.
                drawn = self.workers.each(
                    lambda stepper: stepper.go(*paths[stepper.name]).draw(), self.steppers
                )
            else:
                self._solve(paths)
                drawings = self._drawings() if self.surfaces else []
                drawn = self.workers.each(TimedDrawing.draw, drawings)
            frame = self.collect()
        return self.finish(frame, drawn)

    def skip(self, coordinates: Mapping[str, float]) -> None:
        """Advance without surfaces; times and events are counted to the next frame that is returned."""
        with self.clocked(), self.workers.one_thread_each():
            self._solve(self._path_to(coordinates))

    def collect(self) -> Frame:
        """The present frame, without surfaces."""
        carried = {stepper.name: stepper.model.material_mesh() for stepper in self.steppers}
        times, events = {}, []
        for stepper in self.steppers:
            times[stepper.name], happened = stepper.collect()
            events.extend(happened)
        poses = self._poses(self.here)
        solved = [muscle for muscle in self.scene.muscles if muscle.name in carried]
        for end in (end for muscle in solved for end in muscle.tendons):
            poses[end.name]  # the pose of an end is computed, and kept, when it is first asked for
        frame = Frame(self._next_index - 1, dict(self.here), dict(poses), {}, carried, events, times, 0.0)
        frame.tendons.update(poses.tendons)
        frame.activations.update(self.activations.here)
        frame.neighbours.update(self._pairs)
        frame.work.update({stepper.name: stepper.work for stepper in self.steppers})
        return frame

    def finish(self, frame: Frame, drawn: Iterable[tuple[ModelSurface, float]]) -> Frame:
        """Add surfaces and the time since the last frame."""
        surfaces = {}
        for name, (surface, seconds) in zip(frame.carried, drawn):
            surfaces[name] = surface
            frame.events.extend(Event(frame.index, name, *note) for note in surface.notes)
            for key in ("time_surface", "time_frame"):
                frame.times[name][key] = frame.times[name].get(key, 0.0) + seconds
        frame.surfaces, frame.wall, self._wall = surfaces, self._wall, 0.0
        return frame

    @contextmanager
    def clocked(self) -> Iterator[None]:
        """Count the time spent inside to the next frame."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._wall += time.perf_counter() - start

    def close(self) -> None:
        """End the threads."""
        self.workers.close()

    def __enter__(self) -> "FrameLoop":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _cut_for(self, carrier: RigidTransport) -> SubSteps:
        """Sub-steps of one muscle, by the relative motion of the bones that hold it or that it can meet."""
        contacts = carrier.stepper.contacts
        met = [contacts.names[b] for b in contacts.reached]
        return SubSteps(self.scene, carrier.muscle, bones=met, poses=self._poses)

    def _side_by_side(self) -> CoupledStepper | None:
        """The stepper of muscles that slide, None without sliding; muscles that contract take every sub-step."""
        if self._sliding is None:
            return None
        contract = {muscle.name for muscle in self.scene.muscles if muscle.contraction is not None}
        carriers = [stepper.carrier for stepper in self.steppers if stepper.name not in contract]
        cuts = {carrier.stepper.name: self._cut_for(carrier) for carrier in carriers if carrier is not None}
        return CoupledStepper(self.steppers, self._sliding, cuts)

    def _path_to(self, coordinates: Mapping[str, float]) -> dict[str, tuple[list[dict], list[dict]]]:
        """For each muscle the coordinates and the activations of its sub-steps to the next frame."""
        # Coordinates start at rest, which is zero for most.
        here = self.here or dict.fromkeys(coordinates, 0.0) | rest_coordinates(self.scene)
        self.here = completed(self.scene, coordinates)
        for stepper in self.steppers:
            stepper.frame = self._next_index
        self._next_index += 1
        found = {name: ([here, *cut.split(here, self.here)], []) for name, cut in self._own_sub_steps.items()}
        if len(found) < len(self.steppers):
            # Muscles that slide share the sub-steps of the muscle that has the most.
            stops = [here, *self._sub_steps.split(here, self.here)]
            shared = self.activations.refine(self._next_index - 1, stops)
            found.update({s.name: shared for s in self.steppers if s.name not in found})
        return found

    def _solve(self, paths: dict[str, tuple[list[dict], list[dict]]]) -> None:
        """Advance all muscles through their sub-steps."""
        if self._together is None:
            self.workers.each(lambda stepper: stepper.advance(*paths[stepper.name]), self.steppers)
            return
        stops, activations = paths[self.steppers[0].name]
        self._together.go(stops, activations, self.workers)

    def _drawings(self) -> list[TimedDrawing]:
        """Drawings of all muscles in their present state."""
        if self._sliding is not None:
            self.workers.each(self._sliding.refresh, self.steppers)
            for stepper, found in zip(self.steppers, self.workers.each(self._sliding.measure, self.steppers)):
                stepper.measured = found
            self._pairs = self._sliding.pairs()
        drawings = [stepper.drawing() for stepper in self.steppers]
        if self._sliding is not None:
            self.workers.each(self._sliding.show, drawings)
        return drawings


def simulate_frames(
    scene: Scene,
    models: Sequence[MuscleModel] | Mapping[str, MuscleModel],
    *,
    surfaces: bool = True,
    written: Collection[int] | None = None,
    fields: Mapping[str, BoneField] | None = None,
) -> Iterator[Frame]:
    """Run models through a scene's motion, from the rest pose on, and yield its frames one by one.

    Frames yielded before an interrupt or a ``SolveError`` stay valid.

    Parameters
    ----------
    scene : Scene
    models, surfaces, fields
        As for `FrameLoop`.
    written : collection of int, optional
        Indices of the frames to yield; all where not given. The others are simulated and not shown.

    Raises
    ------
    SolveError
        If a muscle cannot be solved, naming muscle, frame and coordinates.
    SceneError
        If muscles overlap bones at rest and the scene's ``initial`` is ``"error"``.
    """
    with FrameLoop(scene, models, fields=fields, surfaces=surfaces) as loop:
        for index, coordinates in enumerate(scene.motion.frames):
            if written is None or index in written:
                yield loop.advance(coordinates)
            else:
                loop.skip(coordinates)


def solve_pose(
    scene: Scene,
    models: Sequence[MuscleModel],
    coordinates: Mapping[str, float],
    *,
    fields: Mapping[str, BoneField] | None = None,
) -> Frame:
    """Solve one pose straight from rest, so that the shapes depend on the pose alone.

    Parameters
    ----------
    scene : Scene
    models : sequence of MuscleModel
        In their rest state, to which they return.
    coordinates : mapping of str to float
        Target coordinates [radian]; absent ones are at rest.
    fields : mapping of str to BoneField, optional
        As for `FrameLoop`.

    Raises
    ------
    SolveError
        If a muscle cannot be solved.
    """
    rest = [model.snapshot() for model in models]
    try:
        with FrameLoop(scene, models, fields=fields) as loop:
            return loop.advance(coordinates)
    finally:
        for model, state in zip(models, rest):
            model.restore(state)


def _obstacles(scene, models, fields):
    """One BoneContacts for each model, with fields of the bones that it can reach.

    A field covers the reach of all muscles of the scene, also those without a model here, so that it does not depend on
    which muscles are simulated.
    """
    regions = find_contact_pairs(scene) if fields is None else None
    here = {model.name for model in models}
    if regions is not None:
        met = {bone for muscle, bone in regions if muscle in here}
        fields = build_fields(scene, {pair: box for pair, box in regions.items() if pair[1] in met})
    names = [bone.name for bone in scene.bones]
    for model in models:
        reached = [fields.get(n) if regions is None or (model.name, n) in regions else None for n in names]
        yield BoneContacts(names, reached, contact_bone=model.contact_bone)


def _sliding(scene, steppers):
    """Sliding between muscles, or None."""
    if scene.sliding is None:
        return None
    from rbfmuscle.simulation.sliding import Sliding

    return Sliding(scene, steppers)
