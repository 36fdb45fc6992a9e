"""Points beside a surface with their signed distances, for fits to values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.touching_balls import touching_balls
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
    touching_balls(points, normals, steps, nearest)
    distance = 0.5 * np.median(nearest) if distance is None else check_positive(distance, name="distance")
    outside, inside = np.minimum(safety * steps, distance)
    where = np.vstack([points, points + outside[:, None] * normals, points - inside[:, None] * normals])
    return where, np.concatenate([np.zeros(len(points)), outside, -inside])
