"""Uniform cubic B-splines on a lattice, for compiled loops: weights of the nodes about a place, and
their sum.
"""

import numpy as np

from rbfmuscle.jit import compiled


@compiled(error_model="numpy")
def bspline_weights(t, weight, slope):
    """Fill the weights (4,) of the nodes about a place ``t`` in [0, 1] of a cell, and their
    derivatives by ``t``.
    """
    s = 1.0 - t
    weight[0], weight[3] = s * s * s / 6.0, t * t * t / 6.0
    weight[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    weight[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    slope[0], slope[3] = -0.5 * s * s, 0.5 * t * t
    slope[1] = 1.5 * t * t - 2.0 * t
    slope[2] = 2.0 * s - 1.5 * s * s


@compiled(error_model="numpy", fastmath={"contract"})
def bspline_sum(nodes, start, width, weight, slope):
    """Value and gradient, in units of a cell, of the 4 x 4 x 4 nodes from ``start`` on of a block
    of ``width`` nodes along each axis, flattened; weights and slopes are (3, 4).
    """
    value = 0.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    w0 = weight[2, 0]
    w1 = weight[2, 1]
    w2 = weight[2, 2]
    w3 = weight[2, 3]
    s0 = slope[2, 0]
    s1 = slope[2, 1]
    s2 = slope[2, 2]
    s3 = slope[2, 3]
    for a in range(4):
        line = 0.0
        lean = 0.0
        side = 0.0
        for b in range(4):
            # Unsigned, as compiled code looks for negative ones otherwise.
            k = np.uint64(start + (a * width + b) * width)
            n0, n1 = nodes[k], nodes[k + np.uint64(1)]
            n2, n3 = nodes[k + np.uint64(2)], nodes[k + np.uint64(3)]
            here = w0 * n0 + w1 * n1 + w2 * n2 + w3 * n3
            line += weight[1, b] * here
            side += slope[1, b] * here
            lean += weight[1, b] * (s0 * n0 + s1 * n1 + s2 * n2 + s3 * n3)
        value += weight[0, a] * line
        gx += slope[0, a] * line
        gy += weight[0, a] * side
        gz += weight[0, a] * lean
    return value, gx, gy, gz
