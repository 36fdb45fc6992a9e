"""Contacts as half-spaces, with several bones and neighbouring muscles at once.

Obstacles are the bones' distance fields, which stay in bone coordinates and are never rebuilt, and, with sliding, the
surfaces of neighbouring muscles. Nothing here depends on how a muscle is represented.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.scene.tendons import AtRest
from rbfmuscle.simulation.broad_phase import (
    answer_loop,
    apart_loop,
    closer_loop,
    direction_loop,
    near_loop,
    take_contacts_loop,
)
from rbfmuscle.validation import check_points

NONE_ALLOWED: Floats = np.zeros(0)


@dataclass(frozen=True)
class HalfSpaces:
    """Linearised contacts: moving point ``index`` by ``dp`` is admissible where ``gap + normal . dp >= 0``.

    Attributes
    ----------
    index : (c,) ndarray of int
        Contact point.
    gap : (c,) ndarray
        Signed distance now [scene unit]; negative is violated.
    normal : (c, 3) ndarray
        Unit direction of growing distance, world axes.
    source : (c,) ndarray of int
        Index of the bone, or ``-1 - k`` for virtual edges of family k.
    give : (c,) ndarray or None
        Contact compliance, relative to the contact's diagonal response; None where all are rigid.
    """

    index: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    source: np.ndarray
    give: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.index)


class BoneContacts:
    """The obstacles of one muscle, in one pose.

    Parameters
    ----------
    names : sequence of str
        Names of all bones of the scene.
    fields : sequence of BoneSDF or None
        One for each name; None where the muscle cannot reach the bone. Fields may be shared between muscles.
    contact_bone : (n,) array_like of int, optional
        Bone that contact point i is attached to, -1 where free. Attached points take no contact.
    """

    def __init__(
        self,
        names: list[str],
        fields: list[Any],
        *,
        contact_bone: ArrayLike | None = None,
    ) -> None:
        if len(names) != len(fields):
            raise ValueError(f"one field per bone is needed, got {len(fields)} for {len(names)} bones")
        self.names = list(names)
        self.fields = list(fields)
        self.reached = [b for b, field in enumerate(self.fields) if field is not None]
        self._row = {b: row for row, b in enumerate(self.reached)}
        boxes = [self.fields[b].bounds for b in self.reached]
        self.boxes = np.array(boxes, dtype=np.float64).reshape(-1, 2, 3)
        self.contact_bone = None if contact_bone is None else np.asarray(contact_bone, dtype=np.int64)
        self._take(AtRest((name, np.eye(4)) for name in self.names))
        self.allowed = {}
        self.neighbours, self.cuts = [], []
        self._known: tuple[Floats, ...] = (
            np.zeros((len(self.reached), 0, 3)),
            np.zeros((len(self.reached), 0)),
        )

    def move(self, poses: dict[str, Floats]) -> None:
        """Take the bones' poses, a dict of bone name to (4, 4) rest-to-world transform."""
        missing = [self.names[b] for b in self.reached if self.names[b] not in poses]
        if missing:
            raise ValueError(f"poses lack the bone {missing[0]!r}")
        self._take(poses)

    def stacked(self, poses: dict[str, Floats]) -> Floats:
        """Poses (r, 4, 4) of the bones that the muscle can reach, in their order."""
        return np.array([poses[self.names[b]] for b in self.reached]).reshape(-1, 4, 4)

    def _take(self, poses: dict[str, Floats]) -> None:
        self.poses, self._placed = poses, self.stacked(poses)

    def frozen(self) -> BoneContacts:
        """A copy in the present poses, for queries from another thread while the bones move."""
        other = copy.copy(self)
        other.cuts, other._known = list(self.cuts), tuple(part[:, :0] for part in self._known)
        return other

    def only(self, index: Any) -> BoneContacts:
        """A copy for a subset ``index`` of the contact points."""
        other = self.frozen()
        if self.contact_bone is not None:
            other.contact_bone = self.contact_bone[index]
        other.allowed = {bone: depth[index] for bone, depth in self.allowed.items()}
        return other

    def allow(self, bone_index: Any, depth: Any) -> None:
        """Let each contact point be up to ``depth`` (n,) inside a bone, [scene unit]; zeros take it back."""
        if np.any(depth > 0.0):
            self.allowed[bone_index] = np.array(depth, dtype=np.float64)
        else:
            self.allowed.pop(bone_index, None)

    def distance_and_direction(self, points: Floats, bone_index: int) -> tuple[Floats, Floats]:
        """Signed distance (n,) to one bone and the unit direction (n, 3) in which it grows, world axes."""
        points = check_points(points)
        return self._query(points, bone_index)

    def nearest(self, points: ArrayLike, reach: float = np.inf, *, neighbours: bool = True) -> Floats:
        """Smallest distance over all bones and neighbours at any points, by which an extracted surface is clipped.

        Parameters
        ----------
        points : (n, 3) array_like
        reach : float
            Where a bone is farther than this, a lower bound beyond ``reach`` suffices [scene unit].
        neighbours : bool
            Count sliding neighbours.

        Returns
        -------
        (n,) ndarray
            [scene unit], negative inside a bone; infinity where no bone is in reach. Against a sliding
            neighbour it is half the difference of the two muscles' distances, so that both are cut alike.
        """
        points = check_points(points)
        near, beyond = self._within(points, reach)
        smallest = np.full(len(points), beyond)
        for b in near:
            pose = self.poses[self.names[b]]
            distance = self.fields[b].distance(points, pose=pose, reach=np.minimum(smallest, reach))
            np.minimum(smallest, distance, out=smallest)
        for neighbour in self.cuts if neighbours else ():
            np.minimum(smallest, neighbour.cut(points), out=smallest)
        return smallest

    def nearest_with_gradient(
        self, points: Floats, limit: Floats | float = np.inf, *, neighbours: bool = True
    ) -> tuple[Floats, Floats]:
        """Smallest distance (n,) over bones and, where wanted, neighbours, exact, and its gradient (n, 3), world axes.

        Where the smallest distance exceeds ``limit``, a number or (n,), the value is only a lower bound above the
        limit, without a gradient.
        """
        points = check_points(points)
        near, beyond = self._within(points, limit)
        smallest, gradient = np.full(len(points), beyond), np.zeros((len(points), 3))
        for b in near:
            # No farther than what was found: elsewhere a lower bound will do.
            closer_loop(*self._query(points, b, np.minimum(smallest, limit)), smallest, gradient)
        for neighbour in self.cuts if neighbours else ():
            closer_loop(*neighbour.cut_with_gradient(points), smallest, gradient)
        return smallest, gradient

    def neighbour_points(self) -> Floats:
        """Points (k, 3) of sliding neighbours where these meet the muscle [scene unit]."""
        return np.concatenate([np.zeros((0, 3)), *(neighbour.points() for neighbour in self.cuts)])

    def depth(self, points: Floats) -> float:
        """Greatest depth of a free contact point in a bone [scene unit]; 0 if all are outside."""
        return max([0.0, *(-float(distance.min()) for _, _, distance in self._inside(points))])

    def depths(self, points: Floats) -> dict[int, Floats]:
        """Depth (n,) of each free contact point in each bone, by the bone's index [scene unit]; 0 outside."""
        found = {b: np.zeros(len(points)) for b in self.reached}
        for b, near, distance in self._inside(points):
            found[b][near] = np.maximum(-distance, 0.0)
        return found

    def comes_near(self, points: Floats, bone_index: int, reach: float) -> bool:
        """Whether a bone is nearer than ``reach`` to any free contact point."""
        asked = self._near(points, np.full(len(points), reach), [bone_index])
        return any(self._ask(points, near, b, reach)[0].min() < reach for b, near in asked)

    def half_spaces(self, points: ArrayLike, reach: ArrayLike) -> HalfSpaces:
        """All pairs of contact point and obstacle nearer than ``reach``, as :class:`HalfSpaces`.

        Parameters
        ----------
        points : (n, 3) array_like
            The model's contact points, in their order.
        reach : float or (n,) array_like
            For all, or for each point [scene unit].
        """
        points = check_points(points)
        reach = np.full(len(points), reach) if np.ndim(reach) == 0 else np.asarray(reach, dtype=np.float64)
        near = self._near(points, reach, self.reached)
        room = sum(len(some) for _, some in near)
        index, source = np.empty(room, np.int64), np.empty(room, np.int64)
        gap, normal, count = np.empty(room), np.empty((room, 3)), 0
        for b, some in near:
            distance, direction = self._ask(points, some, b, reach[some])
            allowed = self.allowed.get(b, NONE_ALLOWED)
            limits = reach, allowed if len(allowed) == len(points) else NONE_ALLOWED
            found = index[count:], gap[count:], normal[count:]
            end = count + take_contacts_loop(some, distance, direction, limits, found)
            source[count:end] = b
            count = end
        spaces = HalfSpaces(index[:count], gap[:count], normal[:count], source[:count])
        return (
            self._with_neighbours(spaces, points, float(reach.max(initial=0.0)))
            if self.neighbours
            else spaces
        )

    def _with_neighbours(self, bones: HalfSpaces, points: Floats, reach: float) -> HalfSpaces:
        """The half-spaces of the bones, then those of the neighbours."""
        parts = [(bones.index, bones.gap, bones.normal, bones.source, np.zeros(len(bones)))]
        for k, neighbour in enumerate(self.neighbours):
            index, gap, normal = neighbour.contacts(points, reach)
            count = len(index)
            parts.append((index, gap, normal, np.full(count, -1 - k), np.full(count, neighbour.give)))
        return HalfSpaces(*(np.concatenate(part) for part in zip(*parts)))

    def known(self, count: int) -> tuple[Floats, ...]:
        """Positions (r, count, 3) of the last queries, in the coordinates of each bone in reach, and bounds of the
        distances there, (r, count); -infinity where nothing is known.
        """
        if self._known[1].shape[1] != count:
            rows = len(self.reached)
            self._known = np.zeros((rows, count, 3)), np.full((rows, count), -np.inf)
        return self._known

    def free(self, count: int) -> Booleans:
        """Mask (n,) of the contact points that are attached to no bone."""
        if self.contact_bone is None:
            return np.ones(count, dtype=np.bool_)
        if len(self.contact_bone) != count:
            raise ValueError(f"half-spaces need all {len(self.contact_bone)} contact points, got {count}")
        return self.contact_bone < 0

    def _query(self, points, b, reach=np.inf):
        pose = self.poses[self.names[b]]
        distance, gradient = self.fields[b].distance_and_gradient(points, pose=pose, reach=reach)
        # On the medial surface the field has no direction: away from the middle of the bone is used.
        direction_loop(points, gradient, pose, self.boxes[self._row[b]])
        return distance, gradient

    def _within(self, points, limit):
        """Bones whose box is within the greatest limit of the points' box, and a bound of the others' distance."""
        apart = np.empty(len(self.reached))
        apart_loop(points, self._placed, self.boxes, apart)
        far = apart > np.max(limit, initial=0.0)
        return [b for b, left in zip(self.reached, far) if not left], apart[far].min(initial=np.inf)

    def _near(self, points, reach, bones):
        """Bones, each with the free contact points that may be nearer to it than their ``reach``."""
        rows = np.array([self._row[b] for b in bones], dtype=np.int64)
        found, counts = (
            np.empty((len(rows), len(points)), dtype=np.int64),
            np.zeros(len(rows), dtype=np.int64),
        )
        free, known = self.free(len(points)), self.known(len(points))
        near_loop(points, free, reach, rows, (self._placed, self.boxes), known, found, counts)
        return [(b, near[:count]) for b, near, count in zip(bones, found, counts.tolist()) if count]

    def _inside(self, points):
        """Bones, each with the free contact points that may be inside it and their distances."""
        points = check_points(points)
        for b, near in self._near(points, np.zeros(len(points)), self.reached):
            yield b, near, self._ask(points, near, b, 0.0)[0]

    def _ask(self, points, near, b, reach):
        """Distances and directions of some of the contact points to bone b; stored as bounds for later queries."""
        pose, row = self.poses[self.names[b]], self._row[b]
        distance, gradient = self.fields[b].distance_and_gradient(points[near], pose=pose, reach=reach)
        anchor, bound = self.known(len(points))
        answer_loop(points, pose, self.boxes[row], near, distance, gradient, anchor[row], bound[row])
        return distance, gradient
