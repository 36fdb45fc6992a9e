"""Contacts with several bones at once, as half-spaces.

The bones' distance fields stay in bone coordinates and are never rebuilt. Nothing here depends on
how a muscle is represented.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.bones.distance import Memory
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import moved_box
from rbfmuscle.scene.tendons import AT_REST
from rbfmuscle.validation import check_finite, check_points

# Steps to the nearest surface in which a point that is shown leaves a bone.
LIFTS = 3


class HalfSpaces(NamedTuple):
    """Linearised contacts: moving ``point`` by ``dp`` is admissible where ``gap + normal . dp
    >= 0``.
    """

    point: Integers  # (c,) place of the point among those that were asked about
    gap: Floats  # (c,) signed distance now [scene unit], negative is violated
    normal: Floats  # (c, 3) unit direction of growing distance, world axes
    source: Integers  # (c,) row of the bone in reach; behind the last one, a fence

    def some(self, rows: Integers | slice) -> HalfSpaces:
        """Some of them."""
        return HalfSpaces(self.point[rows], self.gap[rows], self.normal[rows], self.source[rows])

    @classmethod
    def joined(cls, parts: Sequence[HalfSpaces]) -> HalfSpaces:
        """The half-spaces of all parts, one after the other."""
        some = [part for part in parts if len(part.point)]
        return some[0] if len(some) == 1 else cls(*map(np.concatenate, zip(*(some or parts))))


class Fences(NamedTuple):
    """Half-spaces that stay where they are while the contact points move: those that hold points on
    their side of a bone that they would pass through, fixed through a sub-step, or contacts as they
    were when they were asked for.
    """

    point: Integers  # (f,) number of the contact point
    gap: Floats  # (f,) distance of the anchor [scene unit]
    normal: Floats  # (f, 3) unit
    anchor: Floats  # (f, 3)

    def meet(self, which: Integers, here: Floats, source: int) -> HalfSpaces:
        """What points ``which`` (m,), in rising order and now ``here`` (m, 3), meet of the fences,
        whose half-spaces have this ``source``.
        """
        if len(self.point) == 0 or len(which) == 0:
            return NO_HALF_SPACES
        near = np.minimum(np.searchsorted(which, self.point), len(which) - 1)
        chosen = np.flatnonzero(which[near] == self.point)
        near, normal = near[chosen], self.normal[chosen]
        gap = self.gap[chosen] + np.einsum("fa,fa->f", normal, here[near] - self.anchor[chosen])
        return HalfSpaces(near, gap, normal, np.full(len(near), source))


NO_FENCES = Fences(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
NO_HALF_SPACES = HalfSpaces(NO_FENCES.point, NO_FENCES.gap, NO_FENCES.normal, NO_FENCES.point)


# Grows a box so far that it holds all that can be near the bone in it.
EVERYWHERE = np.array([[-np.inf], [np.inf]])


class BonesInReach:
    """The r bones that a muscle can reach, which never change; the poses are given. Muscles may
    share the ``fields``; ``regions`` are the boxes (2, 3) of each bone that this one can reach, in
    bone coordinates, all of it where they are not given.
    """

    def __init__(
        self,
        names: Sequence[str],
        fields: Sequence[BoneSDF],
        regions: Sequence[Floats] | None = None,
    ) -> None:
        if len(names) != len(fields):
            raise ValueError(
                f"one field per bone is needed, got {len(fields)} for {len(names)} bones"
            )
        self.names = list(names)
        self.fields = list(fields)
        everywhere = [field.bounds + EVERYWHERE for field in fields]
        self.regions = everywhere if regions is None else list(regions)

    def place(self, poses: Mapping[str, Floats], out: Floats | None = None) -> Floats:
        """Poses (r, 4, 4) of the bones, from a dict of bone name to (4, 4) rest-to-world
        transform.
        """
        if out is None:
            out = np.empty((len(self.names), 4, 4))
        for row, name in enumerate(self.names):
            try:
                out[row] = poses[name]
            except KeyError:
                raise ValueError(f"poses lack the bone {name!r}") from None
        return out

    def nearest(
        self, points: ArrayLike, poses: Mapping[str, Floats], limit: Floats | float = np.inf
    ) -> tuple[Floats, Floats]:
        """Smallest distance (n,) over the bones of points (n, 3), and the unit direction (n, 3) in
        which it grows, world axes.

        [scene unit], negative inside a bone, infinity where none is in reach. Beyond ``limit``, a
        number or (n,), it is only a lower bound above the limit, without a direction.
        """
        points = check_points(points)
        smallest, gradient = np.full(len(points), np.inf), np.zeros((len(points), 3))
        for field, pose in zip(self.fields, self.place(poses)):
            # No farther than what was found: elsewhere a lower bound will do.
            reach = np.minimum(smallest, limit)
            distance, way = field.distance_and_gradient(points, pose, reach=reach)
            closer = distance < smallest
            smallest[closer] = distance[closer]
            gradient[closer] = way[closer]
        return smallest, gradient


class BoneContacts:
    """The obstacles of one muscle: the bones that it can reach, in one pose.

    ``attached_bone`` (n,) holds the bone that each contact point is attached to, -1 where it is
    ``free``; attached points take no contact. ``poses`` are those of all bones by name, ``placed``
    (r, 4, 4) those of the bones in reach.
    """

    def __init__(self, bones: BonesInReach, attached_bone: ArrayLike) -> None:
        self.bones = bones
        self.free = np.asarray(attached_bone, dtype=np.int64) < 0
        self.poses: Mapping[str, Floats] = AT_REST
        self.placed = bones.place(AT_REST)
        #: Displacements (n, 3) that take shown points (n, 3) of the muscle out of its neighbours.
        self.out_of_neighbours: Callable[[Floats], Floats] = np.zeros_like
        #: What holds points on their side of a bone, in a sub-step that needs it.
        self.fences = NO_FENCES
        self._free = np.flatnonzero(self.free)
        #: How deep (r, n) each contact point may be inside each bone in reach [scene unit].
        self.allowed = np.zeros((len(bones.names), len(self.free)))
        #: What is known of the free points about each bone in reach.
        self.memories = [Memory.of(len(self._free)) for _ in bones.names]

    def move(self, poses: Mapping[str, Floats]) -> None:
        """Take the bones' poses, a dict of bone name to (4, 4) rest-to-world transform."""
        self.bones.place(poses, self.placed)
        self.poses = poses

    def distance_and_direction(self, points: Floats, row: int) -> tuple[Floats, Floats]:
        """Signed distance (n,) to one of the bones in reach and the unit direction (n, 3) in which
        it grows, world axes.
        """
        return self.bones.fields[row].distance_and_gradient(points, self.placed[row])

    def depth(self, points: Floats) -> float:
        """Greatest depth of a free contact point (n, 3) in a bone [scene unit]; 0 outside."""
        some, depth = points[self._free], 0.0
        for row in self._near(some, 0.0):
            distance, _ = self._ask(row, some, 0.0)
            depth = max(depth, -float(distance.min()))
        return depth

    def half_spaces(self, points: Floats, reach: float) -> HalfSpaces:
        """Pairs of contact point (n, 3) and obstacle nearer than ``reach`` [scene unit], bone by
        bone, then fences.
        """
        if len(points) != len(self.free):
            raise ValueError(
                f"half-spaces need all {len(self.free)} contact points, got {len(points)}"
            )
        check_finite(points, name="points")
        some = points[self._free]
        found = []
        for row in self._near(some, reach):
            allowed = self.allowed[row, self._free]
            distance, normal = self._ask(row, some, reach - allowed)
            gap = distance + allowed
            near = np.flatnonzero(gap < reach)
            source = np.full(len(near), row)
            found.append(HalfSpaces(self._free[near], gap[near], normal[near], source))
        fences = self.fences.meet(np.arange(len(points)), points, len(self.bones.names))
        found.append(fences.some(np.flatnonzero(fences.gap < reach)))
        return HalfSpaces.joined(found)

    def lifted(self, points: Floats) -> Floats:
        """Contact points (n, 3) to be shown: those that stay in a bone, as they overlapped it at
        rest, are taken to its surface.
        """
        points = points.copy()
        for row in np.flatnonzero(self.allowed.any(axis=1)).tolist():
            some = np.flatnonzero(self.allowed[row] > 0.0)
            for _ in range(LIFTS):
                distance, way = self.distance_and_direction(points[some], row)
                points[some] += np.maximum(-distance, 0.0)[:, None] * way
        return points

    def _near(self, points: Floats, reach: float) -> list[int]:
        """Rows of the bones whose boxes are within ``reach`` of the box of points (n, 3)."""
        if len(points) == 0:
            return []
        # One axis after the other: NumPy takes ten times as long along rows of three.
        axes = np.ascontiguousarray(points.T)
        low, high = axes.min(axis=1) - reach, axes.max(axis=1) + reach
        boxes = [moved_box(f.bounds, pose) for f, pose in zip(self.bones.fields, self.placed)]
        return [
            row for row, box in enumerate(boxes) if (box[0] <= high).all() and (box[1] >= low).all()
        ]

    def _ask(self, row: int, points: Floats, reach: ArrayLike) -> tuple[Floats, Floats]:
        """Distances and directions of all free points; what is known of them is kept."""
        field, memory = self.bones.fields[row], self.memories[row]
        return field.distance_and_gradient(points, self.placed[row], reach=reach, memory=memory)
