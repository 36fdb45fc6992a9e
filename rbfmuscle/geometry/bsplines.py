"""Uniform cubic B-splines on a lattice, for compiled loops: weights of the nodes about a place, and
their sum.
"""

import numpy as np

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
