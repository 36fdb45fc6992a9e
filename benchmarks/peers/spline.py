"""Distance field on a tricubic B-spline over an isotropic grid."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from peers.detectors import PointDetector, grid_of, sample_nodes
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.geometry.interpolation import bspline_weights
from rbfmuscle.validation import check_points


class SplineField(PointDetector):
    """B-spline that interpolates signed distances at the nodes of a grid.

    Parameters
    ----------
    function : callable
        ``function(points) -> (n,)`` signed distances.
    low, high : (3,) array_like
        Box of the grid; it is covered, and exceeded by less than a cell.
    spacing : float
        Edge of a cell.
    """

    def __init__(
        self, function: Callable[..., Any], low: ArrayLike, high: ArrayLike, spacing: float
    ) -> None:
        from scipy.ndimage import spline_filter

        self.bounds = np.array([low, high], dtype=np.float64)
        self.spacing = float(spacing)
        # Two more nodes on each side, so that the border's condition does not reach the box.
        shape = np.ceil((self.bounds[1] - self.bounds[0]) / spacing).astype(np.int64) + 5
        self.origin = self.bounds[0] - 2.0 * spacing
        axes = [self.origin[k] + spacing * np.arange(shape[k]) for k in range(3)]
        self.coefficients = spline_filter(sample_nodes(function, axes), order=3, mode="mirror")

    @classmethod
    def from_mesh(cls, mesh: MeshLike, *, nodes: int = 1_900_000) -> SplineField:
        """Field of a mesh over its box, widened by a tenth of the longest side, with about this
        many nodes.
        """
        exact, low, high = grid_of(mesh)
        return cls(exact.signed_distance, low, high, float(np.prod(high - low) / nodes) ** (1 / 3))

    @property
    def memory(self) -> int:
        """Bytes of the coefficients."""
        return self.coefficients.nbytes

    def _local(self, points):
        points = check_points(points)
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
        _spline_loop(points, self.origin, self.spacing, self.coefficients, distance, gradient)
        return distance, gradient


@njit
def _spline_loop(points, origin, spacing, coefficients, distance, gradient):
    weight = np.empty((3, 4))
    slope = np.empty((3, 4))
    base = np.empty(3, np.int64)
    for n in range(len(points)):
        for k in range(3):
            u = (points[n, k] - origin[k]) / spacing
            u = min(max(u, 1.0), coefficients.shape[k] - 2.000001)
            base[k] = int(u) - 1
            bspline_weights(u - int(u), weight[k], slope[k])
        distance[n] = 0.0
        gradient[n] = 0.0
        for a in range(4):
            line = 0.0
            side = 0.0
            lean = 0.0
            for b in range(4):
                here = 0.0
                along = 0.0
                for c in range(4):
                    node = coefficients[base[0] + a, base[1] + b, base[2] + c]
                    here += weight[2, c] * node
                    along += slope[2, c] * node
                line += weight[1, b] * here
                side += slope[1, b] * here
                lean += weight[1, b] * along
            distance[n] += weight[0, a] * line
            gradient[n, 0] += slope[0, a] * line / spacing
            gradient[n, 1] += weight[0, a] * side / spacing
            gradient[n, 2] += weight[0, a] * lean / spacing
