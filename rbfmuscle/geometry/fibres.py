"""Directions of the fibres in a muscle."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats

# Pieces of polyline whose directions are averaged at one place.
NEAREST = 3
# Directions shorter than this share of the longest are rounding errors.
NO_DIRECTION = 1e-9


def fibre_directions(
    points: Floats,
    along: Floats,
    fibres: Sequence[Floats] | None,
    *,
    fallback: Floats | None = None,
) -> Floats:
    """Unit direction of the fibres at each point (n, 3).

    They follow the polylines (k, 3), or where there are none ``along`` (n, 3), the gradient of a
    function that grows from origin to insertion; where neither has a direction the ``fallback``
    (3,), zero without one.
    """
    if fibres:
        along = _along_polylines(points, fibres)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    weak = length <= NO_DIRECTION * length.max(initial=0.0)
    unit = np.divide(along, length, out=np.zeros_like(along), where=~weak)
    if fallback is not None:
        unit[weak[:, 0]] = fallback / np.linalg.norm(fallback)
    return unit


def nearest_pieces(points: Floats, fibres: Sequence[Floats], most: int) -> tuple[Floats, Floats]:
    """Unit directions (n, k, 3) of the nearest pieces of polylines to each point (n, 3), ``most``
    of them, and the inverse of their distances (n, k).
    """
    middles = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
    pieces = np.concatenate([np.diff(line, axis=0) for line in fibres])
    unit = pieces / np.maximum(np.linalg.norm(pieces, axis=1, keepdims=True), 1e-300)
    near = np.arange(1, min(most, len(middles)) + 1)
    distance, index = cKDTree(middles).query(points, k=near)
    return unit[index], 1.0 / np.maximum(distance, 1e-9 * np.ptp(points, axis=0).max())


def _along_polylines(points: Floats, fibres: Sequence[Floats]) -> Floats:
    """Mean direction (n, 3) of the nearest pieces, by the inverse of their distance."""
    unit, share = nearest_pieces(points, fibres, NEAREST)
    against = np.einsum("nkd,nd->nk", unit, unit[:, 0]) < 0.0  # a fibre has no sense
    unit = np.where(against[:, :, None], -unit, unit)
    return (unit * share[:, :, None]).sum(axis=1)
