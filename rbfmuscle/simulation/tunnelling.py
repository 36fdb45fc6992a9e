"""Points that pass through a bone within one sub-step: the angle test, the swept test, the
correction.

Both tests look at a point's path relative to the bone, that is in bone coordinates. The angle test
compares the directions to the bone at the two ends (Cervenka et al. 2023, equation 1, with the
bound on d . d' stated as the text means it: below cos 135 degrees); it misses most short crossings.
The swept test follows the path by sphere tracing (Hart 1996) in the bone's distance field and
cannot miss what is thicker than its tolerance.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.rotations import rigid_fit
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.simulation.contact import BoneContacts, Planes
from rbfmuscle.simulation.frame import MuscleModel

# 135 degrees, the bound of the angle test.
RIGHT_ANGLE_AND_HALF = 0.75 * math.pi
# The field's interpolation may change a little faster than the distance does.
STEP_SHARE = 0.9
# A path that leaves a bone facing within 90 degrees of where it went in has slid along, not passed
# through.
SLIDING_COSINE = 0.0
# Halvings of a path to show that it stays outside, before it is traced.
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
    """Points that passed through one bone in a step, and how many the angle test flags."""

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
    index, last = index[near], last[near]
    if len(index) == 0:
        nothing = np.zeros(0, dtype=bool)
        return Sweep(index, np.zeros(0), nothing, nothing)
    start, end = start[index], end[index]
    lowest = _halve(field, start, end, distance[index], last, tolerance)
    through = np.zeros(len(index), dtype=bool)
    # Undecided by halving.
    deep = np.flatnonzero(lowest < -tolerance)
    if len(deep):
        lowest[deep], first, last = _trace(field, start[deep], end[deep], tolerance)
        way = end[deep] - start[deep]
        entry = _directions(field, start[deep] + first[:, None] * way)
        leave = _directions(field, start[deep] + last[:, None] * way)
        turned = np.einsum("ij,ij->i", entry, leave) < SLIDING_COSINE
        through[deep] = turned & (lowest[deep] < -tolerance)
    cosine = np.einsum("ij,ij->i", _directions(field, start), _directions(field, end))
    return Sweep(index, lowest, through, cosine < math.cos(angle))


def find_crossings(
    contacts: BoneContacts,
    start: Floats,
    end: Floats,
    before: dict[str, Floats],
    after: dict[str, Floats],
    options: TunnellingOptions,
    *,
    tolerance: float,
) -> list[Crossing]:
    """Bones that points (n, 3) crossed, or that the angle test flags, while the bones went between
    two poses.

    Points are in world coordinates, the contacts in the poses ``after``, the tolerance in the
    scene's unit.
    """
    crossings = []
    # A path that is shorter than the distance of its end touches nothing.
    lengths = contacts.path_lengths(start, end, before, after)
    for b, index in contacts.near(end, lengths):
        name = contacts.names[b]
        first, second = _local(start[index], before[name]), _local(end[index], after[name])
        sweep = sweep_paths(
            contacts.fields[b],
            first,
            second,
            tolerance=tolerance,
            angle=math.radians(options.angle),
        )
        crossed = sweep.through if options.swept else sweep.flagged
        if crossed.any() or sweep.flagged.any():
            crossings.append(Crossing(b, index[sweep.index[crossed]], int(sweep.flagged.sum())))
    return crossings


def rotate_with_bone(
    model: MuscleModel,
    crossings: list[Crossing],
    start: Floats,
    before: dict[str, Floats],
    after: dict[str, Floats],
    names: list[str],
) -> None:
    """Move points that crossed back to where they were relative to the bone: rotated with it about
    its joint.

    The model has predicted already; it gets the rigid transform from the predicted to the corrected
    positions.
    """
    for crossing in crossings:
        motion = after[names[crossing.bone]] @ np.linalg.inv(before[names[crossing.bone]])
        wanted = start[crossing.index] @ motion[:3, :3].T + motion[:3, 3]
        which = np.zeros(len(start), dtype=bool)
        which[crossing.index] = True
        model.turn(which, rigid_fit(model.contact_points()[crossing.index], wanted))


def one_sided_planes(
    contacts: BoneContacts,
    crossing: Crossing,
    start: Floats,
    before: dict[str, Floats],
    after: dict[str, Floats],
) -> Planes:
    """A half-space for each point that crossed, to hold it on its side of the bone.

    The plane lies between the point and the bone, normal to the distance's gradient, and moves with
    the bone.
    """
    name = contacts.names[crossing.bone]
    motion, points = after[name] @ np.linalg.inv(before[name]), start[crossing.index]
    local = _local(points, before[name])
    distance = contacts.fields[crossing.bone].distance(local)
    way = _directions(contacts.fields[crossing.bone], local) @ after[name][:3, :3].T
    planes = Planes()
    planes.set(crossing.index, distance, way, points @ motion[:3, :3].T + motion[:3, 3])
    return planes


def only_grazed(
    crossing: Crossing,
    mesh: Any,
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


def _halve(field, start, end, distance, last, tolerance):
    """Smallest distance found along each path by halving it; -infinity where that does not show it
    clear.

    Between two places s apart, at distances d and d' from the bone, nothing is deeper than (s - d -
    d') / 2.
    """
    length = np.linalg.norm(end - start, axis=1) / STEP_SHARE
    lowest = np.minimum(distance, last)
    # Pieces: which path, where they begin (fraction), the distances at their ends.
    path = np.arange(len(start))
    at = np.zeros(len(start))
    near = distance
    far = last
    size = 1.0
    for halvings in range(HALVINGS + 1):
        left = near + far - size * length[path] < -2.0 * tolerance
        path = path[left]
        at = at[left]
        near = near[left]
        far = far[left]
        if len(path) == 0 or halvings == HALVINGS:
            break
        size *= 0.5
        middle = at + size
        between = field.distance(start[path] + middle[:, None] * (end[path] - start[path]))
        np.minimum.at(lowest, path, between)
        path, at = np.concatenate([path, path]), np.concatenate([at, middle])
        near, far = np.concatenate([near, between]), np.concatenate([between, far])
        clear = lowest[path] >= -tolerance
        path = path[clear]
        at = at[clear]
        near = near[clear]
        far = far[clear]
    lowest[path] = -np.inf
    lowest[lowest < -tolerance] = -np.inf
    return lowest


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
    return lowest, entry, leave


def _directions(field, points):
    gradient = field.distance_and_gradient(points)[1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)[:, None]


def _local(points, pose):
    """Points in the coordinates of a bone in a rigid pose."""
    return (points - pose[:3, 3]) @ pose[:3, :3]
