"""Neighbouring muscles that keep their distance and slide: virtual edges as half-spaces.

After Cervenka et al. 2023, section 5.4.1: a point nearer to its neighbour than a threshold at rest stays near
the neighbour's surface; within a strip it is free, so that it slides; beyond a release distance the link ends.

All muscles predict first. Each then gets planes through its own points from its neighbours' extrapolated surfaces. Each
of two muscles may use half of the gap between them, or moves back by half of the overlap, so the result does not depend
on the order of the muscles or on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.simulation.neighbour_surface import NeighbourSurface
from rbfmuscle.simulation.neighbours.pairs import BoneLink, Met, SlidingLimits, SlidingPair
from rbfmuscle.simulation.plan.contact_pairs import sampled_poses, swept_region
from rbfmuscle.validation import SceneError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


class Sliding:
    """All sliding pairs of a scene.

    Parameters
    ----------
    scene : Scene
        With ``sliding`` options.
    steppers : list of MuscleStepper
        In their rest state.

    Raises
    ------
    SceneError
        If ``pairs`` names an unknown muscle.
    """

    def __init__(self, scene: Scene, steppers: list[Any]) -> None:
        options: Any = scene.sliding
        limits = SlidingLimits(options, scene)
        self.links = {stepper.name: [] for stepper in steppers}
        self.bone_links = {stepper.name: [] for stepper in steppers}
        pairs = sliding_pairs(scene, [stepper.name for stepper in steppers], limits.reach)
        reach = max(limits.reach, limits.cut_depth)
        self.surfaces = {
            stepper.name: NeighbourSurface(stepper.model, reach)
            for stepper in steppers
            if any(stepper.name in pair for pair in pairs)
        }
        for stepper in steppers:
            for other in steppers:
                if frozenset((stepper.name, other.name)) in pairs:
                    link = SlidingPair(
                        stepper, self.surfaces[stepper.name], self.surfaces[other.name], limits
                    )
                    self.links[stepper.name].append(link)
                    stepper.contacts.neighbours += [link.push, link.pull]
                    stepper.contacts.cuts.append(link)
                    link.back = next((b for b in self.links[other.name] if b.other is link.own), None)
                    if link.back is not None:
                        link.back.back = link
            if options.bones:
                held = [BoneLink(stepper, b, limits) for b in stepper.contacts.reached]
                self.bone_links[stepper.name] = held
                stepper.contacts.neighbours += [link.pull for link in held]

    def pairs(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Overlap, and RMS gap opened where they touched at rest, of each pair, when measured last.

        The greater overlap of the two muscles counts; a pair that never met is left out.
        """
        met: dict[tuple[str, str], list[Met]] = {}
        for name, links in self.links.items():
            for link in links:
                one, other = sorted((name, link.other.model.name))
                met.setdefault((one, other), []).append(link.found)
        return {
            pair: (
                max(m.overlap for m in found),
                _rms(sum(m.opened for m in found), sum(m.touching for m in found)),
            )
            for pair, found in met.items()
            if any(m.touching or m.overlap for m in found)
        }

    def refresh(self, stepper: Any, way: Mapping[str, float] | None = None) -> None:
        """Update a muscle's surface from its present state, extrapolated by the change ``way`` of the coordinates."""
        if stepper.name in self.surfaces:
            with stepper.timed("sliding"):
                self.surfaces[stepper.name].refresh(way)

    def settled(self, stepper: Any, way: Mapping[str, float]) -> None:
        """Record a muscle's correction for extrapolation."""
        if stepper.name in self.surfaces:
            with stepper.timed("sliding"):
                self.surfaces[stepper.name].settled(way)

    def show(self, drawing: Any) -> None:
        """Use the field that a muscle will be shown by, before its surface is drawn."""
        stepper = drawing.stepper
        if self.links[stepper.name]:
            with stepper.timed("surface"):
                self.surfaces[stepper.name].field = drawing.drawing.field()

    def update(self, stepper: Any) -> None:
        """Recompute the planes of one muscle; its neighbours' surfaces must be up to date."""
        with stepper.timed("sliding"):
            for link in [*self.links[stepper.name], *self.bone_links[stepper.name]]:
                link.update()

    def measure(self, stepper: Any) -> Any:
        """Greatest value of each quantity over a muscle's pairs; empty without neighbours."""
        with stepper.timed("sliding"):
            found = [link.measure() for link in self.links[stepper.name]]
        return {key: max(one[key] for one in found) for key in found[0]} if found else {}


def sliding_pairs(scene: Scene, names: list[str], reach: float) -> set[frozenset[str]]:
    """Pairs of muscles that slide: those named, or all, as far as their swept boxes come within ``reach``."""
    named = scene.sliding.pairs if scene.sliding else None
    for name in sorted({name for pair in named or [] for name in pair}):
        if name not in names:
            raise SceneError(f"[sliding] pairs: unknown muscle {name!r}, known: {', '.join(names)}")
    wanted = [frozenset(pair) for pair in named] if named else None
    muscles = [muscle for muscle in scene.muscles if muscle.name in names]
    poses = sampled_poses(scene)

    @cache
    def box(k, bone):
        return swept_region(muscles[k], bone, poses)

    def meet(i, k):
        """Whether the swept boxes meet in the coordinates of every bone that holds one of the two."""
        bones = {held.bone for muscle in (muscles[i], muscles[k]) for held in muscle.attachments}
        boxes = ((box(i, bone), box(k, bone)) for bone in bones)
        return all(np.all(a[0] - reach <= b[1]) and np.all(b[0] - reach <= a[1]) for a, b in boxes)

    pairs = [
        (i, k, frozenset((muscles[i].name, muscles[k].name))) for i in range(len(muscles)) for k in range(i)
    ]
    return {pair for i, k, pair in pairs if (not wanted or pair in wanted) and meet(i, k)}


def _rms(squares, count):
    return math.sqrt(squares / count) if count else 0.0
