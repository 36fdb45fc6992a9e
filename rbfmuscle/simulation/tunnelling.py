"""Points that pass through a bone within one sub-step: the swept test, the angle test, the
correction.

Both tests look at a point's straight path relative to the bone, that is in bone coordinates. The
swept test finds where the path goes through the bone's triangles, so that it misses nothing,
however thin the bone or long the path: a path that leaves a bone facing another way than it went
in has passed through. The angle test (Cervenka et al. 2023, equation 1, with the bound on d . d'
stated as the text means it: below cos 135 degrees) compares the directions to the bone at the two
ends; it misses most short crossings and stays for comparison.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.distance import distance_at, least_distance
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats, Integers, to_local, to_world
from rbfmuscle.geometry.exact_distance import (
    BX,
    CX,
    CY,
    INVERSE_BC,
    INVERSE_CA,
    STACK,
    nearest_in_frame,
)
from rbfmuscle.geometry.frames import dot, local_point, minus, row_of
from rbfmuscle.loops import loop
from rbfmuscle.scene.options import TunnellingOptions
from rbfmuscle.simulation.contact import BoneContacts, Fences

# A path whose directions at the bone, where it goes in and comes out, are within 90 degrees has
# slid along it.
SLIDING_COSINE = 0.0
# Through a thin plate, where a path is never deep, it has passed where these are nearly opposite.
OPPOSITE_COSINE = -0.9
# Nearer to a triangle than this share of the bone's box a path meets it, so that none slips between
# two.
EDGE = 1e-10
# Places along a path, relative to the tolerance, at which its depth is found, and how many at most.
STRIDE = 0.5
MOST_PLACES = 10_000


class Crossing(NamedTuple):
    """Points that passed through one of the bones in reach in a step, and how many the angle test
    flags.
    """

    bone: int
    index: Integers  # type: ignore[assignment]  # a tuple has a method of this name
    flagged: int


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

    Points are in world coordinates, the contacts in the poses ``after``. A path that is nowhere
    deeper than the ``tolerance`` [scene unit] touches a bone and does not pass through it, unless
    the bone itself is as thin.
    """
    crossings: list[Crossing] = []
    free = np.flatnonzero(contacts.free)
    start, end = start[free], end[free]
    near = np.empty(len(free), dtype=np.bool_)
    places = np.empty((len(free), 2))
    cosine = np.empty(len(free))
    for row, (name, field) in enumerate(zip(contacts.bones.names, contacts.bones.fields)):
        poses = (before[name], after[name])
        path_loop(
            field.arrays,
            *poses,
            start,
            end,
            *contacts.memories[row],
            tolerance,
            near,
            places,
            cosine,
        )
        through = []
        for k in np.flatnonzero(cosine < SLIDING_COSINE):
            first, last = to_local(start[k], poses[0]), to_local(end[k], poses[1])
            entry, leave = first + places[k, :, None] * (last - first)
            opposite = cosine[k] < OPPOSITE_COSINE
            if opposite or _deepest(field, entry, leave, tolerance) > tolerance:
                through.append(k)
        flags = 0
        if options.angle is not None:
            paths = to_local(start[near], poses[0]), to_local(end[near], poses[1])
            flags = count_flags(field, *paths, math.radians(options.angle))
        if through or flags:
            crossings.append(Crossing(row, free[np.array(through, dtype=np.int64)], flags))
    return crossings


def _deepest(field: BoneSDF, start: Floats, end: Floats, tolerance: float) -> float:
    """Greatest depth along a path that enters and leaves a bone at its ends (3,) [scene unit]."""
    length = float(np.linalg.norm(end - start))
    count = min(int(length / (STRIDE * tolerance)) + 3, MOST_PLACES)
    places = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return float(-field.distance(places).min())


def count_flags(field: BoneSDF, start: Floats, end: Floats, angle: float) -> int:
    """How many straight paths (n, 3) in bone coordinates the angle test flags: those that may touch
    the bone and whose directions there differ by more than the ``angle`` [radian] between the ends.
    """
    length = np.linalg.norm(end - start, axis=1)
    first, way = field.distance_and_gradient(start, reach=length)
    last, leave = field.distance_and_gradient(end, reach=length)
    turned = np.einsum("ij,ij->i", way, leave) < math.cos(angle)
    return int((turned & (first + last <= length)).sum())


def one_sided_planes(
    contacts: BoneContacts,
    crossing: Crossing,
    start: Floats,
    before: Mapping[str, Floats],
    after: Mapping[str, Floats],
) -> Fences:
    """A half-space for each point that crossed, to hold it on its side of the bone.

    The plane lies between the point and the bone, normal to the distance's gradient, and moves with
    the bone.
    """
    bones = contacts.bones
    name, field = bones.names[crossing.bone], bones.fields[crossing.bone]
    motion, points = after[name] @ np.linalg.inv(before[name]), start[crossing.index]
    distance, way = field.distance_and_gradient(to_local(points, before[name]))
    normal = way @ after[name][:3, :3].T
    return Fences(crossing.index, distance, normal, to_world(points, motion))


@loop
def _meets_box(boxes, node, x, y, z, dx, dy, dz):
    """Whether a straight path from x, y, z over dx, dy, dz meets a node's box."""
    low = 0.0
    high = 1.0
    for k in range(3):
        at = x if k == 0 else (y if k == 1 else z)
        way = dx if k == 0 else (dy if k == 1 else dz)
        near = boxes[node, k] - at
        far = boxes[node, 3 + k] - at
        if abs(way) < 1e-300:
            if near > 0.0 or far < 0.0:
                return False
        else:
            first = near / way
            last = far / way
            low = max(low, min(first, last))
            high = min(high, max(first, last))
    return low <= high * (1.0 + 1e-12) + 1e-12


@loop
def path_loop(
    bone,
    before,
    after,
    begin,
    end,
    anchor,
    bound,
    triangle,
    tolerance,
    near,
    places,
    cosine,
):
    """Follow points (n, 3) in world coordinates at a bone that goes between two poses (4, 4), on
    paths that are straight in its coordinates.

    Filled are ``near`` (n,), whether they may touch it, ``places`` (n, 2), where they first go into
    it and last come out, as shares of each path, and ``cosine`` (n,), that between the outward
    directions there, 1 where a path does not meet it.

    A path that begins or ends inside goes in or comes out at its end, with the direction of the
    distance's gradient; where it meets no triangle, it counts as inside from the ``tolerance`` on.
    ``anchor``, ``bound`` and ``triangle`` are those of a `Memory` of the points.
    """
    boxes = bone.boxes
    records = bone.records
    leaves = len(bone.starts) - 1
    stack = np.empty(STACK, np.int64)
    squares = np.empty(STACK)
    size = boxes[1, 3] - boxes[1, 0] + boxes[1, 4] - boxes[1, 1] + boxes[1, 5] - boxes[1, 2]
    for i in range(len(begin)):
        near[i] = False
        places[i, 0] = 0.0
        places[i, 1] = 1.0
        cosine[i] = 1.0
        x, y, z = local_point(before, row_of(begin, i))
        stop = local_point(after, row_of(end, i))
        way = minus(stop, (x, y, z))
        length = np.sqrt(dot(way, way))
        if least_distance(boxes, stop, row_of(anchor, i), bound[i]) > length:
            continue
        distance, bx, by, bz, best = distance_at(bone, *stop, triangle[i], stack, squares)
        triangle[i] = best
        bound[i] = distance if len(bone.dipoles) == 0 else -np.inf
        for k in range(3):
            anchor[i, k] = stop[k]
        if distance > length:
            continue
        near[i] = True
        dx, dy, dz = way
        # First place and record where the path goes in, last where it comes out, and the last in
        # and first out.
        into = np.inf
        out = -np.inf
        last_into = -np.inf
        first_out = np.inf
        entry = -1
        leave = -1
        top = 0
        stack[0] = 1
        while top >= 0:
            node = stack[top]
            top -= 1
            if not _meets_box(boxes, node, x, y, z, dx, dy, dz):
                continue
            if node < leaves:
                stack[top + 1] = 2 * node
                stack[top + 2] = 2 * node + 1
                top += 2
                continue
            for n in range(bone.starts[node - leaves], bone.starts[node - leaves + 1]):
                qx = x - records[n, 0]
                qy = y - records[n, 1]
                qz = z - records[n, 2]
                height = qx * records[n, 9] + qy * records[n, 10] + qz * records[n, 11]
                rise = dx * records[n, 9] + dy * records[n, 10] + dz * records[n, 11]
                if rise == 0.0 or height * (height + rise) > 0.0:
                    continue
                t = -height / rise
                px = qx + t * dx
                py = qy + t * dy
                pz = qz + t * dz
                du, dv, _ = nearest_in_frame(
                    records[n, BX],
                    records[n, CX],
                    records[n, CY],
                    records[n, INVERSE_BC],
                    records[n, INVERSE_CA],
                    px * records[n, 3] + py * records[n, 4] + pz * records[n, 5],
                    px * records[n, 6] + py * records[n, 7] + pz * records[n, 8],
                )
                if du * du + dv * dv > (EDGE * size) ** 2:
                    continue
                if rise < 0.0:
                    last_into = max(last_into, t)
                    if t < into:
                        into = t
                        entry = n
                else:
                    first_out = min(first_out, t)
                    if t > out:
                        out = t
                        leave = n
        if entry < 0 and leave < 0 and distance > -tolerance:
            continue
        if entry < 0 or first_out < into:
            _, ax, ay, az, _ = distance_at(bone, x, y, z, -1, stack, squares)
        else:
            places[i, 0] = into
            ax = records[entry, 9]
            ay = records[entry, 10]
            az = records[entry, 11]
        if leave >= 0 and last_into < out:
            places[i, 1] = out
            bx = records[leave, 9]
            by = records[leave, 10]
            bz = records[leave, 11]
        cosine[i] = ax * bx + ay * by + az * bz
