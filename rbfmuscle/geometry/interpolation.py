"""The displacement of a surface, interpolated into what it encloses."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers

CENTRES = 300  # points of the surface that the interpolation passes through, at most


class SurfaceInterpolation:
    """Places of points in a surface that is deformed: a polyharmonic spline of its displacement.

    Of the vertices (n, 3) at rest some `CENTRES`, evenly over the surface, are the centres of a
    spline of kernel r³ with a linear polynomial: the triharmonic one in space. Each affine
    displacement, hence each rigid motion, comes out exactly. ``points`` (m, 3) are at rest.
    """

    def __init__(self, vertices: Floats, points: Floats) -> None:
        self.points = points
        self.chosen = spread_points(vertices, CENTRES)
        self.rest = vertices[self.chosen]
        middle = self.rest.mean(axis=0)
        size = float(np.linalg.norm(np.ptp(self.rest, axis=0)))
        centres = (self.rest - middle) / size
        rows = _row(centres, centres)
        count = len(centres)
        matrix = np.zeros((count + 4, count + 4))
        matrix[:count] = rows
        matrix[count:, :count] = rows[:, count:].T
        self.weights = np.linalg.solve(matrix.T, _row((points - middle) / size, centres).T)
        self.weights = np.ascontiguousarray(self.weights[:count].T)

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


def _row(points: Floats, centres: Floats) -> Floats:
    """Kernels about the centres (m, 3), then 1, x, y and z, at points (n, 3)."""
    from scipy.spatial.distance import cdist

    return np.hstack([cdist(points, centres) ** 3, np.ones((len(points), 1)), points])
