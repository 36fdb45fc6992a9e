"""Contact of a muscle with one neighbour: linked points (virtual edges), and planes through them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


# Distances [mm]. Points nearer than THRESHOLD (the default) at rest are linked. A linked point is free to STRIP beyond
# its gap at rest, and is released RELEASE beyond that.
THRESHOLD, STRIP, RELEASE = 2.0, 0.5, 5.0
# At rest points this share of a mean edge farther are linked too: a patch where two muscles touch may lie between them.
BETWEEN = 0.5
# Neighbours are looked for within this distance [mm] of points that are not linked.
SEARCH = 3.0
# Distance [mm] between the surfaces as solved below which they are cut, and how deep an overlap may be.
CUT_FROM, CUT_DEPTH = 3.0, 6.0
# Neighbours on all sides, and bones, may leave no admissible position: rigid planes would push without end.
# So planes yield: their compliance, relative to the point's own response; larger for planes that pull.
PUSH_GIVES, PULL_GIVES = 0.1, 1.0
# How far a plane pushes out of a neighbour at most in one sub-step [mm].
MOST = 0.5


# The result for muscles far from each other.
_FAR = (np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, dtype=np.int64))


class Met(NamedTuple):
    """Overlap and gap of a muscle with a neighbour.

    Attributes
    ----------
    overlap : float
        Its deepest point in the neighbour, 0 where none is.
    touching : int
        Points that touch the neighbour at rest.
    opened : float
        Sum of the squares of how much their gaps have grown.
    """

    overlap: float
    touching: int
    opened: float


_NOTHING = Met(0.0, 0, 0.0)


class Planes:
    """Half-spaces of one kind against one obstacle, fixed through a sub-step.

    Attributes
    ----------
    index, gap, normal
        As in :class:`~rbfmuscle.simulation.contact.HalfSpaces`, at the points ``anchor`` (c, 3).
    give : float
        The same of all of them.
    """

    def __init__(self, give: float = 0.0) -> None:
        self.give = give
        self.set(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))

    def set(self, index: Any, gap: Any, normal: Any, anchor: Any) -> None:
        """Replace the planes."""
        self.index, self.gap, self.normal, self.anchor = index, gap, normal, anchor

    def contacts(self, points: Floats, reach: Any) -> Any:
        """``(index, gap, normal)`` of the planes nearer than ``reach`` to the model's contact points now."""
        gap = self.gap + np.einsum("ij,ij->i", self.normal, points[self.index] - self.anchor)
        near = gap < reach
        return self.index[near], gap[near], self.normal[near]


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

    def __init__(self, stepper: Any, own: Any, other: Any, limits: Any) -> None:
        self.stepper, self.own, self.other, self.limits = stepper, own, other, limits
        self.push, self.pull = Planes(PUSH_GIVES), Planes(PULL_GIVES)
        self.free = stepper.contacts.free(len(stepper.model.contact_points()))
        #: Which points are linked, and how far each may be from the neighbour.
        self.linked = self.free.copy()
        self.touching = np.zeros(0, dtype=np.int64)
        self.hold = np.full(len(self.free), limits.hold)
        self.before: Any = None
        #: Box in which points of this muscle are near the neighbour, and the pair seen from the neighbour.
        self.zone: Any = None
        self.back: SlidingPair | None = None
        index, distance, _, _ = self._near()
        self.linked[:] = False
        near = distance < limits.threshold + min(BETWEEN * own.edge, limits.threshold)
        self.linked[index[near]] = True
        self.hold[index[near]] = np.maximum(distance[near], 0.0) + limits.strip
        near = distance < limits.threshold
        #: Points that touch the neighbour at rest, and how far they are from it there.
        self.touching, self.gap = index[near], distance[near]
        self.found = _NOTHING

    def update(self) -> None:
        """Recompute the planes from the extrapolated surfaces."""
        limits = self.limits
        points = self.own.points
        index, distance, normal, nearest = self._near()
        far = np.ones(len(points), dtype=bool)
        far[index] = distance > self.hold[index] + limits.release
        self.linked &= ~far
        self.linked[index[distance < limits.threshold]] = True
        share = np.where(self.other.fixed[nearest], 1.0, 0.5)
        self._push_out((index, np.maximum(share * distance, -limits.most), normal))
        held = self.linked[index]
        slack = share[held] * (self.hold[index[held]] - distance[held])
        self.pull.set(index[held], slack, -normal[held], points[index[held]])

    def _push_out(self, met: tuple[Any, Any, Any]) -> None:
        """Planes that keep the muscle out: at its own points, and at attached points of the neighbour."""
        at, gap, normal = self._given_way()
        index = np.concatenate([met[0], at])
        self.push.set(
            index, np.concatenate([met[1], gap]), np.concatenate([met[2], normal]), self.own.points[index]
        )

    def _given_way(self) -> Any:
        """Planes (index, gap, normal) by which the muscle yields to attached points of the neighbour inside it.

        Attached points take no contact, and the muscle's own points may be too sparse to meet a thin end.
        """
        if self.own.apart(self.other, self.limits.search):
            return _FAR[:3]
        _, distance, normal, nearest = self.own.query(
            self.other.vertices, self.other.fixed, self.limits.search
        )
        at = self.own.contact[nearest]
        deep = np.flatnonzero((distance < 0.0) & self.free[at])
        # The deepest of each point alone.
        deep = deep[np.lexsort((distance[deep], at[deep]))]
        deep = deep[np.unique(at[deep], return_index=True)[1]]
        return at[deep], np.maximum(distance[deep], -self.limits.most), -normal[deep]

    def measure(self) -> Any:
        """Overlap, widest gap of linked points, and their slip over the neighbour since the last call."""
        points = self.stepper.model.contact_points()
        index, distance, normal, nearest = self._near()
        held = self.linked[index]
        self.found = self._met(index, distance)
        close = distance < self.limits.cut_from
        self.zone = _box(points[index[close]], self.limits.cut_depth) if close.any() else None
        found = {
            "sliding_overlap_max": max(0.0, -float(distance.min(initial=0.0))),
            "sliding_gap_max": float(distance[held].max(initial=0.0)),
            "sliding_speed": self._slip(points, index[held], normal[held], nearest[held]),
        }
        self.before = points.copy(), self.other.vertices.copy()
        return found

    def _met(self, index: Any, distance: Any) -> Met:
        """Overlap with the neighbour, and the gaps opened where they touched at rest."""
        apart = np.full(len(self.free), self.limits.reach)
        apart[index] = distance
        opened = np.maximum(apart[self.touching] - np.maximum(self.gap, 0.0), 0.0)
        return Met(max(0.0, -float(distance.min(initial=0.0))), len(opened), float((opened**2).sum()))

    def meeting(self) -> Any:
        """Box in which the two meet, as seen from either; None where they do not."""
        zones = [
            zone for zone in (self.zone, None if self.back is None else self.back.zone) if zone is not None
        ]
        if not zones:
            return None
        return np.min([low for low, _ in zones], axis=0), np.max([high for _, high in zones], axis=0)

    def cut(self, points: Floats) -> Any:
        """Half the difference of both muscles' distances near where they meet, infinity elsewhere."""
        return self.cut_with_gradient(points)[0]

    def cut_with_gradient(self, points: Floats) -> Any:
        """Cut (n,) and its gradient (n, 3): the surface midway between two overlapping muscles."""
        value, gradient = np.full(len(points), np.inf), np.zeros((len(points), 3))
        zone, depth = self.meeting(), self.limits.cut_depth
        if zone is None:
            return value, gradient
        inside = np.all((points > zone[0]) & (points < zone[1]), axis=1)
        if self.own.field is not None and self.other.field is not None:
            # Both surfaces are clipped where their fields are equal.
            (ours, own), (theirs, normal) = (
                self.own.field.value_and_gradient(points[inside]),
                self.other.field.value_and_gradient(points[inside]),
            )
            value[inside], gradient[inside] = 0.5 * (theirs - ours), 0.5 * (normal - own)
            return value, gradient
        near, theirs, normal, _ = self.other.query(points, inside, depth)
        inside[:] = False
        inside[near] = True
        both, ours, own, _ = self.own.query(points, inside, depth)
        match = np.searchsorted(near, both)
        value[both] = 0.5 * (theirs[match] - ours)
        gradient[both] = 0.5 * (normal[match] - own)
        return value, gradient

    def points(self) -> Floats:
        """Points (k, 3) of the neighbour where the two meet, which must stay outside the surface."""
        zone = self.meeting()
        if zone is None:
            return np.zeros((0, 3))
        found, (low, high) = self.other.vertices, zone
        return found[np.all((found > low) & (found < high), axis=1)]

    def _near(self):
        """Points near the neighbour: linked ones up to their release distance, others within the search distance."""
        limits = self.limits
        if self.other.apart(self.own, limits.reach):
            return _FAR
        far = self.linked.copy()
        far[self.touching] = True
        found = [
            self.other.query(self.own.points, self.free & which, reach)
            for which, reach in ((far, limits.reach), (~far, limits.search))
        ]
        return tuple(np.concatenate(parts) for parts in zip(*found))

    def _slip(self, points, index, normal, nearest):
        if self.before is None or len(index) == 0:
            return 0.0
        own = points[index] - self.before[0][index]
        way = own - (self.other.vertices[nearest] - self.before[1][nearest])
        way -= np.einsum("ij,ij->i", way, normal)[:, None] * normal
        return float(np.linalg.norm(way, axis=1).mean())


class BoneLink:
    """Points near a bone at rest, linked to it; the bone's own contact keeps them out."""

    def __init__(self, stepper: Any, bone_index: Any, limits: Any) -> None:
        self.stepper, self.bone, self.limits = stepper, bone_index, limits
        points = stepper.model.contact_points()
        distance, _ = stepper.contacts.distance_and_direction(points, bone_index)
        self.linked = stepper.contacts.free(len(points)) & (distance < limits.threshold)
        self.pull = Planes()

    def update(self) -> None:
        """Planes from the predicted state."""
        limits, points = self.limits, self.stepper.model.contact_points()
        index = np.flatnonzero(self.linked)
        distance, normal = self.stepper.contacts.distance_and_direction(points[index], self.bone)
        held = distance <= limits.hold + limits.release
        self.linked[index[~held]] = False
        index, distance, normal = index[held], distance[held], normal[held]
        self.pull.set(index, limits.hold - distance, -normal, points[index])


class SlidingLimits:
    """The distances of sliding in the scene's unit."""

    def __init__(self, options: Any, scene: Scene) -> None:
        self.threshold = scene.length(THRESHOLD) if options.threshold is None else float(options.threshold)
        self.strip = scene.length(STRIP)
        self.hold = self.threshold + self.strip
        self.release = scene.length(RELEASE)
        self.search = max(scene.length(SEARCH), self.threshold)
        self.reach = max(self.search, self.hold + self.release)
        self.cut_from, self.cut_depth = scene.length(CUT_FROM), scene.length(CUT_DEPTH)
        self.most = scene.length(MOST)


def _box(points, pad):
    return points.min(axis=0) - pad, points.max(axis=0) + pad
