"""Contacts as half-spaces, with several bones and neighbouring muscles at once.

Obstacles are the bones' distance fields, which stay in bone coordinates and are never rebuilt, and,
with sliding, the surfaces of neighbouring muscles. Nothing here depends on how a muscle is
represented.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.bones.broad_phase import (
    answer_loop,
    apart_loop,
    closer_loop,
    direction_loop,
    near_loop,
    path_loop,
    take_contacts_loop,
)
from rbfmuscle.bones.obstacles import (
    Bones,
    Known,
    Obstacles,
    PlaneStack,
    find_contacts,
    stack_bones,
)
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.scene.tendons import AtRest
from rbfmuscle.validation import check_points

NONE_ALLOWED: Floats = np.zeros(0)


@dataclass(frozen=True)
class HalfSpaces:
    """Linearised contacts: moving point ``index`` by ``dp`` is admissible where ``gap + normal . dp
    >= 0``.
    """

    index: np.ndarray  # (c,) contact point
    gap: np.ndarray  # (c,) signed distance now [scene unit], negative is violated
    normal: np.ndarray  # (c, 3) unit direction of growing distance, world axes
    source: np.ndarray  # (c,) index of the bone, or -1 - k for virtual edges of family k


class Planes:
    """Half-spaces of one kind against one obstacle, at points ``anchor`` (c, 3), fixed through a
    sub-step.

    ``softness`` says how far they yield to a force, relative to a bone; for models that solve for
    forces.
    """

    def __init__(self, softness: float = 1.0) -> None:
        self.softness = softness
        self.clear()

    def clear(self) -> None:
        """Remove the planes."""
        self.set(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))

    def set(self, index: Integers, gap: Floats, normal: Floats, anchor: Floats) -> None:
        """Replace the planes."""
        self.index = index
        self.gap = gap
        self.normal = normal
        self.anchor = anchor


class Neighbour(Protocol):
    """A sliding neighbour, for the muscle's surface."""

    def excess(self, points: Floats) -> Floats:
        """How far (n,) points (n, 3) are to move inwards for it [scene unit]."""


class BoneContacts:
    """The obstacles of one muscle, in one pose.

    ``fields`` is given one entry for each bone of the scene, None where the muscle cannot reach it,
    and holds those in reach by number; muscles may share fields. ``attached_bone`` (n,) holds the
    bone that each contact point is attached to, -1 where it is free; attached points take no
    contact. ``reached`` lists the bones that have a field, ``boxes`` (r, 2, 3) has theirs at rest
    and ``placed`` (r, 4, 4) their poses.
    """

    def __init__(
        self,
        names: Sequence[str],
        fields: Sequence[BoneField | None],
        *,
        attached_bone: ArrayLike | None = None,
    ) -> None:
        if len(names) != len(fields):
            raise ValueError(
                f"one field per bone is needed, got {len(fields)} for {len(names)} bones"
            )
        self.names = list(names)
        self.fields = {b: field for b, field in enumerate(fields) if field is not None}
        self.reached = list(self.fields)
        self._reached = np.array(self.reached, dtype=np.int64)
        self._row = {b: row for row, b in enumerate(self.reached)}
        boxes = [self.fields[b].bounds for b in self.reached]
        self.boxes = np.array(boxes, dtype=np.float64).reshape(-1, 2, 3)
        self.attached_bone = (
            None if attached_bone is None else np.asarray(attached_bone, dtype=np.int64)
        )
        self.move(AtRest((name, np.eye(4)) for name in self.names))
        self.allowed: dict[int, Floats] = {}
        #: Planes of sliding neighbours, and those that hold points on their side of a bone.
        self.neighbours: list[Planes] = []
        self.beside: list[Neighbour] = []
        self._allowed: Floats | None = None
        self._known = Known(np.zeros((len(self.reached), 0, 3)), np.zeros((len(self.reached), 0)))

    def move(self, poses: dict[str, Floats]) -> None:
        """Take the bones' poses, a dict of bone name to (4, 4) rest-to-world transform."""
        missing = [self.names[b] for b in self.reached if self.names[b] not in poses]
        if missing:
            raise ValueError(f"poses lack the bone {missing[0]!r}")
        self.poses, self.placed = poses, self.stacked(poses)

    def at(self, poses: dict[str, Floats]) -> BoneContacts:
        """A copy with the bones in these poses, for queries while they move on."""
        other = copy.copy(self)
        other.move(poses)
        other.beside, other._known = list(self.beside), Known(*(p[:, :0] for p in self._known))
        return other

    @cached_property
    def bones(self) -> Bones | None:
        """The fields of the bones in reach, for compiled loops; None where one is no `BoneSDF`."""
        fields = [field for field in self.fields.values() if isinstance(field, BoneSDF)]
        return stack_bones(fields) if len(fields) == len(self.reached) else None

    def obstacles(self, count: int) -> Obstacles:
        """What ``count`` contact points meet in the present poses."""
        if self._allowed is None or self._allowed.shape[1] != count:
            self._allowed = np.zeros((len(self.reached), count))
            for row, b in enumerate(self.reached):
                self._allowed[row] = self.allowed.get(b, 0.0)
        if self.bones is None:
            raise TypeError("a model that asks bones from compiled loops needs BoneSDF fields")
        planes = _stacked_planes(self.neighbours) if self.neighbours else NO_PLANES
        free, known = self.free(count), self._bounds(count)
        return Obstacles(self.bones, self.placed, free, self._allowed, known, planes)

    def allow(self, bone_index: int, depth: Floats) -> None:
        """Let each contact point be up to ``depth`` (n,) inside a bone, [scene unit]; zeros take it
        back.
        """
        if np.any(depth > 0.0):
            self.allowed[bone_index] = np.array(depth, dtype=np.float64)
        else:
            self.allowed.pop(bone_index, None)
        self._allowed = None

    def distance_and_direction(
        self, points: Floats, bone_index: int, reach: Floats | float = np.inf
    ) -> tuple[Floats, Floats]:
        """Signed distance (n,) to one bone and the unit direction (n, 3) in which it grows, world
        axes.

        Where the bone is farther than ``reach``, a number or (n,), a lower bound beyond it suffices
        [scene unit].
        """
        pose, points = self.poses[self.names[bone_index]], check_points(points)
        field = self.fields[bone_index]
        distance, gradient = field.distance_and_gradient(points, pose=pose, reach=reach)
        # On the medial surface the field has no direction: away from the middle of the bone is
        # used.
        direction_loop(points, gradient, pose, self.boxes[self._row[bone_index]])
        return distance, gradient

    def distance(self, points: ArrayLike, limit: Floats | float = np.inf) -> Floats:
        """Smallest distance (n,) over bones; parameters and result as for `nearest`."""
        points = check_points(points)
        smallest, met = self._in_reach(points, limit)
        for b in met:
            pose, reach = self.poses[self.names[b]], np.minimum(smallest, limit)
            found = self.fields[b].distance(points, pose=pose, reach=reach)
            np.minimum(smallest, found, out=smallest)
        return smallest

    def nearest(self, points: ArrayLike, limit: Floats | float = np.inf) -> tuple[Floats, Floats]:
        """Smallest distance (n,) over bones, and its gradient (n, 3) in world axes, for clipping.

        [scene unit], negative inside a bone, infinity where none is in reach. Beyond ``limit``, a
        number or (n,), it is only a lower bound above the limit, without a gradient.
        """
        points = check_points(points)
        smallest, met = self._in_reach(points, limit)
        gradient = np.zeros((len(points), 3))
        for b in met:
            # No farther than what was found: elsewhere a lower bound will do.
            found = self.distance_and_direction(points, b, np.minimum(smallest, limit))
            closer_loop(*found, smallest, gradient)
        return smallest, gradient

    def _in_reach(self, points: Floats, limit: Floats | float) -> tuple[Floats, list[int]]:
        """Lower bound (n,) of the distances to bones farther than ``limit``, and the other
        bones.
        """
        apart = np.empty(len(self.reached))
        apart_loop(points, self.placed, self.boxes, apart)
        far = apart > np.max(limit, initial=0.0)
        bound = np.full(len(points), apart[far].min(initial=np.inf))
        return bound, np.array(self.reached, dtype=int)[~far].tolist()

    def excess(self, points: Floats) -> Floats:
        """How far (n,) points (n, 3) of the surface are to move inwards for sliding neighbours
        [scene unit].
        """
        return np.max(
            [np.zeros(len(points)), *(pair.excess(points) for pair in self.beside)], axis=0
        )

    def depths(self, points: Floats) -> dict[int, Floats]:
        """Depth (n,) of each free contact point in each bone, by the bone's index [scene unit]; 0
        outside.
        """
        points = check_points(points)
        found = {b: np.zeros(len(points)) for b in self.reached}
        for b, near in self.near(points, np.zeros((1, len(points)))):
            found[b][near] = np.maximum(-self._ask(points, near, b, 0.0)[0], 0.0)
        return found

    def half_spaces(self, points: ArrayLike, reach: ArrayLike) -> HalfSpaces:
        """Pairs of contact point (n, 3) and obstacle nearer than ``reach``, one or (n,) [scene
        unit].
        """
        points = check_points(points)
        reach = (
            np.full(len(points), reach)
            if np.ndim(reach) == 0
            else np.asarray(reach, dtype=np.float64)
        )
        if self.bones is None:
            spaces = self._asked_one_by_one(points, reach)
        else:
            index, row, gap, normal = find_contacts(self.obstacles(len(points)), points, reach)
            spaces = HalfSpaces(index, gap, normal, self._reached[row])
        return self.with_planes(spaces, points, reach)

    def _asked_one_by_one(self, points: Floats, reach: Floats) -> HalfSpaces:
        """Half-spaces of bones whose fields are no arrays that a loop could ask."""
        near = self.near(points, reach[None])
        most = sum(len(some) for _, some in near)
        index, source = np.empty(most, np.int64), np.empty(most, np.int64)
        gap = np.empty(most)
        normal = np.empty((most, 3))
        count = 0
        for b, some in near:
            distance, direction = self._ask(points, some, b, reach[some])
            allowed = self.allowed.get(b, NONE_ALLOWED)
            limits = reach, allowed if len(allowed) == len(points) else NONE_ALLOWED
            found = index[count:], gap[count:], normal[count:]
            end = count + take_contacts_loop(some, distance, direction, limits, found)
            source[count:end] = b
            count = end
        return HalfSpaces(index[:count], gap[:count], normal[:count], source[:count])

    def with_planes(self, spaces: HalfSpaces, points: Floats, reach: Floats) -> HalfSpaces:
        """Half-spaces of bones and, behind them, of the neighbours of contact points (n, 3) nearer
        than ``reach``.
        """
        if not self.neighbours:
            return spaces
        planes = _stacked_planes(self.neighbours)
        gap = planes.gap + np.einsum(
            "ij,ij->i", planes.normal, points[planes.point] - planes.anchor
        )
        near = gap < float(reach.max(initial=0.0))
        found = planes.point[near], gap[near], planes.normal[near], -1 - planes.kind[near]
        bones = spaces.index, spaces.gap, spaces.normal, spaces.source
        return HalfSpaces(*map(np.concatenate, zip(bones, found)))

    def near(self, points: Floats, reach: Floats) -> list[tuple[int, Integers]]:
        """Bones in reach, each with the free contact points (n, 3) that may be nearer to it than
        their reach.

        ``reach`` is (1, n) for all bones, or (r, n) for each of the bones ``reached``.
        """
        found = np.empty((len(self.reached), len(points)), dtype=np.int64)
        counts = np.zeros(len(self.reached), dtype=np.int64)
        bones = self.placed, self.boxes
        near_loop(
            points, self.free(len(points)), reach, bones, self._bounds(len(points)), found, counts
        )
        return [
            (b, near[:count])
            for b, near, count in zip(self.reached, found, counts.tolist())
            if count
        ]

    def path_lengths(
        self, start: Floats, end: Floats, before: dict[str, Floats], after: dict[str, Floats]
    ) -> Floats:
        """Lengths (r, n) of straight paths as each of the bones ``reached`` sees them, moving from
        pose to pose.
        """
        length = np.empty((len(self.reached), len(start)))
        path_loop(start, end, self.stacked(before), self.stacked(after), length)
        return length

    def free(self, count: int) -> Booleans:
        """Mask (n,) of the contact points that are attached to no bone."""
        if self.attached_bone is None:
            return np.ones(count, dtype=np.bool_)
        if len(self.attached_bone) != count:
            raise ValueError(
                f"half-spaces need all {len(self.attached_bone)} contact points, got {count}"
            )
        return self.attached_bone < 0

    def stacked(self, poses: Mapping[str, Floats]) -> Floats:
        """Poses (r, 4, 4) of the bones that the muscle can reach, in their order."""
        return np.array([poses[self.names[b]] for b in self.reached]).reshape(-1, 4, 4)

    def _bounds(self, count):
        """Positions (r, n, 3) of the last queries, in bone coordinates, and lower bounds (r, n) of
        the distances there; -infinity where nothing is known.
        """
        if self._known[1].shape[1] != count:
            rows = len(self.reached)
            self._known = Known(np.zeros((rows, count, 3)), np.full((rows, count), -np.inf))
        return self._known

    def _ask(self, points, near, b, reach):
        """Distances and directions of some of the contact points to bone b; stored as bounds for
        later queries.
        """
        pose, row = self.poses[self.names[b]], self._row[b]
        distance, gradient = self.fields[b].distance_and_gradient(
            points[near], pose=pose, reach=reach
        )
        anchor, bound = self._bounds(len(points))
        answer_loop(
            points, pose, self.boxes[row], near, distance, gradient, anchor[row], bound[row]
        )
        return distance, gradient


def _stacked_planes(kinds: Sequence[Planes]) -> PlaneStack:
    """The planes of some kinds, which may be none."""
    some = [Planes(), *kinds]
    return PlaneStack(
        np.concatenate([planes.index for planes in some]),
        np.concatenate([planes.gap for planes in some]),
        np.concatenate([planes.normal for planes in some]),
        np.concatenate([planes.anchor for planes in some]),
        np.repeat(np.arange(len(kinds)), [len(planes.index) for planes in kinds]),
        np.array([planes.softness for planes in kinds], dtype=np.float64),
    )


NO_PLANES = _stacked_planes([])
