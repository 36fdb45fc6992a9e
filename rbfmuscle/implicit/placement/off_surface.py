"""Points beside a surface with their signed distances, for fits to values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.touching_balls import touching_balls
from rbfmuscle.validation import check_points, check_vectors

# Part of the touching ball's radius that a step may use.
SAFETY = 0.5


def off_surface_points(points: ArrayLike, normals: ArrayLike) -> tuple[Floats, Floats]:
    """Points on and off a surface with their signed distances, for fits to values.

    Each point x gives f(x) = 0, f(x + d n) = d and f(x - d n) = -d (Carr et al. 2001). The step d is half the median
    distance to the nearest other point, and at most half the radius of the empty ball that touches the surface in x,
    so that x stays the nearest of all points to x + d n.

    Parameters
    ----------
    points : (K, 3) array_like
        Positions on the surface, two or more [scene unit].
    normals : (K, 3) array_like
        Unit outward normals.

    Returns
    -------
    points : (3K, 3) ndarray
        On the surface, outside, inside.
    values : (3K,) ndarray
        0, then +d, then -d.
    """
    points = check_points(points)
    normals = check_vectors(normals, len(points))
    if len(points) < 2:
        raise ValueError(f"points must be at least 2, got {len(points)}")
    steps = np.empty((2, len(points)))
    nearest = np.empty(len(points))
    touching_balls(points, normals, steps, nearest)
    outside, inside = np.minimum(SAFETY * steps, 0.5 * np.median(nearest))
    where = np.vstack([points, points + outside[:, None] * normals, points - inside[:, None] * normals])
    return where, np.concatenate([np.zeros(len(points)), outside, -inside])
