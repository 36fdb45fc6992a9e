"""Broad phase of contact: loops over points and boxes that find which points may be near which
bones.
"""

import numpy as np

from rbfmuscle.jit import compiled

# Fraction of a queried distance that later calls rely on: a field is exact near its bone, coarser
# far away.
TRUSTED_SHARE = 0.8


@compiled(nogil=False)
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


@compiled
def note_query(points, i, pose, distance, anchor, bound):
    """Keep where point i was asked about, in bone coordinates, and a lower bound of its distance
    there.
    """
    bound[i] = TRUSTED_SHARE * distance
    for k in range(3):
        anchor[i, k] = 0.0
        for j in range(3):
            anchor[i, k] += pose[j, k] * (points[i, j] - pose[j, 3])


@compiled(inline="always")
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


@compiled
def may_reach(points, i, pose, bounds, anchor, bound, reach):
    """Whether point i may be as near to a bone as ``reach``, by the bone's box and by what an
    earlier bound less the motion since says.
    """
    moved, outside = _squares(points, i, pose, bounds, anchor)
    spare = bound[i] - reach
    # Without branches, as they are a toss-up.
    away = (outside > 0.0) & ((reach < 0.0) | (outside > reach * reach))
    return ((spare <= 0.0) | (moved >= spare * spare)) & (not away)


@compiled
def least_distance(points, i, pose, bounds, anchor, bound):
    """Lower bound of the distance of point i from a bone, by the bone's box and by what an earlier
    bound less the motion since says.
    """
    moved, outside = _squares(points, i, pose, bounds, anchor)
    least = bound[i] - np.sqrt(moved)
    return max(least, np.sqrt(outside)) if outside > 0.0 else least


@compiled
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


@compiled
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
