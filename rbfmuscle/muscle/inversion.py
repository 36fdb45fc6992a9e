"""What keeps the material of a muscle's solid from being turned inside out where bones squeeze it.

A quadrature point whose volume det F falls below `LEAST` of that at rest is pulled to the nearest
deformation that has it: the energy gains μ Σ_q w_q `STIFFNESS` min over G of |F_q - G|² with det G
>= `LEAST`, nothing for all other points. Its matrix, as for the other terms, is constant, but has
only the points that need it.
"""

import numpy as np

from rbfmuscle.jit import compiled
from rbfmuscle.muscle.global_step import factor_small

LEAST = 0.5  # det F that a point keeps
STIFFNESS = 100.0  # over 2 μ
SMALLEST = 0.1  # stretch that the search for the nearest deformation starts with at least
# Of that search, a choice: the goal is only pulled at, and asked for anew in every iteration.
ROUNDS = 10


@compiled
def _determinant(m):
    return (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )


@compiled
def nearest_volume(f, out):
    """The nearest matrix to ``f`` (3, 3) with a determinant of at least `LEAST`: squared distance,
    and ``out``.
    """
    u, s, vt = np.linalg.svd(f)
    if _determinant(u) * _determinant(vt) < 0.0:
        s[2] = -s[2]
        for a in range(3):
            u[a, 2] = -u[a, 2]
    d, g = s.copy(), np.empty(3)
    if s[0] * s[1] * s[2] < LEAST:
        for k in range(3):
            d[k] = max(s[k], SMALLEST)
        # Each round goes to the foot of the perpendicular on the tangent plane of d0 d1 d2 = LEAST.
        for _ in range(ROUNDS):
            lacking, square = LEAST - d[0] * d[1] * d[2], 0.0
            g[0] = d[1] * d[2]
            g[1] = d[0] * d[2]
            g[2] = d[0] * d[1]
            for k in range(3):
                lacking += g[k] * (d[k] - s[k])
                square += g[k] * g[k]
            for k in range(3):
                d[k] = s[k] + lacking / square * g[k]
    away = 0.0
    for k in range(3):
        away += (d[k] - s[k]) ** 2
    for a in range(3):
        for b in range(3):
            out[a, b] = (
                u[a, 0] * d[0] * vt[0, b] + u[a, 1] * d[1] * vt[1, b] + u[a, 2] * d[2] * vt[2, b]
            )
    return away


@compiled
def unfold(f, cells, c, p, out):
    """Add what pulls point p of cell c, squeezed to a deformation gradient ``f`` (3, 3), apart to
    the right side ``out`` (N, 3); returns the energy over 2 μ.
    """
    count = cells.slopes.shape[2] // 3
    goal = f
    away = 0.0
    if _determinant(f) < LEAST:
        goal = np.empty((3, 3))
        away = nearest_volume(f, goal)
    share = STIFFNESS * cells.weights[c * count + p]
    for k in range(cells.nodes.shape[1]):
        for a in range(3):
            pull = 0.0
            for b in range(3):
                pull += goal[a, b] * cells.slopes[c, k, b * count + p]
            out[cells.nodes[c, k], a] += share * pull
    return 0.5 * share * away


@compiled
def stiffened_inverse(inverse, cells, points):
    """Inverse (N, N) of the matrix with `STIFFNESS` w |F|² of squeezed points added.

    With B the rows sqrt(STIFFNESS w) ∇N of these points the sum is A + BᵀB, and by Woodbury's
    identity its inverse is A⁻¹ - (L⁻¹ B A⁻¹)ᵀ (L⁻¹ B A⁻¹), where L Lᵀ = I + B A⁻¹ Bᵀ.
    """
    rows, nodes = 3 * len(points), len(inverse)
    count = cells.slopes.shape[2] // 3
    added = np.zeros((rows, nodes))
    for i in range(rows):
        q, a = points[i // 3], i % 3
        root = np.sqrt(STIFFNESS * cells.weights[q])
        c, at = q // count, a * count + q % count
        for k in range(cells.nodes.shape[1]):
            added[i, cells.nodes[c, k]] += root * cells.slopes[c, k, at]
    answer = np.dot(added, inverse)
    small = np.eye(rows) + np.dot(answer, added.T.copy())
    factor_small(small)
    for i in range(rows):
        for o in range(i):
            for n in range(nodes):
                answer[i, n] -= small[i, o] * answer[o, n]
        for n in range(nodes):
            answer[i, n] /= small[i, i]
    return inverse - np.dot(answer.T.copy(), answer)
