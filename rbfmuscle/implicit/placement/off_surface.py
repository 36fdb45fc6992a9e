"""Points beside a surface with their signed distances, for fits to values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import check_points, check_positive, check_vectors


def off_surface_points(
    points: ArrayLike, normals: ArrayLike, *, distance: float | None = None, safety: float = 0.5
) -> tuple[Floats, Floats]:
    """Points on and off a surface with their signed distances, for fits to values.

    Each point x gives f(x) = 0, f(x + d n) = d and f(x - d n) = -d (Carr et al. 2001). The step d is cut back
    until x is still the nearest of all points to x + d n: for a neighbour q that means
    d <= |q - x|^2 / (2 n.(q - x)), the radius of the ball that touches the surface in x and passes through q.

    Parameters
    ----------
    points : (K, 3) array_like
        Positions on the surface [scene unit].
    normals : (K, 3) array_like
        Unit outward normals.
    distance : float, optional
        Longest step; by default half the median distance to the nearest other point.
    safety : float
        Part of the touching ball's radius that a step may use, above 0 and at most 1.

    Returns
    -------
    points : (3K, 3) ndarray
        On the surface, outside, inside.
    values : (3K,) ndarray
        0, then +d, then -d.

    Raises
    ------
    ValueError
        On wrong shapes, fewer than two points, or a distance or safety out of range.
    """
    points = check_points(points)
    normals = check_vectors(normals, len(points))
    if len(points) < 2:
        raise ValueError(f"points must be at least 2, got {len(points)}")
    if not 0 < safety <= 1:
        raise ValueError(f"safety must be above 0 and at most 1, got {safety}")
    steps = np.empty((2, len(points)))
    nearest = np.empty(len(points))
    _touching_ball_loop(points, normals, steps, nearest)
    distance = 0.5 * np.median(nearest) if distance is None else check_positive(distance, name="distance")
    outside, inside = np.minimum(safety * steps, distance)
    where = np.vstack([points, points + outside[:, None] * normals, points - inside[:, None] * normals])
    return where, np.concatenate([np.zeros(len(points)), outside, -inside])


@compiled
def _touching_ball_loop(points, normals, steps, nearest):
    """Radii of the empty balls that touch each point from outside (row 0) and inside (row 1)."""
    for i in range(len(points)):
        steps[:, i] = np.inf
        least = np.inf
        for j in range(len(points)):
            square, along = 0.0, 0.0
            for c in range(3):
                d = points[j, c] - points[i, c]
                square += d * d
                along += d * normals[i, c]
            if j == i:
                continue
            least = min(least, square)
            side = 0 if along > 0 else 1
            if along != 0.0:
                steps[side, i] = min(steps[side, i], square / (2 * abs(along)))
        nearest[i] = np.sqrt(least)
