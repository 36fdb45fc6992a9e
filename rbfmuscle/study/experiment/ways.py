"""Several ways to one pose, and how far apart the shapes are that they lead to."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import UsageError

# Share of the way to the pose at which a detour leaves it, stops of the random walk, and what seeds it.
ASIDE, WALK, SEED = 0.5, 4, 0

Waypoints = list[dict[str, float]]


def ways_to(
    pose: Mapping[str, float],
    through: Mapping[str, float] | None = None,
    rest: Mapping[str, float] | None = None,
) -> dict[str, Waypoints]:
    """Return named ways from rest to a pose: all at once, one coordinate first, a detour, a random walk.

    Parameters
    ----------
    pose : mapping of str to float
        Coordinates with their values at the end [degree, or scene unit for a shift].
    through : mapping of str to float, optional
        Where a detour goes, half of the way to the pose.
    rest : mapping of str to float, optional
        Values of coordinates at rest, 0 where not given.

    Returns
    -------
    dict of str to list of dict
        Waypoints, as ``[motion]`` takes them.

    Examples
    --------
    >>> sorted(ways_to({"hip.flexion": 60.0, "hip.adduction": -25.0}))
    ['all at once', 'hip.adduction first', 'hip.flexion first', 'random walk']
    """
    if not pose or not any(pose.values()):
        raise UsageError("a pose needs a coordinate that is not at 0, for instance hip.flexion=60")
    end, rng = dict(pose), np.random.default_rng(SEED)
    found = {"all at once": [{}, end]}
    if len(end) > 1:
        found |= {f"{name} first": [{}, {name: value}, end] for name, value in end.items()}
    walk = [{key: float(value * rng.uniform(0.0, 1.2)) for key, value in end.items()} for _ in range(WALK)]
    found["random walk"] = [{}, *walk, end]
    if through:
        aside = {key: ASIDE * value for key, value in end.items()} | dict(through)
        found["detour"] = [{}, aside, {key: (rest or {}).get(key, 0.0) for key in through} | end]
    return found


def spread(shapes: Mapping[str, Floats]) -> dict[str, object]:
    """Return how far shapes of one material are apart: root mean square and greatest distance of its points.

    Parameters
    ----------
    shapes : mapping of str to (n, 3) ndarray
        At least two.

    Returns
    -------
    dict
        ``rms`` of the two that are farthest apart and their names, ``between``; ``greatest`` over all pairs.

    Examples
    --------
    >>> spread({"a": np.zeros((4, 3)), "b": np.ones((4, 3)) * [3.0, 4.0, 0.0]})["rms"]
    5.0
    """
    found = []
    for one, other in itertools.combinations(shapes, 2):
        away = np.linalg.norm(np.asarray(shapes[one]) - np.asarray(shapes[other]), axis=1)
        found.append((float(np.sqrt((away**2).mean())), float(away.max()), [one, other]))
    rms, _, between = max(found)
    return {"rms": rms, "greatest": max(greatest for _, greatest, _ in found), "between": between}
