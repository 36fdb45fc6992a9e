"""The greatest balls beside a surface that touch it in a point and hold none of its other points."""

import numpy as np

from rbfmuscle.jit import compiled


@compiled
def touching_balls(points, normals, steps, nearest):
    """Radii ``steps`` (2, n) of the empty balls that touch each point from outside and inside, infinite where no point
    limits them, and how far the nearest other point is.
    """
    for i in range(len(points)):
        steps[:, i] = np.inf
        least = np.inf
        for j in range(len(points)):
            square, along = 0.0, 0.0
            for c in range(3):
                d = points[j, c] - points[i, c]
                square += d * d
                along += d * normals[i, c]
            if j == i:
                continue
            least = min(least, square)
            side = 0 if along > 0 else 1
            if along != 0.0:
                steps[side, i] = min(steps[side, i], square / (2 * abs(along)))
        nearest[i] = np.sqrt(least)
