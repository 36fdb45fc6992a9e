"""Which way the fibres of an RBF muscle run at its centres."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

# Pieces of polyline that speak for one place.
NEAREST = 3


def fibre_directions(
    points: np.ndarray, along: np.ndarray, fibres: Sequence[np.ndarray] | None, *, fallback: np.ndarray
) -> np.ndarray:
    """Unit direction of the fibres at each point.

    Parameters
    ----------
    points : (n, 3) ndarray
    along : (n, 3) ndarray
        Gradient of the harmonic field from the first attachment to the last: the fibres follow it where none
        are given.
    fibres : list of (k, 3) ndarray, or None
        Polylines.
    fallback : (3,) ndarray
        Direction where none can be told.

    Returns
    -------
    (n, 3) ndarray
    """
    if fibres:
        middles = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
        pieces = np.concatenate([np.diff(line, axis=0) for line in fibres])
        near = min(NEAREST, len(middles))
        distance, index = cKDTree(middles).query(points, k=np.arange(1, near + 1))
        unit = pieces / np.linalg.norm(pieces, axis=1, keepdims=True)
        floor = 1e-9 * np.ptp(points, axis=0).max()
        along = (unit[index] / np.maximum(distance, floor)[:, :, None]).sum(axis=1)
    length = np.linalg.norm(along, axis=1)
    weak = length < 1e-9 * max(length.max(), 1e-300)
    along = np.where(weak[:, None], fallback, along)
    return along / np.linalg.norm(along, axis=1, keepdims=True)
