"""Points that pass through a bone within one sub-step: the angle test, the swept test, the
correction.

Both tests look at a point's path relative to the bone, that is in bone coordinates. The angle test
compares the directions to the bone at the two ends (Cervenka et al. 2023, equation 1, with the
bound on d . d' stated as the text means it: below cos 135 degrees); it misses most short crossings.
The swept test follows the path by sphere tracing (Hart 1996) in the bone's distance field and
cannot miss what is thicker than its tolerance.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.bones.broad_phase import box_loop, boxes_apart, may_reach
from rbfmuscle.bones.obstacles import query_bone
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.jit import compiled
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.simulation.contact import BoneContacts, Planes

if TYPE_CHECKING:
    import trimesh

# 135 degrees, the bound of the angle test.
RIGHT_ANGLE_AND_HALF = 0.75 * math.pi
# The field's interpolation may change a little faster than the distance does.
STEP_SHARE = 0.9
# A path that leaves a bone facing within 90 degrees of where it went in has slid along, not passed
# through.
SLIDING_COSINE = 0.0
# Halvings of a path to show that it stays outside; it is traced where they do not.
HALVINGS = 5
# Greatest number of steps in tracing a path.
MAX_ROUNDS = 10_000
# Spacing, relative to the tolerance, of positions on a path that are compared with a bone's
# triangles.
GRAZE_STRIDE = 0.2


@dataclass(frozen=True)
class Sweep:
    """Result of following the paths of some points at one bone."""

    index: np.ndarray  # (c,) points whose paths may have touched the bone
    lowest: np.ndarray  # (c,) smallest distance along the path [scene unit], negative inside
    through: (
        np.ndarray
    )  # (c,) entered deeper than the tolerance, and left (or ended) in another direction
    flagged: (
        np.ndarray
    )  # (c,) directions at the two ends differ by more than the angle test's bound


@dataclass(frozen=True)
class Crossing:
    """Points that passed through one of the bones in reach in a step, and how many the angle test
    flags.
    """

    bone: int
    index: np.ndarray
    flagged: int


def sweep_paths(
    field: BoneSDF,
    start: Floats,
    end: Floats,
    *,
    tolerance: float,
    angle: float = RIGHT_ANGLE_AND_HALF,
) -> Sweep:
    """Follow straight paths (n, 3) in bone coordinates through a bone's distance field.

    No depth below ``tolerance``, the field's own error [scene unit], counts; ``angle`` bounds the
    angle test [radian].
    """
    length = np.linalg.norm(end - start, axis=1)
    distance = field.distance(start, reach=float(length.max(initial=0.0)))
    index = np.flatnonzero(distance < length)
    last = field.distance(end[index])
    near = distance[index] + last <= length[index] + tolerance
    index = index[near]
    if len(index) == 0:
        nothing = np.zeros(0, dtype=bool)
        return Sweep(index, np.zeros(0), nothing, nothing)
    start, end = start[index], end[index]
    lowest, first, last = _trace(field, start, end, tolerance)
    through = np.zeros(len(index), dtype=bool)
    deep = np.flatnonzero(lowest < -tolerance)
    if len(deep):
        way = end[deep] - start[deep]
        entry = _directions(field, start[deep] + first[deep, None] * way)
        leave = _directions(field, start[deep] + last[deep, None] * way)
        through[deep] = np.einsum("ij,ij->i", entry, leave) < SLIDING_COSINE
    cosine = np.einsum("ij,ij->i", _directions(field, start), _directions(field, end))
    return Sweep(index, lowest, through, cosine < math.cos(angle))


def find_crossings(
    contacts: BoneContacts,
    start: Floats,
    end: Floats,
    before: Mapping[str, Floats],
    after: Mapping[str, Floats],
    options: TunnellingOptions,
    *,
    tolerance: float,
) -> list[Crossing]:
    """Bones that points (n, 3) crossed, or that the angle test flags, while the bones went between
    two poses.

    Points are in world coordinates, the contacts in the poses ``after``, the tolerance in the
    scene's unit.
    """
    crossings: list[Crossing] = []
    angle = math.radians(options.angle)
    obstacles, old = contacts.obstacles(), contacts.bones.place(before)
    found, count = suspect_paths(obstacles, start, end, old, math.cos(angle), tolerance)
    if count == 0:
        return crossings
    for b in np.flatnonzero(found.any(axis=1)).tolist():
        name, index = contacts.bones.names[b], np.flatnonzero(found[b])
        first, second = _local(start[index], before[name]), _local(end[index], after[name])
        field = contacts.bones.fields[b]
        sweep = sweep_paths(field, first, second, tolerance=tolerance, angle=angle)
        if sweep.through.any() or sweep.flagged.any():
            crossed = index[sweep.index[sweep.through]]
            crossings.append(Crossing(b, crossed, int(sweep.flagged.sum())))
    return crossings


def one_sided_planes(
    contacts: BoneContacts,
    crossing: Crossing,
    start: Floats,
    before: Mapping[str, Floats],
    after: Mapping[str, Floats],
) -> Planes:
    """A half-space for each point that crossed, to hold it on its side of the bone.

    The plane lies between the point and the bone, normal to the distance's gradient, and moves with
    the bone.
    """
    bones = contacts.bones
    name, field = bones.names[crossing.bone], bones.fields[crossing.bone]
    motion, points = after[name] @ np.linalg.inv(before[name]), start[crossing.index]
    local = _local(points, before[name])
    distance = field.distance(local)
    way = _directions(field, local) @ after[name][:3, :3].T
    planes = Planes()
    planes.set(crossing.index, distance, way, points @ motion[:3, :3].T + motion[:3, 3])
    return planes


def only_grazed(
    crossing: Crossing,
    mesh: "trimesh.Trimesh",
    paths: tuple[Floats, Floats],
    before: Floats,
    after: Floats,
    tolerance: float,
) -> bool:
    """Whether, by the exact distance to the bone's triangles, no path was deeper than ``tolerance``
    [scene unit].

    Paths hold contact points (n, 3) before and after the step in world coordinates, ``before`` and
    ``after`` the bone's poses (4, 4).
    """
    exact = ExactDistance(mesh.vertices, mesh.faces)
    if (exact.across < 0).any():  # not closed
        return False
    for n in crossing.index:
        first, last = (
            np.linalg.solve(pose, np.append(points[n], 1.0))[:3]
            for points, pose in zip(paths, (before, after))
        )
        count = int(np.linalg.norm(last - first) / (GRAZE_STRIDE * tolerance)) + 2
        if count > MAX_ROUNDS:
            return False
        places = first + np.linspace(0.0, 1.0, count)[:, None] * (last - first)
        # Between two places no depth is greater than there by more than half their distance.
        if exact.signed_distance(places).min() < -(1.0 - 0.5 * GRAZE_STRIDE) * tolerance:
            return False
    return True


def _trace(field, start, end, tolerance):
    """Smallest distance along each path, and the places (fraction) right before it first went in
    and after it came out.

    Directions are compared outside the bone: near the medial surface of a crest they may be either
    side's.
    """
    length = np.linalg.norm(end - start, axis=1)
    lowest = np.full(len(start), np.inf)
    entry, leave, at, before = (np.zeros(len(start)) for _ in range(4))
    entered, within = np.zeros(len(start), dtype=bool), np.zeros(len(start), dtype=bool)
    under_way = np.arange(len(start))
    for _ in range(MAX_ROUNDS):
        t = at[under_way]
        distance = field.distance(
            start[under_way] + t[:, None] * (end[under_way] - start[under_way])
        )
        lowest[under_way] = np.minimum(lowest[under_way], distance)
        inside = distance < 0.0
        first = under_way[inside & ~entered[under_way]]
        entry[first] = before[first]
        entered[first] = True
        crossed = under_way[inside | within[under_way]]
        leave[crossed] = at[crossed]
        within[under_way], before[under_way] = inside, t
        # Between two places outside, d and d' from the bone and s apart, no place is deeper than (s
        # - d - d') / 2: with s = d + tolerance that is less than the tolerance where the second
        # place is not itself that deep.
        outside = STEP_SHARE * distance + 0.9 * tolerance
        stride = np.where(inside, np.maximum(-0.5 * distance, 0.5 * tolerance), outside)
        at[under_way] = np.minimum(t + stride / np.maximum(length[under_way], 1e-300), 1.0)
        under_way = under_way[t < 1.0]
        if len(under_way) == 0:
            break
    # What is too long to be followed counts as inside, and is judged by its ends.
    lowest[under_way] = -np.inf
    entry[under_way] = 0.0
    leave[under_way] = 1.0
    return lowest, entry, leave


def _directions(field, points):
    gradient = field.distance_and_gradient(points)[1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)[:, None]


def _local(points, pose):
    """Points in the coordinates of a bone in a rigid pose."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


@compiled
def suspect_paths(obstacles, start, end, before, cosine, tolerance):
    """Mask (b, n) of paths of points that may touch a bone by more than the tolerance, or that the
    angle test flags: whose directions at the bone differ by less than the ``cosine``.

    Bones go from the poses ``before`` (b, 4, 4) to those of the obstacles. Also how many they are.
    """
    total = 0
    found = np.zeros((len(before), len(end)), np.bool_)
    free, known = obstacles.free, obstacles.known
    boxes = np.empty((2, 2, 3))
    box_loop(start, free, boxes[0])
    box_loop(end, free, boxes[1])
    moved = _greatest_move(start, end, free)
    some = np.empty(len(end), np.int64)
    for b in range(len(before)):
        pose, bounds = obstacles.poses[b], obstacles.bones.boxes[b]
        longest = moved + _bone_move(boxes[0], before[b], pose)
        if boxes_apart(boxes[1], pose, bounds) > longest:
            continue
        many, count = 0, 0
        anchor, bound = known.anchor[b], known.bound[b]
        for i in range(len(end)):
            some[many] = i
            many += free[i] & may_reach(end, i, pose, bounds, anchor, bound, longest)
        first, last = np.empty((many, 3)), np.empty((many, 3))
        for i in some[:many]:
            _to_bone(start[i], before[b], first[count])
            _to_bone(end[i], pose, last[count])
            # A path that is shorter than the distance of its end touches nothing.
            length = np.sqrt(((last[count] - first[count]) ** 2).sum())
            some[count] = i
            count += may_reach(end, i, pose, bounds, anchor, bound, length)
        first, last = first[:count], last[:count]
        unclear = unclear_paths(obstacles.bones, b, first, last, cosine, tolerance)
        for k in range(count):
            found[b, some[k]] = unclear[k]
            total += unclear[k]
    return found, total


@compiled
def _greatest_move(start, end, free):
    """How far a free point moves at most."""
    most = 0.0
    for i in range(len(start)):
        square = 0.0
        for k in range(3):
            square += (end[i, k] - start[i, k]) ** 2
        most = max(most, square * free[i])
    return np.sqrt(most)


@compiled
def _bone_move(box, before, after):
    """How far a bone takes a point of a box (2, 3) at most, from one pose to another; it is a
    corner.
    """
    most = 0.0
    corner = np.empty(3)
    local = np.empty(3)
    for n in range(8):
        for k in range(3):
            corner[k] = box[n >> k & 1, k]
        _to_bone(corner, before, local)
        square = 0.0
        for k in range(3):
            way = after[k, 3] - corner[k]
            for j in range(3):
                way += after[k, j] * local[j]
            square += way * way
        most = max(most, square)
    return np.sqrt(most)


@compiled
def _to_bone(point, pose, out):
    """A point in the coordinates of a bone in a rigid pose."""
    for a in range(3):
        out[a] = 0.0
        for k in range(3):
            out[a] += pose[k, a] * (point[k] - pose[k, 3])


class Pieces(NamedTuple):
    """Pieces of straight paths, all of the same share of theirs."""

    path: np.ndarray  # (m,) which path
    at: np.ndarray  # (m,) where it begins [share of the path]
    near: np.ndarray  # (m,) distance from the bone there [scene unit]
    far: np.ndarray  # (m,) and at its other end


@compiled
def _doubtful(pieces, length, tolerance, found):
    """Pieces, of ``length`` by path, that may be deeper in a bone than the tolerance, of paths that
    are not ``found`` to be.
    """
    left = np.empty(len(pieces.path), np.bool_)
    for k, one in enumerate(pieces.path):
        deepest = pieces.near[k] + pieces.far[k] - length[one]
        left[k] = deepest < -2.0 * tolerance and not found[one]
    return Pieces(pieces.path[left], pieces.at[left], pieces.near[left], pieces.far[left])


@compiled
def unclear_paths(bones, b, start, end, cosine, tolerance):
    """Mask (n,) of straight paths (n, 3), in the coordinates of bone b, that may come deeper into
    it than the tolerance, or whose directions at the ends differ by less than the ``cosine``.

    Paths are halved: between two places s apart, at distances d and d' from the bone, nothing is
    deeper than (s - d - d') / 2.
    """
    count, pose = len(start), np.eye(4)
    length, found = np.empty(count), np.zeros(count, np.bool_)
    for k in range(count):
        length[k] = np.sqrt(((end[k] - start[k]) ** 2).sum())
    first, last = np.empty(count), np.empty(count)
    way, out = np.empty((count, 3)), np.empty((count, 3))
    query_bone(bones, b, pose, start, length, first, way)
    query_bone(bones, b, pose, end, length + tolerance, last, out)
    left = (first < length) & (first + last <= length + tolerance)
    path = np.flatnonzero(left)
    for k in path:
        found[k] = min(first[k], last[k]) < -tolerance or (way[k] * out[k]).sum() < cosine
    pieces = Pieces(path, np.zeros(len(path)), first[path], last[path])
    size = 1.0
    for _ in range(HALVINGS):
        pieces = _doubtful(pieces, size * length / STEP_SHARE, tolerance, found)
        size *= 0.5
        middle, between = np.empty((len(pieces.path), 3)), np.empty(len(pieces.path))
        for k, one in enumerate(pieces.path):
            middle[k] = start[one] + (pieces.at[k] + size) * (end[one] - start[one])
        query_bone(bones, b, pose, middle, np.full(len(middle), np.inf), between, way[:0])
        for k, one in enumerate(pieces.path):
            found[one] |= between[k] < -tolerance
        pieces = Pieces(
            np.concatenate((pieces.path, pieces.path)),
            np.concatenate((pieces.at, pieces.at + size)),
            np.concatenate((pieces.near, between)),
            np.concatenate((between, pieces.far)),
        )
    for k in _doubtful(pieces, size * length / STEP_SHARE, tolerance, found).path:
        found[k] = True
    return found
