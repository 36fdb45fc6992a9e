"""Uniform cubic B-splines on a lattice, for compiled loops: weights of the nodes about a place, and
their sum.
"""

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


@compiled(error_model="numpy")
def bspline_sum(nodes, first, weight, slope):
    """Value and gradient, in units of a cell, from the 4 x 4 x 4 nodes from ``first`` on and
    weights (3, 4).
    """
    value = 0.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    for a in range(4):
        for b in range(4):
            line, lean = 0.0, 0.0
            for c in range(4):
                node = nodes[first[0] + a, first[1] + b, first[2] + c]
                line += weight[2, c] * node
                lean += slope[2, c] * node
            value += weight[0, a] * weight[1, b] * line
            gx += slope[0, a] * weight[1, b] * line
            gy += weight[0, a] * slope[1, b] * line
            gz += weight[0, a] * weight[1, b] * lean
    return value, gx, gy, gz
