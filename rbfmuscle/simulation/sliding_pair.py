"""Contact of a muscle with one neighbour: linked points (virtual edges), and planes through
them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.simulation.contact import Planes
from rbfmuscle.simulation.neighbour_surface import Found, NeighbourSurface

if TYPE_CHECKING:
    from rbfmuscle.scene.options import SlidingOptions
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.stepper import MuscleStepper


# Distances [mm]. Points nearer than THRESHOLD (the default) at rest are linked. A linked point is
# free to STRIP beyond its gap at rest, and is released RELEASE beyond that.
THRESHOLD = 2.0
STRIP = 0.5
RELEASE = 15.0
# At rest points this share of a mean edge farther are linked too: a patch where two muscles touch
# may lie between them.
BETWEEN = 0.5
# Neighbours are looked for within this distance [mm] of points that are not linked.
SEARCH = 3.0
# Drawn surfaces are moved CLEAR [mm] apart where they overlap by less than DEEP, neither by more
# than DRAWN.
CLEAR = 0.2
DEEP = 6.0
DRAWN = 1.0
# What comes near in a frame is within this many mean edges more at its start.
AHEAD = 3.0
# How far planes between muscles yield to a pressure, relative to a bone's. One point in each cell
# of SPARSE mean edges has a plane that holds muscles together, which yields less in proportion.
YIELDS, SPARSE = 40.0, 2.0
MOST = 3.0  # how far a plane pushes out of a neighbour at most in one sub-step [mm]


# The result for muscles far from each other.
_FAR: Found = (
    np.zeros(0, dtype=np.int64),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros(0, dtype=np.int64),
)


class LinkState(NamedTuple):
    """What changes of a `SlidingPair` from frame to frame."""

    linked: Booleans  # (n,) which of its points are held at the neighbour
    least: float  # distance of its points from the neighbour when last measured


class SlidingPair:
    """The linked points of one muscle at one neighbour, and their planes.

    Parameters
    ----------
    stepper : MuscleStepper
        The muscle that is held.
    own, other : NeighbourSurface
        Its own surface and the neighbour's.
    limits : SlidingLimits
    """

    def __init__(
        self,
        stepper: MuscleStepper,
        own: NeighbourSurface,
        other: NeighbourSurface,
        limits: SlidingLimits,
    ) -> None:
        self.own = own
        self.other = other
        self.limits = limits
        self.begin_frame()
        self.free = stepper.contacts.free
        at = np.flatnonzero(self.free)
        apart = np.full(len(at), limits.reach)
        index, distance, _, _ = (
            _FAR if other.apart(own, limits.reach) else other.query(own.points[at], limits.reach)
        )
        apart[index] = distance
        # In the muscle's own frame, so that it does not depend on where the scene lies.
        frame = RestFrame(own.points)
        places = frame.size * frame.local
        chosen = _nearest_by_cell(places[at], apart, stepper.model.contact_spacing)
        #: Contact points that meet the neighbour, and which of them it holds.
        self.at, apart = at[chosen], apart[chosen]
        self.held = np.zeros(len(self.at), dtype=bool)
        self.held[_nearest_by_cell(places[self.at], apart, SPARSE * own.edge)] = True
        near = limits.threshold + min(BETWEEN * own.edge, limits.threshold)
        linked = apart < min(near, limits.reach)
        #: Which of them are linked, never changed in place, and how far each may be from the
        #: neighbour.
        self.state = LinkState(linked, np.inf)
        self.hold = np.where(linked, np.maximum(apart, 0.0) + limits.strip, limits.hold)
        #: Those that touch the neighbour at rest, and how far they are from it there.
        self.touching = np.flatnonzero(apart < limits.threshold)
        self.gap = apart[self.touching]
        area = self.free.sum() / max(1, len(self.at))
        self.push = Planes(YIELDS / area)
        self.pull = Planes(YIELDS / area * self.held.sum() / max(1, len(self.at)))

    def begin_frame(self) -> None:
        """Look for nearest vertices anew, of the neighbour to contact points and of the muscle to
        the neighbour's.
        """
        self._from: Integers | None = None
        self._fixed_from: Integers | None = None

    @property
    def linked(self) -> Booleans:
        """Which of the points are linked."""
        return self.state.linked

    def _link(self, linked: Booleans) -> None:
        self.state = self.state._replace(linked=linked)

    def update(self, *, relink: bool = True) -> None:
        """Recompute the planes from the surfaces as last refreshed, and, with ``relink``, which
        points are linked.
        """
        limits, points = self.limits, self.own.points
        if self.other.apart(self.own, limits.reach):
            if relink:
                self._link(np.zeros_like(self.linked))
            self.push.clear()
            self.pull.clear()
            return
        index, distance, normal, nearest = self._near()
        if relink:
            far = np.ones(len(self.at), dtype=bool)
            far[index] = distance > self.hold[index] + limits.release
            linked = self.linked & ~far
            linked[index[distance < limits.threshold]] = True
            self._link(linked)
        share = np.where(self.other.fixed[nearest], 1.0, 0.5)
        own = self.at[index], np.maximum(share * distance, -limits.most), normal
        # Planes that keep the muscle out: at its own points, and at attached points of the
        # neighbour.
        at, gap, out = (np.concatenate(parts) for parts in zip(own, self._pushed()))
        self.push.set(at, gap, out, points[at])
        held = self.linked[index] & self.held[index]
        at, slack = self.at[index[held]], share[held] * (self.hold[index[held]] - distance[held])
        self.pull.set(at, slack, -normal[held], points[at])

    def _pushed(self) -> tuple[Integers, Floats, Floats]:
        """Planes (index, gap, normal) by which the muscle yields to attached points of the
        neighbour inside it.

        Attached points take no contact, and the muscle's own points may be too sparse to meet a
        thin end.
        """
        if self.own.apart(self.other, self.limits.search):
            return _FAR[:3]
        held, reach = self.other.vertices[self.other.fixed], self.limits.search
        if self._fixed_from is None:
            self._fixed_from = self.own.nearest(held, reach + AHEAD * self.own.edge)
        _, distance, normal, nearest = self.own.query(held, reach, self._fixed_from)
        at = self.own.contact[nearest]
        deep = np.flatnonzero((distance < 0.0) & self.free[at])
        # The deepest of each point alone.
        deep = deep[np.lexsort((distance[deep], at[deep]))]
        deep = deep[np.unique(at[deep], return_index=True)[1]]
        return at[deep], np.maximum(distance[deep], -self.limits.most), -normal[deep]

    def measure(self) -> tuple[float, int, float]:
        """Overlap with the neighbour as solved, and where the two meet.

        Returns
        -------
        overlap : float
            Deepest point of this muscle in the neighbour, 0 where none is.
        touching : int
            Points that touch the neighbour at rest.
        opened : float
            Sum of the squares of how much their gaps have grown.
        """
        apart = np.full(len(self.at), self.limits.reach)
        index, now, _, _ = self._near()
        apart[index] = now
        least = float(now.min(initial=np.inf))
        self.state = self.state._replace(least=least)
        opened = np.maximum(apart[self.touching] - np.maximum(self.gap, 0.0), 0.0)
        return max(0.0, -least), len(opened), float((opened**2).sum())

    def excess(self, points: Floats) -> Floats:
        """How far (n,) points (n, 3) of the drawn muscle are to move inwards: half of the way out
        of the neighbour.
        """
        limits = self.limits
        found = np.zeros(len(points))
        shown = self.other.shown
        if self.state.least > limits.clear + self.own.edge:
            return found
        near = np.flatnonzero(shown.boxed(points, limits.clear))
        index, distance, _, _ = shown.query(points[near], limits.deep)
        found[near[index]] = np.clip(0.5 * (limits.clear - distance), 0.0, limits.drawn)
        return found

    def _near(self) -> Found:
        """Of the points ``at`` those near the neighbour: linked ones up to their release distance,
        others less far.
        """
        far = self.linked.copy()
        far[self.touching] = True
        reach, points = (
            np.where(far, self.limits.reach, self.limits.search),
            self.own.points[self.at],
        )
        most = float(np.max(reach, initial=0.0))
        if self.other.apart(self.own, most):
            return _FAR
        if self._from is None:
            self._from = self.other.nearest(points, most + AHEAD * self.other.edge)
        return self.other.query(points, reach, self._from)


def _nearest_by_cell(points: Floats, distance: Floats, size: float) -> Integers:
    """Sorted indices of the points (n, 3) that are nearest in their cell of a grid; all points for
    size 0.

    Of points that are equally near, but for rounding, the first.
    """
    if size == 0.0:
        return np.arange(len(points))
    order = np.argsort(np.round(distance / size, 8), kind="stable")
    return np.sort(order[np.unique(np.floor(points[order] / size), axis=0, return_index=True)[1]])


class BoneLink:
    """Points near a bone at rest, linked to it; the bone's own contact keeps them out.

    ``linked`` says which are, and is never changed in place.
    """

    def __init__(self, stepper: MuscleStepper, bone_index: int, limits: SlidingLimits) -> None:
        self.stepper = stepper
        self.bone = bone_index
        self.limits = limits
        points = stepper.model.contact_points()
        distance, _ = stepper.contacts.distance_and_direction(points, bone_index)
        self.linked = stepper.contacts.free & (distance < limits.threshold)
        self.pull = Planes(YIELDS)

    def update(self) -> None:
        """Planes from the predicted state."""
        limits, points = self.limits, self.stepper.model.contact_points()
        index = np.flatnonzero(self.linked)
        distance, normal = self.stepper.contacts.distance_and_direction(points[index], self.bone)
        held = distance <= limits.hold + limits.release
        linked = self.linked.copy()
        linked[index[~held]] = False
        self.linked = linked
        index = index[held]
        distance = distance[held]
        normal = normal[held]
        self.pull.set(index, limits.hold - distance, -normal, points[index])


class SlidingLimits:
    """The distances of sliding in the scene's unit."""

    def __init__(self, options: SlidingOptions, scene: Scene) -> None:
        self.threshold = (
            from_mm(THRESHOLD, scene.units)
            if options.threshold is None
            else float(options.threshold)
        )
        self.strip = from_mm(STRIP, scene.units)
        self.hold = self.threshold + self.strip
        self.release = from_mm(RELEASE, scene.units)
        self.search = max(from_mm(SEARCH, scene.units), self.threshold)
        self.reach = max(self.search, self.hold + self.release)
        self.clear, self.deep = from_mm(CLEAR, scene.units), from_mm(DEEP, scene.units)
        self.drawn, self.most = from_mm(DRAWN, scene.units), from_mm(MOST, scene.units)
