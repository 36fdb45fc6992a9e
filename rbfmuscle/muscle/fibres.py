"""Directions of the fibres in an RBF muscle, and the flux that they are."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.muscle.model import SolidModel

# Pieces of polyline that speak for one place.
NEAREST = 3


def fibre_directions(
    points: np.ndarray,
    along: np.ndarray,
    fibres: Sequence[np.ndarray] | None,
    *,
    fallback: np.ndarray,
) -> np.ndarray:
    """Unit direction of the fibres at each point (n, 3).

    They follow the polylines (k, 3), or where there are none ``along`` (n, 3), the gradient of the
    harmonic field from the first attachment to the last; where neither has a direction the
    ``fallback`` (3,).
    """
    if fibres:
        middles = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
        pieces = np.concatenate([np.diff(line, axis=0) for line in fibres])
        near = min(NEAREST, len(middles))
        distance, index = cKDTree(middles).query(points, k=np.arange(1, near + 1))
        unit = pieces / np.linalg.norm(pieces, axis=1, keepdims=True)
        floor = 1e-9 * np.ptp(points, axis=0).max()
        unit = unit[index]
        against = np.einsum("nkd,nd->nk", unit, unit[:, 0]) < 0.0  # a fibre has no sense
        unit = np.where(against[:, :, None], -unit, unit)
        along = (unit / np.maximum(distance, floor)[:, :, None]).sum(axis=1)
    length = np.linalg.norm(along, axis=1)
    weak = length < 1e-9 * max(length.max(), 1e-300)
    along = np.where(weak[:, None], fallback, along)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def rise(model: SolidModel) -> Floats:
    """Unit directions at the quadrature points from the muscle's first bone to its last, (Q, 3)."""
    slope = _gradient(model, model.motion_weights @ np.arange(model.motion_weights.shape[1]))
    return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)


def flux(model: SolidModel) -> Floats:
    """Gradient (Q, 3) of a potential whose flux from the first bone's held points to the others' is
    one.
    """
    first = model.held_bone == model.held_bone.min()
    source = np.where(first, -1.0 / max(first.sum(), 1), 1.0 / max((~first).sum(), 1))
    right = model.springs @ source / model.spring
    return _gradient(model, np.linalg.lstsq(model.matrix, right, rcond=None)[0])


def _gradient(model: SolidModel, values: Floats) -> Floats:
    """Gradient (Q, 3) at the quadrature points of values (N,) at the nodes."""
    return np.asarray(np.einsum("qk,qka->qa", values[model.cells.columns], model.cells.slopes))
