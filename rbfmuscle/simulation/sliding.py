"""Neighbouring muscles that keep their distance and slide: virtual edges as half-spaces.

After Cervenka et al. 2023, section 5.4.1: a point nearer to its neighbour than a threshold at rest
stays near the neighbour's surface; within a strip it is free, so that it slides; beyond a release
distance the link ends.

All muscles predict first. Each then gets planes through its own points from its neighbours'
extrapolated surfaces. Each of two muscles may use half of the gap between them, or moves back by
half of the overlap, so the result does not depend on the order of the muscles or on the number of
threads.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import sampled_poses, swept_boxes
from rbfmuscle.simulation.neighbour_surface import (
    MovingSurface,
    NeighbourState,
    NeighbourSurface,
)
from rbfmuscle.simulation.sliding_pair import BoneLink, LinkState, SlidingLimits, SlidingPair
from rbfmuscle.simulation.stepper import MuscleStepper, Path
from rbfmuscle.validation import SceneError

Coordinates = dict[str, float]


class SlidingState(NamedTuple):
    """What `Sliding` keeps from frame to frame: how each pair is linked, which have not met, and
    where the muscles were moved by their solves.
    """

    links: dict[str, list[tuple[SlidingPair, LinkState]]]
    bone_links: dict[str, list[Booleans]]
    apart: list[tuple[MuscleStepper, MuscleStepper]]
    surfaces: dict[str, tuple[NeighbourState, MovingSurface, Floats]]
    pairs: dict[tuple[str, str], tuple[float, float]]


class Sliding:
    """Muscles, in their rest state, that exchange their surfaces in all sliding pairs of a scene.

    ``pairs`` has, for each that met in the last finished frame, the overlap, and the RMS gap opened
    where they touched at rest. Raises SceneError if the scene's ``pairs`` name an unknown muscle.
    """

    def __init__(self, scene: Scene, steppers: list[MuscleStepper]) -> None:
        assert scene.sliding is not None
        limits = SlidingLimits(scene.sliding, scene)
        self.steppers = steppers
        self.pairs: dict[tuple[str, str], tuple[float, float]] = {}
        self.links: dict[str, list[SlidingPair]] = {stepper.name: [] for stepper in steppers}
        self.bone_links: dict[str, list[BoneLink]] = {stepper.name: [] for stepper in steppers}
        pairs = sliding_pairs(scene, [stepper.name for stepper in steppers], limits.reach)
        self.surfaces = {
            stepper.name: NeighbourSurface(stepper.model, limits.reach)
            for stepper in steppers
            if any(stepper.name in pair for pair in pairs)
        }
        self.limits = limits
        #: Pairs that have not come near each other yet.
        self.apart = [
            (one, other)
            for one in steppers
            for other in steppers
            if one.name < other.name and frozenset((one.name, other.name)) in pairs
        ]
        self._link_near()
        for stepper in steppers:
            if scene.sliding.bones:
                held = [
                    BoneLink(stepper, b, limits) for b in range(len(stepper.contacts.bones.names))
                ]
                self.bone_links[stepper.name] = held
                stepper.contacts.neighbours += [link.pull for link in held]

    def _link_near(self) -> None:
        """Link the muscles that are near each other now; done at rest and after each frame."""
        for pair in list(self.apart):
            one, other = (self.surfaces[stepper.name] for stepper in pair)
            if other.is_near(one, self.limits.search):
                self.apart.remove(pair)
                self._link(*pair)
                self._link(*pair[::-1])

    def _link(self, stepper: MuscleStepper, other: MuscleStepper) -> None:
        """Link a muscle to a neighbour."""
        link = SlidingPair(
            stepper, self.surfaces[stepper.name], self.surfaces[other.name], self.limits
        )
        self.links[stepper.name].append(link)
        stepper.contacts.neighbours += [link.push, link.pull]
        stepper.contacts.beside.append(link)

    def advance(
        self, stops: Sequence[Coordinates], activations: Sequence[Mapping[str, float]]
    ) -> None:
        """Solve all muscles at the coordinates of the sub-steps; the first of them are the present
        ones.

        The muscle with the most sub-steps divides the frame. Another muscle takes several of these
        at a time, as many as its own bones allow; in between its neighbours see its prediction.
        """
        for link in (link for links in self.links.values() for link in links):
            link.begin_frame()
        strides = {stepper.name: _stride(stepper, stops) for stepper in self.steppers}
        last, here = len(stops) - 1, dict.fromkeys(strides, 0)
        for stop in range(1, last + 1):
            due = [s for s in self.steppers if stop == last or stop % strides[s.name] == 0]
            for stepper in due if len(activations) else ():
                if stepper.name in activations[stop - 1]:
                    stepper.model.activate(activations[stop - 1][stepper.name])
            if due:
                paths = {
                    s.name: Path.between(stops[here[s.name]], stops[stop], s.poses)
                    for s in self.steppers
                }
                self._step(due, paths)
            here.update((stepper.name, stop) for stepper in due)
        self._link_near()

    def _step(self, due: list[MuscleStepper], paths: Mapping[str, Path]) -> None:
        """One sub-step of some muscles, each from its own last coordinates."""

        def predict(stepper: MuscleStepper) -> None:
            stepper.predict(paths[stepper.name])
            self.refresh(stepper, paths[stepper.name])

        def wait(stepper: MuscleStepper) -> None:
            state, path = stepper.model.snapshot(), paths[stepper.name]
            started = perf_counter()
            stepper.model.predict(path.old, path.new)
            stepper.times["time_predict"] += perf_counter() - started
            self.refresh(stepper, path)
            stepper.model.restore(state)

        def find_planes(stepper: MuscleStepper) -> None:
            with _timed(stepper):
                for link in self.links[stepper.name]:
                    link.update()
                for bone_link in self.bone_links[stepper.name]:
                    bone_link.update()

        def learn(stepper: MuscleStepper) -> None:
            if stepper.name in self.surfaces:
                with _timed(stepper):
                    self.surfaces[stepper.name].learn(*paths[stepper.name][:2])

        each(predict, due)
        seen = {link.other.model.name for stepper in due for link in self.links[stepper.name]}
        each(
            wait,
            [stepper for stepper in self.steppers if stepper.name in seen and stepper not in due],
        )
        for act in (find_planes, MuscleStepper.correct, learn):
            each(act, due)

    def snapshot(self) -> SlidingState:
        """The state, for :meth:`restore`."""
        return SlidingState(
            {name: [(link, link.state) for link in links] for name, links in self.links.items()},
            {name: [link.linked for link in links] for name, links in self.bone_links.items()},
            list(self.apart),
            {name: surface.snapshot() for name, surface in self.surfaces.items()},
            self.pairs,
        )

    def restore(self, state: SlidingState) -> None:
        """Return to a snapshot, which stays valid; the steppers have."""
        self.apart = list(state.apart)
        self.pairs = state.pairs
        for name, known in state.links.items():
            self.links[name] = [link for link, _ in known]
            for link, linked in known:
                link.state = linked
        for name, held in state.bone_links.items():
            for bone_link, linked_points in zip(self.bone_links[name], held):
                bone_link.linked = linked_points
        for name, surface in state.surfaces.items():
            self.surfaces[name].restore(surface)

    def refresh(self, stepper: MuscleStepper, path: Path | None = None) -> None:
        """Update a muscle's surface from its present state, extrapolated for a path."""
        if stepper.name in self.surfaces:
            with _timed(stepper):
                self.surfaces[stepper.name].refresh(*(() if path is None else path[:2]))

    def finish_frame(self) -> None:
        """Make room where the solved muscles overlap, so that surfaces can be drawn; updates
        ``pairs``.
        """
        each(self.refresh, self.steppers)
        solved = [
            stepper for stepper in self.steppers if stepper.solves and self.links[stepper.name]
        ]
        each(self._make_room, solved)
        each(self.refresh, solved)
        met: dict[tuple[str, str], list[tuple[float, int, float]]] = {}
        for stepper, found in zip(self.steppers, each(self._measure, self.steppers)):
            for link, one in zip(self.links[stepper.name], found):
                names = stepper.name, link.other.model.name
                met.setdefault((min(names), max(names)), []).append(one)
        self.pairs = {
            pair: (max(overlap), math.sqrt(sum(opened) / max(sum(touching), 1)))
            for pair, (overlap, touching, opened) in (
                (pair, zip(*found)) for pair, found in met.items()
            )
            if any(touching) or any(overlap)
        }
        for stepper in self.steppers:
            if self.links[stepper.name]:
                self.surfaces[stepper.name].show(stepper.model.embedded_mesh())

    def _make_room(self, stepper):
        with _timed(stepper):
            for link in self.links[stepper.name]:
                link.update(relink=False)
            stepper.model.solve(stepper.contacts, room=True)

    def _measure(self, stepper):
        with _timed(stepper):
            return [link.measure() for link in self.links[stepper.name]]


@contextmanager
def _timed(stepper: MuscleStepper) -> Iterator[None]:
    """Add the time spent inside to ``time_sliding``."""
    started = perf_counter()
    yield
    stepper.times["time_sliding"] += perf_counter() - started


def _stride(stepper, stops):
    """Number of sub-steps that a muscle takes at a time; one that contracts takes every one."""
    count = len(stops) - 1
    if stepper.contracts or count < 2:
        return 1
    return max(1, count // max(1, len(stepper.substeps.split(stops[0], stops[-1]))))


def sliding_pairs(scene: Scene, names: list[str], reach: float) -> set[frozenset[str]]:
    """Pairs of muscles that slide: those named, or all, as far as their swept boxes come within
    ``reach``.
    """
    named = scene.sliding.pairs if scene.sliding else None
    for name in sorted({name for pair in named or [] for name in pair}):
        if name not in names:
            raise SceneError(f"[sliding] pairs: unknown muscle {name!r}, known: {', '.join(names)}")
    wanted = [frozenset(pair) for pair in named] if named is not None else None
    muscles = [muscle for muscle in scene.muscles if muscle.name in names]
    poses = sampled_poses(scene)

    @cache
    def box(k, bone):
        return swept_boxes(muscles[k], [bone], poses)[0]

    def meet(i, k):
        """Whether the swept boxes meet in the coordinates of every bone that holds one of the
        two.
        """
        bones = {held.bone for muscle in (muscles[i], muscles[k]) for held in muscle.attachments}
        boxes = ((box(i, bone), box(k, bone)) for bone in bones)
        return all(np.all(a[0] - reach <= b[1]) and np.all(b[0] - reach <= a[1]) for a, b in boxes)

    pairs = [
        (i, k, frozenset((muscles[i].name, muscles[k].name)))
        for i in range(len(muscles))
        for k in range(i)
    ]
    return {pair for i, k, pair in pairs if (wanted is None or pair in wanted) and meet(i, k)}
