"""Tendons: lines from the end of a muscle's belly to the insertion, along which that end moves.

A taut string runs from the muscle's other end past the belly's end and the via points to the
insertion, around the bones. It takes up a change of its length as two springs in series do: the
tendon's strain is `STIFFNESS_RATIO` of the belly's, at most `TENDON_STRAIN`, and zero where the
string is shorter than at rest. The belly's end lies on the string at the tendon's length from the
insertion, displaced from it as at rest and out of the bones. Ends that touch each other and lead to
one bone, as those of two vasti at the patella, have a common string, and slide on each other only
as far as their tendons keep their lengths. All this depends on the poses of the bones alone and
continuously: a pose has the same ends however it is reached.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import Floats, across, to_local, to_world, unit
from rbfmuscle.geometry.lines import distance_along, line_length, points_along, taut_line
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.scene.options import TENDON_STRAIN

# Strain of a passive belly at which it bears the force that strains its tendon by `TENDON_STRAIN`
# (Zajac 1989), and the tendon's strain over the belly's.
BELLY_STRAIN = 0.6
STIFFNESS_RATIO = TENDON_STRAIN / BELLY_STRAIN
SHORTER = 0.9  # a string so much shorter on the belly's side passes bones there
CHORD = 0.06  # the string's direction is that of a chord so long, in lengths of the string
# Steps to the place of the end where its tendon has the wanted length, and the relative error that
# ends them.
STEPS, TOLERANCE = 8, 1e-9
LEAST_COSINE = 0.5  # of the way of an end against its tendon, or it would go too far
NODES = 33  # points of a tendon as it is drawn
AROUND = 16  # directions around a leg of the string, on one of whose sides it passes the bones

# A bone and a point (3,) of it at rest [scene unit].
BonePoint: TypeAlias = tuple[str, Floats]


def tendon_name(muscle: str) -> str:
    """Name of the mesh of a muscle's tendons in files and viewers."""
    return f"{muscle}_tendon"


class TendonLine(NamedTuple):
    """A tendon as it is drawn: points (n, 3) from the belly's end to the insertion, and its radii
    at both; ``settled`` says whether it has its length.
    """

    points: Floats
    radii: tuple[float, float]
    settled: bool = True


# The pose (4, 4) of every bone, and of every end, at rest.
AT_REST: Mapping[str, Floats] = defaultdict(lambda: np.eye(4))


class Poses(dict[str, Floats]):
    """Poses (4, 4) of bones by name; those of ends that tendons hold are computed when they are
    first asked for.

    ``tendons`` are the `TendonLine` of the ends asked for so far.
    """

    def __init__(self, bones: Mapping[str, Floats], ends: Mapping[str, TendonEnd]) -> None:
        super().__init__(bones)
        self._ends = ends
        self.tendons: dict[str, TendonLine] = {}

    def __missing__(self, name: str) -> Floats:
        self.tendons[name], self[name] = self._ends[name].place(self, self._ends.values())
        return self[name]


class Carried(NamedTuple):
    """How a string carries the end of a belly: points x at rest to turn x + shift, beside the
    string as at rest and out of bones.
    """

    turn: Floats  # (3, 3)
    shift: Floats  # (3,)
    strain: float  # of the tendon
    passed: int  # via points that the end has passed


@dataclass(eq=False)
class TendonEnd:
    """The end of a belly that a tendon joins to a bone."""

    name: str  # of the end among the poses
    patch: Floats  # vertices of the end (n, 3) at rest [scene unit]
    middle: Floats  # of the patch (3,)
    radii: tuple[float, float]  # of the belly there, and of the tendon as it is drawn [scene unit]
    line: list[BonePoint]  # via points, then the insertion
    # The muscle's other end: a point of its bone, or of its tendon the insertion and the via
    # points.
    other: list[BonePoint] = field(default_factory=list)
    opposite_length: float = 0.0  # of that tendon at rest, zero where there is none
    obstacles: Sequence[Bone] = ()  # bones that string and tendon go around

    @cached_property
    def length(self) -> float:
        """Of the tendon at rest [scene unit]."""
        return line_length(self._tendon(self.middle, 0, AT_REST))

    @cached_property
    def _rest(self) -> tuple[float, Floats, Floats]:
        """Length of the string at rest, its point (3,) at the tendon's length from the insertion,
        and the direction (3,) there.
        """
        legs = self._string(AT_REST)
        point, direction, _ = _point_on(legs, self.length)
        return sum(map(line_length, legs)), point, direction

    @cached_property
    def _sides(self) -> list[Floats]:
        """Directions (3,) at rest on whose side each leg of the string passes the bones: out of the
        nearest bone, or towards the belly's end where the string is shorter by a tenth that way.

        A leg that would lie deeper in a bone than its radius, as between two bones, takes the side
        on which it is shortest of those where it lies least deep.
        """
        stops = [point for _, point in (*self.other, *self.line)]
        places = [0.5 * (a + b) for a, b in itertools.pairwise(stops)]
        belly = len(self.other) - 1
        places[belly] = self.middle
        sides = [_outwards(self.obstacles, *leg) for leg in zip(places, stops, stops[1:])]
        along = [unit(b - a) for a, b in itertools.pairwise(stops)]
        own = unit(across(self.middle - stops[belly], along[belly]))
        by_end, outwards = (line_length(self._leg(belly, s, AT_REST)) for s in (own, sides[belly]))
        if by_end < SHORTER * outwards:
            sides[belly] = own
        for leg, side in enumerate(sides):
            if _too_deep(self._leg(leg, side, AT_REST), self.obstacles, self.radii[1]) > 0.0:
                around = [
                    rotation_about(along[leg], angle, np.zeros(3))[:3, :3] @ side
                    for angle in 2.0 * np.pi / AROUND * np.arange(AROUND)
                ]
                lines = [self._leg(leg, direction, AT_REST) for direction in around]
                faults = [
                    (_too_deep(line, self.obstacles, self.radii[1]), line_length(line))
                    for line in lines
                ]
                sides[leg] = around[faults.index(min(faults))]
        return sides

    def place(
        self, poses: Mapping[str, Floats], others: Iterable[TendonEnd] = ()
    ) -> tuple[TendonLine, Floats]:
        """The tendon, and the pose (4, 4) of the belly's end from rest to world, at poses (4, 4) of
        the bones. ``others`` are ends that may touch it.
        """
        ends = self._joined(others)
        carrying = self if len(ends) == 1 else _common_end(ends)
        turn, shift, strain, passed = carrying._carry(poses)
        middle = turn @ self.middle + shift
        length = self.length * (1.0 + strain)
        settled = False
        for _ in range(STEPS):
            tendon = self._tendon(middle, passed, poses)
            excess = line_length(tendon) - length
            settled = abs(excess) <= TOLERANCE * length
            if settled:
                break
            # A taut line becomes shorter by as much as its end goes along it. An end goes to a via
            # point, whatever corners of bones the line passes on the way there.
            along = unit(tendon[1] - tendon[0])
            way = along
            if passed < len(self.line) - 1:
                way = unit(_moved(*self.line[passed], poses) - middle)
            middle = middle + excess / max(float(along @ way), LEAST_COSINE) * way
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, middle - turn @ self.middle
        line = _lifted(_with_nodes(tendon), self.obstacles, self.radii[1], poses)
        return TendonLine(line, self.radii, settled), pose

    def _joined(self, ends: Iterable[TendonEnd]) -> tuple[TendonEnd, ...]:
        """This end, and those of others that have a common string with it: they touch each other,
        and the same bones hold their strings.
        """
        found = {self}
        left = [end for end in ends if end is not self and end._bones == self._bones]
        while touching := {end for end in left if any(map(end._touches, found))} - found:
            found |= touching
        return tuple(sorted(found, key=lambda end: end.name))

    def _touches(self, other: TendonEnd) -> bool:
        away = float(np.linalg.norm(self.middle - other.middle))
        return away < self.radii[0] + other.radii[0]

    @cached_property
    def _bones(self) -> tuple[list[str], list[str]]:
        """Names of those that hold the string's fixed points before and after the end."""
        return [bone for bone, _ in self.other], [bone for bone, _ in self.line]

    def _carry(self, poses: Mapping[str, Floats]) -> Carried:
        at_rest, before, along_before = self._rest
        legs = self._string(poses)
        longer = sum(map(line_length, legs)) - at_rest
        tendons = self.length + self.opposite_length
        belly = max(at_rest - tendons, 0.0)
        strain = STIFFNESS_RATIO * longer / max(belly + STIFFNESS_RATIO * tendons, 1e-300)
        strain = min(max(strain, 0.0), TENDON_STRAIN)
        now, along_now, ended = _point_on(legs, self.length * (1.0 + strain))
        turn = self._turn(along_before, along_now, poses)
        middle = now + turn @ (self.middle - before)
        middle = middle + self._lift(turn, middle, along_now, poses)
        passed = max(0, ended - len(self.other) + 1)
        return Carried(turn, middle - turn @ self.middle, strain, passed)

    def _lift(
        self, turn: Floats, middle: Floats, direction: Floats, poses: Mapping[str, Floats]
    ) -> Floats:
        """Shift (3,) across the string that takes the patch out of bones, as far as it is deeper
        there than at rest.
        """
        points = (self.patch - self.middle) @ turn.T + middle
        deepest = 0.0
        for bone, at_rest in zip(self.obstacles, self._rest_depths):
            local = to_local(points, poses[bone.name])
            deepest = max(deepest, float((_depths(bone, local) - at_rest).max()))
        near, far = (poses[bone][:3, :3] for bone, _ in (self.other[-1], self.line[0]))
        side = (near + far) @ self._sides[len(self.other) - 1]
        side = side - (side @ direction) * direction
        return deepest * side / max(float(np.linalg.norm(side)), 1e-300)

    @cached_property
    def _rest_depths(self) -> list[Floats]:
        """Depth (n,) of the patch in each obstacle at rest."""
        return [_depths(bone, self.patch) for bone in self.obstacles]

    def _string(self, poses: Mapping[str, Floats]) -> list[Floats]:
        """Legs of the string, each from one of its fixed points to the next."""
        return [self._leg(leg, side, poses) for leg, side in enumerate(self._sides)]

    def _tendon(self, middle: Floats, passed: int, poses: Mapping[str, Floats]) -> Floats:
        """The line from the belly's end to the insertion, without the via points that the end has
        passed.
        """
        first, *others = list(enumerate(self._sides))[len(self.other) - 1 + passed :]
        rest = [self._leg(leg, side, poses)[1:] for leg, side in others]
        return np.concatenate([self._leg(*first, poses, start=middle), *rest])

    def _leg(
        self, leg: int, side: Floats, poses: Mapping[str, Floats], *, start: Floats | None = None
    ) -> Floats:
        """Taut line (n, 3) of one leg of the string, or of what is left of it from ``start``; its
        side (3,) turns half with the bone of either end.
        """
        near, far = [*self.other, *self.line][leg : leg + 2]
        start = _moved(*near, poses) if start is None else start
        turned = (poses[near[0]][:3, :3] + poses[far[0]][:3, :3]) @ side
        bones = [(poses[bone.name], bone.surface_points) for bone in self.obstacles]
        return taut_line(start, _moved(*far, poses), turned, bones, self.radii[0])

    def _turn(self, before: Floats, now: Floats, poses: Mapping[str, Floats]) -> Floats:
        """Rotation (3, 3) from one direction to the other; the twist between two fixed points is
        spread evenly.
        """
        # Seen from the bones of the string's fixed points before and after the end it would be the
        # least rotation.
        near, far = (poses[bone][:3, :3] for bone, _ in (self.other[-1], self.line[0]))
        first, last = (turn @ _least_turn(turn.T @ now, before) for turn in (near, far))
        twist = last @ first.T
        skew = np.array(
            [twist[2, 1] - twist[1, 2], twist[0, 2] - twist[2, 0], twist[1, 0] - twist[0, 1]]
        )
        # At rest the end lies so far along the way between those points.
        way = [float(np.linalg.norm(self.middle - p)) for _, p in (self.other[-1], self.line[0])]
        share = way[0] / max(sum(way), 1e-300)
        angle = share * np.arctan2(skew @ now, np.trace(twist) - 1.0)
        return rotation_about(now, float(angle), np.zeros(3))[:3, :3] @ first


@lru_cache(maxsize=64)
def _common_end(ends: tuple[TendonEnd, ...]) -> TendonEnd:
    """One end in place of some that touch each other, on the mean of their strings."""
    areas = np.array([end.radii[0] ** 2 for end in ends])

    def mean(points: Iterable[Floats]) -> Floats:
        return np.average(list(points), axis=0, weights=areas)

    def means(places: Iterable[list[BonePoint]]) -> list[BonePoint]:
        return [(stop[0][0], mean(point for _, point in stop)) for stop in zip(*places)]

    return TendonEnd(
        name=" and ".join(end.name for end in ends),
        patch=np.concatenate([end.patch for end in ends]),
        middle=mean(end.middle for end in ends),
        radii=(float(np.sqrt(areas.sum())), max(end.radii[1] for end in ends)),
        line=means(end.line for end in ends),
        other=means(end.other for end in ends),
        opposite_length=float(np.average([end.opposite_length for end in ends], weights=areas)),
        obstacles=ends[0].obstacles,
    )


def _too_deep(line: Floats, bones: Sequence[Bone], radius: float) -> float:
    """How much deeper than a radius a line (n, 3) at rest lies in a bone."""
    inner = _with_nodes(line)[1:-1]
    depths = (float(_depths(bone, inner).max()) for bone in bones)
    return max(max(depths, default=0.0) - radius, 0.0)


def _outwards(bones: Sequence[Bone], place: Floats, start: Floats, end: Floats) -> Floats:
    """Unit direction (3,) across a leg, out of or away from the bone nearest to a place (3,), all
    at rest.
    """
    found = (bone.nearest(place[None]) for bone in bones)
    distance, closest = min(((float(d[0]), c[0]) for d, c in found), key=lambda one: one[0])
    outwards = place - closest if distance > 0.0 else closest - place
    return unit(across(outwards, unit(end - start)))


def _lifted(
    line: Floats, bones: Sequence[Bone], radius: float, poses: Mapping[str, Floats]
) -> Floats:
    """A line (n, 3) whose inner points that graze a bone, no deeper than a radius, are moved to its
    surface.
    """
    line = line.copy()
    for bone in bones:
        pose = poses[bone.name]
        local = to_local(line[1:-1], pose)
        low, high = bone.bounds
        near = np.flatnonzero(((local > low) & (local < high)).all(axis=1))
        if len(near):
            distance, places = bone.nearest(local[near])
            graze = (distance < 0.0) & (distance > -radius)
            line[1 + near[graze]] = to_world(places[graze], pose)
    return line


def _with_nodes(line: Floats) -> Floats:
    """`NODES` points along a line (n, 3), its corners among them, the others at even distances."""
    along = distance_along(line)
    places = np.linspace(0.0, along[-1], NODES)
    free = places.copy()
    free[[0, -1]] = np.inf
    for corner in along[1:-1][: NODES - 2]:
        nearest = np.argmin(np.abs(free - corner))
        places[nearest], free[nearest] = corner, np.inf
    return points_along(line, np.sort(places))


def _depths(bone: Bone, points: Floats) -> Floats:
    """Depth (n,) of points (n, 3) in a bone at rest, 0 outside."""
    low, high = bone.bounds
    if np.any(points.min(axis=0) > high) or np.any(points.max(axis=0) < low):
        return np.zeros(len(points))
    return np.maximum(-bone.nearest(points)[0], 0.0)


def _moved(bone: str, point: Floats, poses: Mapping[str, Floats]) -> Floats:
    """A point of a bone (3,) at rest, where the bone is now."""
    return poses[bone][:3, :3] @ point + poses[bone][:3, 3]


def _point_on(legs: Sequence[Floats], distance: float) -> tuple[Floats, Floats, int]:
    """The point (3,) of a string at a distance along it from its end, the direction (3,) there, and
    how many legs end before it.
    """
    ends = np.cumsum([line_length(leg) for leg in legs])
    place, half = max(float(ends[-1]) - distance, 0.0), 0.5 * CHORD * float(ends[-1])
    point, behind, ahead = points_along(
        np.concatenate(legs), place + half * np.array([0.0, -1.0, 1.0])
    )
    chord = ahead - behind
    direction = chord / max(float(np.linalg.norm(chord)), 1e-300)
    return point, direction, int((ends[:-1] <= place).sum())


def _least_turn(now: Floats, before: Floats) -> Floats:
    """Least rotation (3, 3) that takes one direction (3,) to another."""
    axis, cosine = np.cross(before, now), float(before @ now)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + skew + skew @ skew / max(1.0 + cosine, 1e-9)
