"""Rigid motions that fit moved points, and what points do beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Floats


def rigid_fit(points: Floats, targets: Floats) -> Floats:
    """Rigid (4, 4) transform that takes points (n, 3) nearest to targets (n, 3) by least squares (Kabsch 1976)."""
    middle, aim = points.mean(axis=0), targets.mean(axis=0)
    u, _, vt = np.linalg.svd((points - middle).T @ (targets - aim))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    transform = np.eye(4)
    if len(points) > 2:
        transform[:3, :3] = vt.T @ mirror @ u.T
    transform[:3, 3] = aim - transform[:3, :3] @ middle
    return transform


def smooth_displacement(rest: Floats, points: Floats, smooth: Callable[[Floats], None]) -> Floats:
    """The shape at rest, moved as the points on the whole, and deformed as they are where that is smooth, (n, 3).

    Parameters
    ----------
    rest, points : (n, 3) ndarray
        [scene unit]
    smooth : callable
        Smooths, in place, what the points do beside the rigid motion.
    """
    motion = rigid_fit(rest, points)
    moved = rest @ motion[:3, :3].T + motion[:3, 3]
    beside = points - moved
    smooth(beside)
    return moved + beside
