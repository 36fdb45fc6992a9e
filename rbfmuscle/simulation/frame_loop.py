"""The frame loop: any muscle model against any bones."""

import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.threads import blas_limited, each, in_stages
from rbfmuscle.scene.activation import Activations
from rbfmuscle.scene.motion import completed, rest_coordinates
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.frame import Event, Frame, ModelSurface, MuscleModel
from rbfmuscle.simulation.group import Group
from rbfmuscle.simulation.neighbours import NEVER_MET, Link, connected, find_links
from rbfmuscle.simulation.stepper import MuscleStepper, keep_initial_overlap
from rbfmuscle.simulation.substeps import PoseCache

Path = tuple[list[dict[str, float]], list[dict[str, float]]]


class FrameLoop:
    """Moves muscles with the bones, one frame at a time, from the rest pose on.

    Parameters
    ----------
    scene : Scene
        Its motion only determines which bones and neighbours a muscle can meet.
    models : iterable of MuscleModel
        In their rest state.
    bone_sdfs : mapping of str to BoneSDF, optional
        Distance fields of the bones; built for the bones in reach where not given.
    surfaces : bool
        Whether surfaces are extracted.

    Attributes
    ----------
    here : dict of str to float
        Present coordinates [radian]; empty before the first frame.
    activations : Activations
        Of the muscles that contract.
    steppers : list of MuscleStepper
    groups : list of Group
        The same, those together that may touch.

    Raises
    ------
    SceneError
        If muscles overlap bones at rest and the scene's ``initial`` is ``"error"``.
    """

    def __init__(
        self,
        scene: Scene,
        models: Iterable[MuscleModel],
        *,
        bone_sdfs: Mapping[str, BoneSDF] | None = None,
        surfaces: bool = True,
    ) -> None:
        models = list(models)
        self.scene = scene
        self.surfaces = surfaces
        self._poses = PoseCache(scene)
        self.steppers = [
            MuscleStepper(model, contacts, scene, poses=self._poses)
            for model, contacts in zip(models, _obstacles(scene, models, bone_sdfs))
        ]
        self.here: dict[str, float] = {}
        self.activations = Activations(scene.muscles, scene.motion)
        names = [stepper.name for stepper in self.steppers]
        links = find_links(scene, names)
        joined = connected(len(names), links)
        self._next_index = 0
        self._wall = 0.0
        with self.working():
            each(keep_initial_overlap, self.steppers)
            self.groups = [_group(self.steppers, members, links) for members in joined]

    def return_to_rest(self) -> None:
        """Return to the state before the first frame: what is asked for from here on comes out
        alike to the bit.
        """
        self.here = {}
        self.activations.here = dict.fromkeys(self.activations.here, 0.0)
        self._next_index = 0
        for group in self.groups:
            group.neighbours.state = NEVER_MET
        for stepper in self.steppers:
            stepper.return_to_rest()
            keep_initial_overlap(stepper)

    def at_rest(self) -> tuple[dict[str, ModelSurface], Poses]:
        """Surfaces of the muscles before the first frame, by muscle, and the poses of the bones
        there.
        """
        with self.working():
            shown = each(MuscleStepper.surface, self.steppers)
        for stepper, surface in zip(self.steppers, shown):
            for note in surface.notes:
                if note[2] == "iteration_cap":
                    stepper.report(*note)
        names = [stepper.name for stepper in self.steppers]
        return dict(zip(names, shown)), self._poses(rest_coordinates(self.scene))

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
        with self.working():
            drawn = self._solve(self._path_to(coordinates), draw=self.surfaces)
            frame = self._frame(drawn)
        frame.wall, self._wall = self._wall, 0.0
        return frame

    def skip(self, coordinates: Mapping[str, float]) -> None:
        """Advance without surfaces; times and events are counted to the next frame that is
        returned.
        """
        with self.working():
            self._solve(self._path_to(coordinates), draw=False)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Count the time spent inside to the next frame; BLAS uses one thread there.

        More would spin and take the cores from the loops, and results would depend on their number.
        """
        start = time.perf_counter()
        try:
            with blas_limited(1):
                yield
        finally:
            self._wall += time.perf_counter() - start

    def _number(self, place: int) -> int:
        """Number in the whole motion of the frame at a place; the place where there is none."""
        numbers = self.scene.motion.numbers
        return int(numbers[place]) if place < len(numbers) else place

    def _path_to(self, coordinates: Mapping[str, float]) -> list[Path]:
        """For each group the coordinates and the activations of its sub-steps to the next frame."""
        # Coordinates start at rest, which is zero for most.
        here = self.here or dict.fromkeys(coordinates, 0.0) | rest_coordinates(self.scene)
        self.here = completed(self.scene, coordinates)
        for stepper in self.steppers:
            stepper.frame = self._number(self._next_index)
        # Side by side, as tendons are placed at each stop.
        stops = each(lambda group: group.split(here, self.here), self.groups)
        paths: list[Path] = [([here, *found], []) for found in stops]
        if any(group.contracts for group in self.groups):
            # Muscles that contract share the sub-steps of the one that has the most.
            longest = max((stops for stops, _ in paths), key=len)
            shared = self.activations.refine(self._next_index, longest)
            paths = [shared if group.contracts else path for group, path in zip(self.groups, paths)]
        self._next_index += 1
        return paths

    def _solve(self, paths: list[Path], *, draw: bool) -> list[ModelSurface]:
        """Advance all groups through their sub-steps, and ``draw`` each muscle as soon as its group
        is done; no surfaces otherwise.
        """
        drawn = in_stages(
            lambda number: self.groups[number].advance(*paths[number]),
            MuscleStepper.surface,
            [group.steppers if draw else [] for group in self.groups],
            lambda stepper: stepper.cost,
        )
        shown = {
            stepper.name: surface
            for group, surfaces in zip(self.groups, drawn)
            for stepper, surface in zip(group.steppers, surfaces)
        }
        return [shown[stepper.name] for stepper in self.steppers if draw]

    def _frame(self, drawn: list[ModelSurface]) -> Frame:
        """The present frame, with its surfaces, if any were drawn."""
        carried = {stepper.name: stepper.model.material_mesh() for stepper in self.steppers}
        found = [stepper.collect() for stepper in self.steppers]
        times = dict(zip(carried, (times for times, _, _ in found)))
        poses = self._poses(self.here)
        index = self._number(self._next_index - 1)
        surfaces = dict(zip(carried, drawn))
        events = [event for _, events, _ in found for event in events]
        events += self._find_tendons(poses)
        events += [
            Event(index, name, *note) for name, shown in surfaces.items() for note in shown.notes
        ]
        return Frame(
            index,
            dict(self.here),
            dict(poses),
            surfaces,
            carried,
            events,
            times,
            0.0,
            activations=dict(self.activations.here),
            work=dict(zip(carried, (status for _, _, status in found))),
            tendons=dict(poses.tendons),
            bones={stepper.name: stepper.contacts.bones for stepper in self.steppers},
        )

    def _find_tendons(self, poses: Poses) -> list[Event]:
        """Ask for the ends of all tendons, whose poses are found, and kept, when they are first
        asked for; the events of those that did not settle.
        """
        events, number = [], self._number(self._next_index - 1)
        for stepper in self.steppers:
            for end in self.scene.muscle(stepper.name).tendons:
                poses[end.name]
                if not poses.tendons[end.name].settled:
                    events.append(Event(number, stepper.name, "", 1, "iteration_cap"))
        return events


def simulate_frames(
    scene: Scene,
    models: Iterable[MuscleModel],
    *,
    surfaces: bool = True,
    written: Collection[int] | None = None,
    bone_sdfs: Mapping[str, BoneSDF] | None = None,
) -> Iterator[Frame]:
    """Run models, from their rest state, through a scene's motion and yield its frames one by one.

    Only frames whose index is in ``written`` are yielded, all where it is None. Frames yielded
    before an interrupt or an error stay valid. Raises as `FrameLoop` does.
    """
    loop = FrameLoop(scene, models, bone_sdfs=bone_sdfs, surfaces=surfaces)
    for index, coordinates in enumerate(scene.motion.frames):
        if written is None or index in written:
            yield loop.advance(coordinates)
        else:
            loop.skip(coordinates)


def _group(steppers: list[MuscleStepper], members: list[int], links: list[Link]) -> Group:
    """Some of the muscles together, in an order of their places: that of the file changes nothing,
    nor do their names.
    """
    place = {m: tuple(steppers[m].model.contact_points().mean(axis=0)) for m in members}
    ordered = sorted(members, key=place.__getitem__)
    number = {m: k for k, m in enumerate(ordered)}
    inner = [(number[a], number[b]) for a, b in links if a in number]
    return Group([steppers[m] for m in ordered], inner)


def _obstacles(scene, models, bone_sdfs):
    """One BoneContacts for each model, with fields of the bones that it can reach."""
    regions = None
    if bone_sdfs is None:
        here = {model.name for model in models}
        found = find_contact_pairs(scene)
        regions = {pair: box for pair, box in found.items() if pair[0] in here}
        bone_sdfs = build_fields(scene, regions)
    order = [bone.name for bone in scene.bones if bone.name in bone_sdfs]
    for model in models:
        met = [name for name in order if regions is None or (model.name, name) in regions]
        parts = None if regions is None else [regions[model.name, name] for name in met]
        reached = BonesInReach(met, [bone_sdfs[name] for name in met], parts)
        yield BoneContacts(reached, model.attached_bone)
