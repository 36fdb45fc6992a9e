"""Broad phase of contact: loops over points and boxes that find which points may be near which
bones.
"""

import numpy as np

from rbfmuscle.jit import compiled

# Fraction of a queried distance that later calls rely on: a field is exact near its bone, coarser
# far away.
TRUSTED_SHARE = 0.8


@compiled(error_model="numpy", nogil=False)
def direction_loop(points, gradient, pose, box):
    """Normalise gradients in place; away from the middle of the bone's box where there is none."""
    for i in range(len(points)):
        square = 0.0
        for a in range(3):
            square += gradient[i, a] ** 2
        if square < 1e-18:
            square = 0.0
            for a in range(3):
                gradient[i, a] = points[i, a] - pose[a, 3] + 1e-12
                for b in range(3):
                    gradient[i, a] -= 0.5 * pose[a, b] * (box[0, b] + box[1, b])
                square += gradient[i, a] ** 2
        length = np.sqrt(square)
        for a in range(3):
            gradient[i, a] /= length


@compiled(error_model="numpy", nogil=False)
def closer_loop(distance, direction, smallest, gradient):
    """Replace distances and directions where the new distance is smaller."""
    for i in range(len(distance)):
        if distance[i] < smallest[i]:
            smallest[i] = distance[i]
            for a in range(3):
                gradient[i, a] = direction[i, a]


@compiled(error_model="numpy")
def note_query(points, i, pose, distance, anchor, bound):
    """Keep where point i was asked about, in bone coordinates, and a lower bound of its distance
    there.
    """
    bound[i] = TRUSTED_SHARE * distance
    for k in range(3):
        anchor[i, k] = 0.0
        for j in range(3):
            anchor[i, k] += pose[j, k] * (points[i, j] - pose[j, 3])


@compiled(error_model="numpy", nogil=False)
def answer_loop(points, pose, box, near, distance, gradient, anchor, bound):
    """Normalise the gradients at the points ``near`` in place; store where they were queried, and
    bounds there.

    ``anchor`` (n, 3) is in bone coordinates, ``bound`` (n,) a lower bound of the distance.
    """
    at = np.empty((len(near), 3))
    for n in range(len(near)):
        note_query(points, near[n], pose, distance[n], anchor, bound)
        for k in range(3):
            at[n, k] = points[near[n], k]
    direction_loop(at, gradient, pose, box)


@compiled(error_model="numpy", nogil=False)
def take_contacts_loop(near, distance, direction, limits, found):
    """Copy the contacts nearer than their reach into the arrays ``found``; return how many there
    are.

    ``limits`` holds the reach (n,) of every point and the depth (n,) that is allowed, or an empty
    array.
    """
    reach, allowed = limits
    index, gap, normal = found
    count = 0
    for n in range(len(near)):
        i = near[n]
        here = distance[n]
        if len(allowed) > 0:
            here += allowed[i]
        if here < reach[i]:
            index[count], gap[count] = i, here
            for a in range(3):
                normal[count, a] = direction[n, a]
            count += 1
    return count


@compiled(error_model="numpy", inline="always")
def _squares(points, i, pose, bounds, anchor):
    """Squares of how far point i has moved against a bone since it was asked about, and of its
    distance from the bone's box.
    """
    moved, outside = 0.0, 0.0
    for k in range(3):
        local = 0.0
        for j in range(3):
            local += pose[j, k] * (points[i, j] - pose[j, 3])
        moved += (local - anchor[i, k]) ** 2
        beyond = max(bounds[0, k] - local, local - bounds[1, k], 0.0)
        outside += beyond * beyond
    return moved, outside


@compiled(error_model="numpy")
def may_reach(points, i, pose, bounds, anchor, bound, reach):
    """Whether point i may be as near to a bone as ``reach``, by the bone's box and by what an
    earlier bound less the motion since says.
    """
    moved, outside = _squares(points, i, pose, bounds, anchor)
    spare = bound[i] - reach
    # Without branches, as they are a toss-up.
    away = (outside > 0.0) & ((reach < 0.0) | (outside > reach * reach))
    return ((spare <= 0.0) | (moved >= spare * spare)) & (not away)


@compiled(error_model="numpy")
def least_distance(points, i, pose, bounds, anchor, bound):
    """Lower bound of the distance of point i from a bone, by the bone's box and by what an earlier
    bound less the motion since says.
    """
    moved, outside = _squares(points, i, pose, bounds, anchor)
    least = bound[i] - np.sqrt(moved)
    return max(least, np.sqrt(outside)) if outside > 0.0 else least


@compiled(error_model="numpy")
def box_loop(points, chosen, box):
    """Fill ``box`` (2, 3) with the least and greatest coordinates of the chosen points."""
    low, high = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf)
    for i in range(len(points)):
        if chosen[i]:
            x = points[i, 0]
            y = points[i, 1]
            z = points[i, 2]
            low = min(low[0], x), min(low[1], y), min(low[2], z)
            high = max(high[0], x), max(high[1], y), max(high[2], z)
    box[0, :] = low
    box[1, :] = high


@compiled(error_model="numpy")
def boxes_apart(box, pose, bounds):
    """Lower bound of the distance between a box in world axes and a box (2, 3) in bone axes, in a
    pose of the bone.
    """
    square = 0.0
    for k in range(3):
        middle, half = pose[k, 3], 0.0
        for j in range(3):
            middle += 0.5 * pose[k, j] * (bounds[0, j] + bounds[1, j])
            half += 0.5 * abs(pose[k, j]) * (bounds[1, j] - bounds[0, j])
        beyond = max(box[0, k] - middle - half, middle - half - box[1, k], 0.0)
        square += beyond * beyond
    return np.sqrt(square)


@compiled(error_model="numpy", nogil=False)
def apart_loop(points, poses, boxes, apart):
    """Lower bound of the distance between each bone's box and the box of the points."""
    box = np.empty((2, 3))
    box_loop(points, np.ones(len(points), np.bool_), box)
    for b in range(len(poses)):
        apart[b] = boxes_apart(box, poses[b], boxes[b])


@compiled(error_model="numpy")
def near_loop(points, free, reach, bones, known, found, counts):
    """Fill ``found`` (b, n) with the free points that may be nearer than ``reach`` to each bone,
    and ``counts``.

    ``reach`` (b, n) or (1, n) holds the reach of each point, for each bone or for all.
    """
    poses, boxes = bones
    anchor, bound = known
    box = np.empty((2, 3))
    box_loop(points, free, box)
    for b in range(len(poses)):
        count = 0
        farthest = -np.inf
        limit = reach[b % len(reach)]
        for i in range(len(points)):
            if free[i]:
                farthest = max(farthest, limit[i])
        if boxes_apart(box, poses[b], boxes[b]) > farthest:
            continue
        for i in range(len(points)):
            found[b, count] = i
            count += free[i] & may_reach(
                points, i, poses[b], boxes[b], anchor[b], bound[b], limit[i]
            )
        counts[b] = count


@compiled(error_model="numpy")
def path_loop(start, end, before, after, length):
    """Fill ``length`` (b, n) with the lengths of straight paths as seen from each of some bones
    that move too.
    """
    for b in range(len(before)):
        for i in range(len(start)):
            square = 0.0
            for k in range(3):
                way = 0.0
                for j in range(3):
                    way += after[b, j, k] * (end[i, j] - after[b, j, 3])
                    way -= before[b, j, k] * (start[i, j] - before[b, j, 3])
                square += way * way
            length[b, i] = np.sqrt(square)
