"""Values between nodes: uniform cubic B-splines on a lattice, points that are sums of nodes, and
the displacement of a surface in what it encloses.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.loops import loop


@loop
def bspline_weights(t):
    """Weights of the four nodes about a place ``t`` in [0, 1] of a cell, and their derivatives by
    ``t``.
    """
    s = 1.0 - t
    weights = (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )
    return weights, (-0.5 * s * s, 1.5 * t * t - 2.0 * t, 2.0 * s - 1.5 * s * s, 0.5 * t * t)


@loop(fastmath={"contract"})
def bspline_sum(blocks, block, start, width, x, y, z):
    """Value and gradient, in units of a cell, at a place x, y, z of a cell.

    Its 4 x 4 x 4 nodes are those from ``start`` on of a row of ``blocks``, each ``width`` nodes
    along each axis, flattened.
    """
    weight_x, slope_x = bspline_weights(x)
    weight_y, slope_y = bspline_weights(y)
    (w0, w1, w2, w3), (s0, s1, s2, s3) = bspline_weights(z)
    value = 0.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    for a in range(4):
        line = 0.0
        lean = 0.0
        side = 0.0
        for b in range(4):
            # Unsigned, as compiled code looks for negative ones otherwise.
            k = np.uint64(start + (a * width + b) * width)
            n0, n1 = blocks[block, k], blocks[block, k + np.uint64(1)]
            n2, n3 = blocks[block, k + np.uint64(2)], blocks[block, k + np.uint64(3)]
            here = w0 * n0 + w1 * n1 + w2 * n2 + w3 * n3
            line += weight_y[b] * here
            side += slope_y[b] * here
            lean += weight_y[b] * (s0 * n0 + s1 * n1 + s2 * n2 + s3 * n3)
        value += weight_x[a] * line
        gx += slope_x[a] * line
        gy += weight_x[a] * side
        gz += weight_x[a] * lean
    return value, gx, gy, gz


class Embedding(NamedTuple):
    """Points (n,) as sums of k nodes each."""

    columns: Integers  # (n, k)
    shares: Floats  # (n, k)

    def of(self, values: Floats) -> Floats:
        """Sums (n, 3) of values (N, 3) at the nodes."""
        out = np.empty((len(self.columns), 3))
        carry(self.columns, self.shares, values, out)
        return out

    def some(self, chosen: Integers) -> "Embedding":
        """Those of some of the points."""
        return Embedding(self.columns[chosen], self.shares[chosen])


@loop(fastmath={"contract"})
def carry(columns, shares, nodes, out):
    """Fill the places (n, 3) of points that are sums of nodes, Σ_k shares_k nodes_k."""
    for i in range(len(columns)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(columns.shape[1]):
            share = shares[i, k]
            n = columns[i, k]
            x += share * nodes[n, 0]
            y += share * nodes[n, 1]
            z += share * nodes[n, 2]
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z


CENTRES = 300  # points of the surface that the interpolation passes through, at most


class SurfaceInterpolation:
    """Places of points in a surface that is deformed: a polyharmonic spline of its displacement.

    Of the vertices (n, 3) at rest some `CENTRES`, evenly over the surface, are the centres of a
    spline of kernel r³ with a linear polynomial: the triharmonic one in space. Each affine
    displacement, hence each rigid motion, comes out exactly. ``points`` (m, 3) are at rest.
    """

    def __init__(self, vertices: Floats, points: Floats) -> None:
        from scipy.interpolate import RBFInterpolator

        self.points = points
        self.chosen = spread_points(vertices, CENTRES)
        self.rest = vertices[self.chosen]
        # The spline is linear in what it passes through: of each centre alone it is its weights.
        alone = np.eye(len(self.rest))
        self.weights = RBFInterpolator(self.rest, alone, kernel="cubic", degree=1)(points)

    def __call__(self, vertices: Floats) -> Floats:
        """Places (m, 3) of the points where the vertices (n, 3) are now."""
        return self.points + self.weights @ (vertices[self.chosen] - self.rest)


def spread_points(points: Floats, count: int) -> Integers:
    """Numbers (count,) of points (n, 3) that lie far from each other, each the farthest from those
    before; of all points where there are not more.
    """
    if len(points) <= count:
        return np.arange(len(points))
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(len(points), np.inf)
    for k in range(1, count):
        offset = points - points[chosen[k - 1]]
        np.minimum(distance, np.einsum("ij,ij->i", offset, offset), out=distance)
        chosen[k] = distance.argmax()
    return chosen
