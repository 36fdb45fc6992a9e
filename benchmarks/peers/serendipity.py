"""Distance field on 32-node cubic serendipity cells, as in Discregrid (Koschier & Bender 2017)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from peers.detectors import PointDetector, grid_of, sample_nodes
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.validation import check_points


class SerendipityField(PointDetector):
    """Values at the corners of a grid's cells and at two points of each of their edges.

    Parameters
    ----------
    function : callable
        ``function(points) -> (n,)`` signed distances.
    low, high : (3,) array_like
        Box of the grid.
    cells : int or (3,) array_like of int
        Cells along each axis.
    """

    def __init__(
        self, function: Callable[..., Any], low: ArrayLike, high: ArrayLike, cells: ArrayLike
    ) -> None:
        self.low, self.high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        shape = np.broadcast_to(np.asarray(cells, dtype=np.int64), (3,))
        self.edge = (self.high - self.low) / shape
        self.bounds = np.array([self.low, self.high])
        corners = [np.arange(n + 1.0) for n in shape]
        thirds = [(np.arange(n)[:, None] + np.array([1.0, 2.0]) / 3.0).reshape(-1) for n in shape]
        self.nodes = [self._sample(function, corners)]
        for axis in range(3):
            self.nodes.append(
                self._sample(function, [*corners[:axis], thirds[axis], *corners[axis + 1 :]])
            )

    def _sample(self, function, steps):
        return sample_nodes(function, [self.low[k] + self.edge[k] * steps[k] for k in range(3)])

    @classmethod
    def from_mesh(cls, mesh: MeshLike, *, cells: int = 64) -> SerendipityField:
        """Field of a mesh over its box, widened by a tenth of the longest side."""
        exact, low, high = grid_of(mesh)
        return cls(exact.signed_distance, low, high, cells)

    @property
    def memory(self) -> int:
        """Bytes of the node values."""
        return sum(values.nbytes for values in self.nodes)

    def _local(self, points):
        points = check_points(points)
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
        _serendipity_loop(points, self.low, self.edge, tuple(self.nodes), distance, gradient)
        return distance, gradient


@njit
def _serendipity_loop(points, low, edge, nodes, distance, gradient):
    corners, on_x, on_y, on_z = nodes
    cell = np.empty(3, np.int64)
    t = np.empty(3)
    grad = np.empty(3)
    for n in range(len(points)):
        for k in range(3):
            u = min(max((points[n, k] - low[k]) / edge[k], 0.0), corners.shape[k] - 1.0)
            cell[k] = min(int(u), corners.shape[k] - 2)
            t[k] = 2.0 * (u - cell[k]) - 1.0
        value, grad[:] = 0.0, 0.0
        square = t[0] ** 2 + t[1] ** 2 + t[2] ** 2
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    node = corners[cell[0] + a, cell[1] + b, cell[2] + c]
                    value += _corner(t, 2 * a - 1, 2 * b - 1, 2 * c - 1, square, node, grad)
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    node = on_x[2 * cell[0] + a, cell[1] + b, cell[2] + c]
                    value += _edge(t, (0, 1, 2), (2 * a - 1, 2 * b - 1, 2 * c - 1), node, grad)
                    node = on_y[cell[0] + c, 2 * cell[1] + a, cell[2] + b]
                    value += _edge(t, (1, 2, 0), (2 * a - 1, 2 * b - 1, 2 * c - 1), node, grad)
                    node = on_z[cell[0] + b, cell[1] + c, 2 * cell[2] + a]
                    value += _edge(t, (2, 0, 1), (2 * a - 1, 2 * b - 1, 2 * c - 1), node, grad)
        distance[n] = value
        for k in range(3):
            gradient[n, k] = 2.0 * grad[k] / edge[k]


@njit
def _corner(t, a, b, c, square, node, grad):
    """Add (1/64)(1 + a x)(1 + b y)(1 + c z)(9 (x^2 + y^2 + z^2) - 19) times the node to the
    gradient.
    """
    x = 1.0 + a * t[0]
    y = 1.0 + b * t[1]
    z = 1.0 + c * t[2]
    w = 9.0 * square - 19.0
    s = node / 64.0
    grad[0] += s * y * z * (a * w + 18.0 * t[0] * x)
    grad[1] += s * x * z * (b * w + 18.0 * t[1] * y)
    grad[2] += s * x * y * (c * w + 18.0 * t[2] * z)
    return s * x * y * z * w


@njit
def _edge(t, axes, sides, node, grad):
    """Add (9/64)(1 - x^2)(1 + 9 x_i x)(1 + b y)(1 + c z), x_i = a/3, x along axis i, times the
    node.
    """
    i, j, k = axes
    a, b, c = sides
    x = t[i]
    y = 1.0 + b * t[j]
    z = 1.0 + c * t[k]
    u = 1.0 - x * x
    v = 1.0 + 3.0 * a * x
    s = 9.0 * node / 64.0
    grad[i] += s * y * z * (3.0 * a * u - 2.0 * x * v)
    grad[j] += s * u * v * b * z
    grad[k] += s * u * v * y * c
    return s * u * v * y * z
