"""Contact points near bones and neighbours, and the half-spaces that they meet there."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.broad_phase import (
    TRUSTED_SHARE,
    box_loop,
    boxes_apart,
    least_distance,
)
from rbfmuscle.bones.obstacles import Known, ask_near, query_bone
from rbfmuscle.geometry.surfaces import farthest_move
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.rounded_bones import no_scratch, rounded_distance


class Near(NamedTuple):
    """The m contact points near an obstacle when nodes were at ``y``."""

    which: np.ndarray  # (m,) among the contact points
    columns: np.ndarray  # (m, 27) their nodes
    shares: np.ndarray  # (m, 27) shape functions
    free: np.ndarray  # (m,) whether no bone holds it
    most: np.ndarray  # (m,) greatest force on each, over 2 μ
    forces: np.ndarray  # (m, obstacles), changed in place
    allowed: np.ndarray  # (b, m) how deep each may be in a bone [scene unit]
    exact: Known
    rounded: Known
    y: np.ndarray  # (N, 3)
    gap: np.ndarray  # (m,) lower bounds of the exact gaps there
    # (m,) lower bounds of the rounded gaps, plus what the nodes had travelled when they were found
    spare: np.ndarray


class Touch(NamedTuple):
    """Half-spaces: a motion of a ``point`` by d is admissible where gap + normal · d >= 0."""

    point: np.ndarray  # (c,) among the near points
    gap: np.ndarray  # (c,) [scene unit]
    normal: np.ndarray  # (c, 3) unit
    source: np.ndarray  # (c,) obstacle: the bones in reach, then kinds of planes


@compiled
def find_near(points, obstacles, reach):
    """Mask (n,) of the contact points nearer than ``reach`` to an obstacle, and lower bounds (n,)
    of the gaps, at most ``reach``.
    """
    bones = obstacles.bones
    free = obstacles.free
    known = obstacles.known
    found, box = np.zeros(len(points), np.bool_), np.empty((2, 3))
    gap = np.full(len(points), reach)
    box_loop(points, free, box)
    limit = np.full(len(points), reach)
    for b in range(len(obstacles.poses)):
        pose = obstacles.poses[b]
        if boxes_apart(box, pose, bones.boxes[b]) > reach:
            continue
        some, distance, _ = ask_near(bones, b, pose, free, known, points, limit, False)
        for k, i in enumerate(some):
            found[i] |= distance[k] + obstacles.allowed[b, i] < reach
            gap[i] = min(gap[i], trusted(distance[k]) + obstacles.allowed[b, i])
    planes = obstacles.planes
    for p in range(len(planes.point)):
        i = planes.point[p]
        there = plane_gap(planes, p, points[i])
        found[i] |= there < reach
        gap[i] = min(gap[i], there)
    return found, gap


@compiled
def trusted(distance):
    """Lower bound of a distance that a field answers: it is exact near its bone, coarser far
    away.
    """
    return TRUSTED_SHARE * distance if distance > 0.0 else distance


@compiled
def plane_gap(planes, p, point):
    """Signed distance of a point from plane p."""
    value = planes.gap[p]
    for a in range(3):
        value += planes.normal[p, a] * (point[a] - planes.anchor[p, a])
    return value


@compiled
def take_near(found, gap, model, most, obstacles, rounded, forces, y):
    """The contact points of a mask (n,), with the greatest and the present forces and the gaps of
    all on them, and what is known of the distances to bones as they are and ``rounded``.
    """
    which = np.flatnonzero(found)
    columns = model.embedding.columns
    shares = model.embedding.shares
    count = len(which)
    bones = len(rounded.bound)
    width = columns.shape[1]
    near = Near(
        which,
        np.empty((count, width), np.int64),
        np.empty((count, width)),
        np.empty(count, np.bool_),
        np.empty(count),
        np.empty((count, forces.shape[1])),
        np.empty((bones, count)),
        Known(np.empty((bones, count, 3)), np.empty((bones, count))),
        Known(np.empty((bones, count, 3)), np.empty((bones, count))),
        y.copy(),
        gap[which],
        np.full(count, -np.inf),
    )
    for k in range(count):
        i = which[k]
        near.free[k] = obstacles.free[i]
        near.most[k] = most[i]
        for m in range(width):
            near.columns[k, m] = columns[i, m]
            near.shares[k, m] = shares[i, m]
        for m in range(forces.shape[1]):
            near.forces[k, m] = forces[i, m]
        for b in range(bones):
            near.allowed[b, k] = obstacles.allowed[b, i]
            near.exact.bound[b, k] = obstacles.known.bound[b, i]
            near.rounded.bound[b, k] = rounded.bound[b, i]
            for a in range(3):
                near.exact.anchor[b, k, a] = obstacles.known.anchor[b, i, a]
                near.rounded.anchor[b, k, a] = rounded.anchor[b, i, a]
    return near


@compiled
def keep_rounded(near, known):
    """Note what is known of the rounded distances of near points for later solves."""
    for b in range(len(near.rounded.bound)):
        for k in range(len(near.which)):
            i = near.which[k]
            known.bound[b, i] = near.rounded.bound[b, k]
            for a in range(3):
                known.anchor[b, i, a] = near.rounded.anchor[b, k, a]


@compiled(inline="always")
def near_motion(near, y, new, push, margin, travelled):
    """Where near points are (m, 3), their motion in a step of the nodes, and how far to look for
    obstacles: half as far again as they go in the step with the last push on top, and a margin.

    -∞ for points that nothing can be so near to.
    """
    nodes = len(y)
    count = len(near.which)
    farthest = 0.0
    displacements = np.empty((nodes, 9))
    for n in range(nodes):
        square = 0.0
        for a in range(3):
            displacements[n, a] = y[n, a]
            displacements[n, 3 + a] = new[n, a] - y[n, a]
            displacements[n, 6 + a] = push[n, a]
            square += (displacements[n, 3 + a] + push[n, a]) ** 2
        farthest = max(farthest, square)
    farthest = 1.5 * np.sqrt(farthest) + margin
    here = np.empty((count, 3))
    motion = np.empty((count, 3))
    reach = np.full(count, -np.inf)
    total = np.empty(9)
    for s in range(count):
        # Shape functions are not negative and add up to one: no point goes farther than the nodes.
        if near.spare[s] - travelled > farthest:
            continue
        total[:] = 0.0
        for k in range(near.columns.shape[1]):
            share = near.shares[s, k]
            for a in range(9):
                total[a] += share * displacements[near.columns[s, k], a]
        square = 0.0
        for a in range(3):
            here[s, a] = total[a]
            motion[s, a] = total[3 + a]
            square += (total[3 + a] + total[6 + a]) ** 2
        reach[s] = 1.5 * np.sqrt(square) + margin
    return here, motion, reach


@compiled
def carry_near(near, y, margin):
    """Where near points are, (m, 3), and how far to look for obstacles: -∞ for points that nothing
    can be so near to.
    """
    out, reach = np.zeros((len(near.which), 3)), np.full(len(near.which), -np.inf)
    farthest = farthest_move(y, near.y) + margin
    for s in range(len(out)):
        if near.gap[s] > farthest:
            continue
        reach[s] = margin
        for k in range(near.columns.shape[1]):
            for a in range(3):
                out[s, a] += near.shares[s, k] * y[near.columns[s, k], a]
    return out, reach


class Search(NamedTuple):
    """Where the near points are, and how far to look for obstacles from there."""

    here: np.ndarray  # (m, 3)
    reach: np.ndarray  # (m,) [scene unit], -∞ for points that are passed over
    asked: np.ndarray  # (m,) whether bones count for it
    box: np.ndarray  # (2, 3) of these
    farthest: float  # greatest reach
    travelled: float  # how far nodes have gone since points were chosen [scene unit]


@compiled
def find_touch(near, here, reach, travelled, obstacles, rounded):
    """Half-spaces that near points ``here`` (m, 3) meet within ``reach`` (m,), bones rounded.

    Points with a reach of -∞ are passed over. Also whether there was room for all blocks of the
    rounded bones. Fills ``near.spare`` for nodes that have ``travelled`` so far.
    """
    touch = _no_touch(len(obstacles.poses) * len(here) + len(obstacles.planes.point))
    asked, farthest = near.free & (reach > -np.inf), reach.max() if len(reach) > 0 else -np.inf
    search = Search(here, reach, asked, np.empty((2, 3)), farthest, travelled)
    box_loop(here, asked, search.box)
    for i in range(len(here)):
        if reach[i] > -np.inf:
            near.spare[i] = np.inf
    count, room = 0, True
    scratch = no_scratch()
    for b in range(len(obstacles.poses)):
        count, fits = _touch_bone(near, search, obstacles, rounded, b, touch, count, scratch)
        room &= fits
    first = count
    count = _add_planes(touch, count, near, here, reach, obstacles, np.inf)
    for c in range(first, count):
        i = touch.point[c]
        near.spare[i] = min(near.spare[i], travelled + touch.gap[c])
    return _first(touch, count), room


@compiled
def _touch_bone(near, search, obstacles, rounded, b, touch, count, scratch):
    """Add the half-spaces of bone b to the first ``count``; how many there are then, and whether
    there was room for all of its blocks.
    """
    here = search.here
    reach = search.reach
    spare = near.spare
    allowed = near.allowed[b]
    pose = obstacles.poses[b]
    bounds = obstacles.bones.boxes[b]
    anchor = near.rounded.anchor[b]
    bound = near.rounded.bound[b]
    apart, room = boxes_apart(search.box, pose, bounds), True
    for i in range(len(here)):
        if not search.asked[i]:
            continue
        least = apart
        if apart <= search.farthest:
            least = least_distance(here, i, pose, bounds, anchor, bound)
        if least >= reach[i]:
            spare[i] = min(spare[i], search.travelled + least)
            continue
        distance, smooth = _ask_rounded(rounded, obstacles.bones, b, pose, here[i], scratch)
        room &= distance < np.inf
        if smooth:
            bound[i] = TRUSTED_SHARE * scratch.smooth[0]
            for a in range(3):
                anchor[i, a] = scratch.local[a]
        there = trusted(distance) + allowed[i]
        spare[i] = min(spare[i], search.travelled + there)
        if distance + allowed[i] < reach[i]:
            _add_touch(touch, count, i, distance + allowed[i], scratch.normal, b)
            count += 1
    return count, room


@compiled
def _ask_rounded(rounded, bones, b, pose, point, scratch):
    """Distance of a point from a bone, rounded where it can be; infinity without room for a block.
    Also whether the distance is that of the rounded bone. Fills the normal.
    """
    for k in range(3):
        scratch.local[k] = 0.0
        for a in range(3):
            scratch.local[k] += pose[a, k] * (point[a] - pose[a, 3])
    distance = rounded_distance(rounded, bones, b, scratch)
    smooth = False
    if np.isnan(distance):
        distance = _exact_distance(bones, b, pose, point, scratch.normal)
    elif distance < np.inf:
        smooth = True
        for k in range(3):
            scratch.normal[k] = 0.0
            for a in range(3):
                scratch.normal[k] += pose[k, a] * scratch.gradient[a]
    return distance, smooth


@compiled
def find_exact_touch(near, here, reach, obstacles, softest):
    """The same with bones as they are, and without planes softer than ``softest``."""
    bones, planes = obstacles.bones, obstacles.planes
    touch = _no_touch(len(obstacles.poses) * len(here) + len(planes.point))
    box, farthest = np.empty((2, 3)), reach.max() if len(reach) > 0 else -np.inf
    free = near.free & (reach > -np.inf)
    box_loop(here, free, box)
    count = 0
    for b in range(len(obstacles.poses)):
        pose = obstacles.poses[b]
        if boxes_apart(box, pose, bones.boxes[b]) > farthest:
            continue
        some, distance, normal = ask_near(bones, b, pose, free, near.exact, here, reach, True)
        for k, i in enumerate(some):
            there = distance[k] + near.allowed[b, i]
            if there < reach[i]:
                _add_touch(touch, count, i, there, normal[k], b)
                count += 1
    return _first(touch, _add_planes(touch, count, near, here, reach, obstacles, softest))


@compiled
def _exact_distance(bones, b, pose, point, normal):
    """Distance of one point to a bone as it is, and its gradient."""
    at = point.reshape((1, 3))
    distance = np.empty(1)
    gradient = np.empty((1, 3))
    query_bone(bones, b, pose, at, np.full(1, np.inf), distance, gradient)
    normal[:] = gradient[0]
    return distance[0]


@compiled
def _no_touch(room):
    return Touch(
        np.empty(room, np.int64), np.empty(room), np.empty((room, 3)), np.empty(room, np.int64)
    )


@compiled
def _first(touch, count):
    return Touch(touch.point[:count], touch.gap[:count], touch.normal[:count], touch.source[:count])


@compiled
def _add_touch(touch, count, i, gap, normal, source):
    touch.point[count] = i
    touch.gap[count] = gap
    touch.source[count] = source
    for a in range(3):
        touch.normal[count, a] = normal[a]


@compiled
def _add_planes(touch, count, near, here, reach, obstacles, softest):
    """Add the planes nearer than ``reach`` to near points; returns how many half-spaces there
    are.
    """
    planes, bones = obstacles.planes, len(obstacles.poses)
    for p in range(len(planes.point)):
        if planes.softness[planes.kind[p]] > softest:
            continue
        i = np.searchsorted(near.which, planes.point[p])
        if i == len(near.which) or near.which[i] != planes.point[p]:
            continue
        if reach[i] == -np.inf:
            continue
        gap = plane_gap(planes, p, here[i])
        if gap < reach[i]:
            _add_touch(touch, count, i, gap, planes.normal[p], bones + planes.kind[p])
            count += 1
    return count
