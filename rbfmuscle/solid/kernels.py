"""The loops of the solid that take the time; each is called from Python and tested alone.

The local step finds at each quadrature point the rotation R and the fibre stretch t of least energy
(`model.py`), by a few steps of Newton's method that go on from the last iteration's: over the
iterations both converge. For these the forces on the nodes are Σ_q w_q (T_q - F_q) ∇N_q, where T_q
is the deformation that a point wants (Bouaziz et al. 2014, "Projective dynamics").

The points of a cell share its nodes, so that their deformation gradients are one product of
matrices and the forces on the nodes another; between them processors treat several points at once.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import cross, dot, quaternion_matrix, row_of, turn_towards
from rbfmuscle.loops import loop
from rbfmuscle.solid.lattice import GROUPS as POINTS

# What is known at the points of a cell: rows of as many numbers as it has points, matrices row by
# row. The loop over the points is only compiled for several at once where all is in one array.
GRADIENT = 0  # 9: F
ROTATION = 9  # 4: R as a unit quaternion
STRETCH = 13  # t of slack fibres
FIBRE = 14  # 3: a
LOWER = 17  # stretches between which a fibre is slack
UPPER = 18
PASSIVE = 19  # stiffness of a fibre, and that of an active one, with the stretch that it wants
ACTIVE = 20
CONTENT = 21
WEIGHT = 22  # w
STRESS = 23  # 9: w (T - F)
COFACTOR = 32  # 9: of F, times w
DETERMINANT = 41
ROWS = 42

ROUNDS = 10  # of the search for a squeezed point's nearest deformation, found anew each iteration
STEPS = 3  # of Newton's method for a stretch in an iteration


def at_points(work: Floats, row: int, *shape: int) -> Floats:
    """What the local step knows at the quadrature points (Q, ...), from a row of its ``work``
    (C, ROWS * P) on.
    """
    known = work.reshape(len(work), ROWS, POINTS)[:, row : row + int(np.prod(shape))]
    return known.swapaxes(1, 2).reshape(-1, *shape)


@loop
def local_step(nodes, slopes, region, y, tension, work, right, gradient, volumes):
    """Rotations, stretches and what follows from them for nodes y (N, 3).

    Of C cells, ``nodes`` (C, 27), the gradients of their shape functions ``slopes`` (C, 27, 3 P),
    in column a P + p that along axis a at point p, and the ``region`` (C,) of each. ``work``
    (C, ROWS * P) holds what is known at the points and is brought up to date; ``right`` (N, 3)
    becomes the forces on the nodes, ``gradient`` (M, 3, N) that of the regions' volumes by the
    nodes, and ``volumes`` (M,) these. ``tension`` is that of slack fibres over 2 μ.
    """
    right[:] = 0.0
    gradient[:] = 0.0
    volumes[:] = 0.0
    width = nodes.shape[1]
    forces = np.empty((6, width))
    for c in range(len(nodes)):
        points = work[c]
        deform(y, nodes[c], slopes[c], points)
        stress_points(points, tension)
        stresses = points[STRESS * POINTS : DETERMINANT * POINTS].reshape((6, 3 * POINTS))
        np.dot(stresses, slopes[c].T, forces)
        r = region[c]
        for k in range(width):
            n = nodes[c, k]
            for a in range(3):
                right[n, a] += forces[a, k]
                gradient[r, a, n] += forces[3 + a, k]
        for p in range(POINTS):
            volumes[r] += points[WEIGHT * POINTS + p] * points[DETERMINANT * POINTS + p]


@loop(fastmath={"contract"})
def deform(y, nodes, slopes, points):
    """Write the deformation gradients Σ_k y_k ∇N_k at the points of a cell with ``nodes`` (27,) and
    ``slopes`` (27, 3 P) to its rows ``points``.
    """
    width = 3 * POINTS
    x = points[:width]
    y_ = points[width : 2 * width]
    z = points[2 * width : 3 * width]
    for i in range(width):
        x[i] = 0.0
        y_[i] = 0.0
        z[i] = 0.0
    for k in range(len(nodes)):
        px = y[nodes[k], 0]
        py = y[nodes[k], 1]
        pz = y[nodes[k], 2]
        slope = slopes[k]
        for i in range(width):
            x[i] += px * slope[i]
            y_[i] += py * slope[i]
            z[i] += pz * slope[i]


@loop(fastmath={"contract"})
def stress_points(work, tension):
    """R, t, stresses, cofactors and volumes at the points of a cell.

    R is the rotation of F D(t) for the last t, then t minimises |RᵀF - D(t)|² + 2 tension t in
    [lower, 1]. The target is T = R (t aaᵀ + t^(-1/2) (I - aaᵀ)) and what springs along the fibre
    want.
    """
    for p in range(POINTS):
        f = _matrix(work, GRADIENT, p)
        a = _vector(work, FIBRE, p)
        fa = (dot(f[0], a), dot(f[1], a), dot(f[2], a))
        t = work[STRETCH * POINTS + p]
        u = 1.0 / np.sqrt(t)
        fd = _plus(f, u, fa, t - u, a)
        q = (
            work[ROTATION * POINTS + p],
            work[(ROTATION + 1) * POINTS + p],
            work[(ROTATION + 2) * POINTS + p],
            work[(ROTATION + 3) * POINTS + p],
        )
        q = turn_towards(fd, turn_towards(fd, q))
        for k in range(4):
            work[(ROTATION + k) * POINTS + p] = q[k]
        r = quaternion_matrix(q)
        ra = (dot(r[0], a), dot(r[1], a), dot(r[2], a))
        # S = RᵀF: s is its part along the fibre, across the sum of those across.
        s = dot(ra, fa)
        across = dot(r[0], f[0]) + dot(r[1], f[1]) + dot(r[2], f[2]) - s
        lower = work[LOWER * POINTS + p]
        for _ in range(STEPS):
            v = 1.0 / t
            root = np.sqrt(v)
            slope = t - v * v - s + 0.5 * across * v * root + tension
            bend = 1.0 + 2.0 * v * v * v - 0.75 * across * v * v * root
            t = min(max(t - slope / max(bend, 0.5), lower), 1.0)
        work[STRETCH * POINTS + p] = t
        u = 1.0 / np.sqrt(t)
        length = np.sqrt(dot(fa, fa) + 1e-12)
        slack = min(max(length, lower), work[UPPER * POINTS + p])
        passive, active = work[PASSIVE * POINTS + p], work[ACTIVE * POINTS + p]
        wanted = passive * slack + active * work[CONTENT * POINTS + p]
        pull = wanted / length - passive - active
        w = work[WEIGHT * POINTS + p]
        along = (
            (t - u) * ra[0] + pull * fa[0],
            (t - u) * ra[1] + pull * fa[1],
            (t - u) * ra[2] + pull * fa[2],
        )
        stress = _plus(r, u, along, 1.0, a)
        stress = (
            _row(stress[0], 1.0, -1.0, f[0]),
            _row(stress[1], 1.0, -1.0, f[1]),
            _row(stress[2], 1.0, -1.0, f[2]),
        )
        _put(work, STRESS, p, w, stress)
        first = cross(f[1], f[2])
        work[DETERMINANT * POINTS + p] = dot(f[0], first)
        second = cross(f[2], f[0])
        third = cross(f[0], f[1])
        _put(work, COFACTOR, p, w, (first, second, third))


@loop
def pull_apart(squeezed, nodes, slopes, least, stiffness, work, right):
    """Add what pulls squeezed quadrature points (k,) to the nearest deformation G with det G of at
    least ``least`` to the forces ``right`` (N, 3); returns its energy over 2 μ.
    """
    energy = 0.0
    nearest = nearest_deformations(squeezed, least, work)
    for i in range(len(squeezed)):
        c = squeezed[i] // POINTS
        p = squeezed[i] % POINTS
        f = _matrix(work[c], GRADIENT, p)
        weight = stiffness * work[c, WEIGHT * POINTS + p]
        for a in range(3):
            away = _row(row_of(nearest[i], a), 1.0, -1.0, f[a])
            energy += 0.5 * weight * dot(away, away)
            for k in range(nodes.shape[1]):
                pull = 0.0
                for b in range(3):
                    pull += away[b] * slopes[c, k, b * POINTS + p]
                right[nodes[c, k], a] += weight * pull
    return energy


@loop
def nearest_deformations(squeezed, least, work):
    """The nearest deformations G (k, 3, 3) to F with det G of at least ``least`` at squeezed
    quadrature points (k,).

    Each round goes to the foot of the perpendicular from F on the tangent plane of det G = least,
    the first from the rotation R of the point.
    """
    nearest = np.empty((len(squeezed), 3, 3))
    for i in range(len(squeezed)):
        points = work[squeezed[i] // POINTS]
        p = squeezed[i] % POINTS
        f = _matrix(points, GRADIENT, p)
        g = f
        if points[DETERMINANT * POINTS + p] < least:
            q = (
                points[ROTATION * POINTS + p],
                points[(ROTATION + 1) * POINTS + p],
                points[(ROTATION + 2) * POINTS + p],
                points[(ROTATION + 3) * POINTS + p],
            )
            g = quaternion_matrix(q)
            for _ in range(ROUNDS):
                h = (cross(g[1], g[2]), cross(g[2], g[0]), cross(g[0], g[1]))
                # det G is a cubic: its slope times G is three times its value.
                lacking = least + 2.0 * dot(g[0], h[0])
                lacking -= dot(h[0], f[0]) + dot(h[1], f[1]) + dot(h[2], f[2])
                share = lacking / (dot(h[0], h[0]) + dot(h[1], h[1]) + dot(h[2], h[2]))
                g = (
                    _row(f[0], 1.0, share, h[0]),
                    _row(f[1], 1.0, share, h[1]),
                    _row(f[2], 1.0, share, h[2]),
                )
        for a in range(3):
            nearest[i, a, 0] = g[a][0]
            nearest[i, a, 1] = g[a][1]
            nearest[i, a, 2] = g[a][2]
    return nearest


@loop
def add_stiffness(nodes, slopes, stiffness, out):
    """Add the stiffness of C cells to that of the nodes (3 N, 3 N), whose rows are node by node.

    ``stiffness`` (C, 3, 3, 3, 3, P) is w ∂²ψ / ∂F_ab ∂F_cd at the points of a cell, in that order.
    """
    corners = nodes.shape[1]
    half = np.empty((3 * corners, 3 * POINTS))
    for c in range(len(nodes)):
        for a in range(3):
            for n in range(corners):
                for d in range(3):
                    row = half[3 * n + d]
                    for b in range(3):
                        for p in range(POINTS):
                            value = 0.0
                            for e in range(3):
                                value += stiffness[c, a, b, d, e, p] * slopes[c, n, e * POINTS + p]
                            row[b * POINTS + p] = value
            found = np.dot(slopes[c], half.T)
            for k in range(corners):
                target = out[3 * nodes[c, k] + a]
                for n in range(corners):
                    first = 3 * nodes[c, n]
                    for d in range(3):
                        target[first + d] += found[k, 3 * n + d]


@loop
def region_volumes(nodes, slopes, weights, region, y, out):
    """Fill the volumes (M,) of the regions for nodes y (N, 3); ``weights`` (Q,) are those of the
    quadrature points, the rest is as in `local_step`.
    """
    out[:] = 0.0
    points = np.empty(ROWS * POINTS)
    for c in range(len(nodes)):
        deform(y, nodes[c], slopes[c], points)
        for p in range(POINTS):
            f = _matrix(points, GRADIENT, p)
            out[region[c]] += weights[c * POINTS + p] * dot(f[0], cross(f[1], f[2]))


@loop(fastmath={"contract"})
def carry_steps(which, columns, shares, y, step, push, margin, here, motion, reach):
    """Fill the places (m, 3) of points ``which`` (m,), their ``motion`` (m, 3) in a step (N, 3) of
    the nodes, and how far to look for obstacles (m,): half as far again as they go with the last
    ``push`` (N, 3) on top, and a margin.
    """
    for m in range(len(which)):
        i = which[m]
        far = 0.0
        for a in range(3):
            at = 0.0
            by = 0.0
            on = 0.0
            for k in range(columns.shape[1]):
                share = shares[i, k]
                n = columns[i, k]
                at += share * y[n, a]
                by += share * step[n, a]
                on += share * push[n, a]
            here[m, a] = at
            motion[m, a] = by
            far += (by + on) ** 2
        reach[m] = 1.5 * np.sqrt(far) + margin


@loop(fastmath={"contract"})
def add_rows(columns, shares, matrix, out):
    """Fill the rows Σ_k shares_k matrix_k (n, m) of a matrix (N, m) for points as in `carry`."""
    for i in range(len(columns)):
        row = out[i]
        row[:] = 0.0
        for k in range(columns.shape[1]):
            share = shares[i, k]
            source = matrix[columns[i, k]]
            for n in range(len(row)):
                row[n] += share * source[n]


@loop
def turned_normals(nodes, columns, slopes, normals, out):
    """Fill the unit normals (n, 3) of the deformed surface at points: the cofactor of the
    deformation gradient times the normals at rest. The points hang on ``columns`` (n, 27) with the
    ``slopes`` (n, 27, 3) of the shape functions.
    """
    f = np.empty((3, 3))
    for s in range(len(normals)):
        f[:] = 0.0
        for k in range(columns.shape[1]):
            j = columns[s, k]
            for a in range(3):
                for b in range(3):
                    f[a, b] += nodes[j, a] * slopes[s, k, b]
        square = 0.0
        for a in range(3):
            p, q = (a + 1) % 3, (a + 2) % 3
            value = 0.0
            for b in range(3):
                u, v = (b + 1) % 3, (b + 2) % 3
                value += (f[p, u] * f[q, v] - f[p, v] * f[q, u]) * normals[s, b]
            out[s, a] = value
            square += value * value
        for a in range(3):
            out[s, a] /= np.sqrt(square)


@loop(inline="always")
def _vector(work, row, p):
    return work[row * POINTS + p], work[(row + 1) * POINTS + p], work[(row + 2) * POINTS + p]


@loop(inline="always")
def _matrix(work, row, p):
    return _vector(work, row, p), _vector(work, row + 3, p), _vector(work, row + 6, p)


@loop(inline="always")
def _put(work, row, p, factor, matrix):
    for k in range(3):
        work[(row + k) * POINTS + p] = factor * matrix[0][k]
        work[(row + 3 + k) * POINTS + p] = factor * matrix[1][k]
        work[(row + 6 + k) * POINTS + p] = factor * matrix[2][k]


@loop(inline="always")
def _plus(m, share, u, factor, v):
    """Rows of share m + factor u vᵀ."""
    return (
        _row(m[0], share, factor * u[0], v),
        _row(m[1], share, factor * u[1], v),
        _row(m[2], share, factor * u[2], v),
    )


@loop(inline="always")
def _row(m, share, factor, v):
    return share * m[0] + factor * v[0], share * m[1] + factor * v[1], share * m[2] + factor * v[2]
