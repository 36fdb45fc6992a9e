"""Moment arms: minus the derivative of a muscle's length with a coordinate, from what a motion recorded."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

# A slope is fitted over the frames within so many degrees, or millimetres of a shift, and over the frames next to it.
# In motions by one degree moment arms then ripple about smooth curves by at most 0.3 mm RMS (docs/validation.md).
REACH = 8.0
# Coordinates that change by less [radian or scene unit] rest.
_STILL = 1e-9


def moment_arms(
    path: Sequence[Mapping[str, float]], lengths: Sequence[float], reach: Mapping[str, float] | None = None
) -> list[dict[str, float]]:
    """Moment arms -dl/dq along a motion, for each frame by coordinate that moves alone before or after it.

    A parabola is fitted to the lengths of the frames within ``reach``, and always of both neighbours, as far as the
    coordinate goes on alone and in one direction: with two neighbours it is the central difference, at an end the
    difference to the one neighbour. ``path`` holds the coordinates of each frame and ``reach`` is that of each
    coordinate, or `REACH` degrees [radian or scene unit]; ``lengths`` [scene unit] are NaN where not known. Moment arms
    are in scene units per radian, or 1.
    """
    values, found = np.asarray(lengths, dtype=float), [dict[str, float]() for _ in path]
    for name, first, last in _single_motions(path, values):
        at = np.array([path[k].get(name, 0.0) for k in range(first, last + 1)])
        wide = math.radians(REACH) if reach is None else reach[name]
        for k in range(first, last + 1):
            near = np.abs(at - at[k - first]) <= wide
            near[max(0, k - first - 1) : k - first + 2] = True
            away, long = at[near] - at[k - first], values[first : last + 1][near]
            slope = np.polyfit(away, long, min(2, len(away) - 1))[-2]
            found[k].setdefault(name, -float(slope))
    return found


def _single_motions(path, lengths):
    """Name, first and last frame of each stretch in which one coordinate moves alone and in one direction."""
    stretches = []
    for k, (before, after) in enumerate(itertools.pairwise(path)):
        moved = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in {*before, *after}}
        moved = {name: change for name, change in moved.items() if abs(change) > _STILL}
        if len(moved) != 1 or not np.isfinite(lengths[k : k + 2]).all():
            continue
        ((name, change),) = moved.items()
        if stretches and stretches[-1][:2] == (name, change > 0) and stretches[-1][3] == k:
            stretches[-1] = (*stretches[-1][:3], k + 1)
        else:
            stretches.append((name, change > 0, k, k + 1))
    return [(name, first, last) for name, _, first, last in stretches]
