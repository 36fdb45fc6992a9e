"""The local step of a solid's iteration: what each quadrature point wants, for the present nodes.

At each point R and t minimise the energy (`model.py`), and what is squeezed wants a volume
(`inversion.py`). The energy is then quadratic in the nodes, with a matrix that does not depend on
R and t and the right side Σ_q w_q T_q ∇N (Bouaziz et al. 2014, "Projective dynamics").

The points of a cell share its nodes, so that their deformation gradients are one product of
matrices and the forces on the nodes another; between them processors treat several points at once.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.rotations import cross, dot, quaternion_matrix, turn_towards
from rbfmuscle.implicit.placement.lattice import GROUPS as POINTS
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.inversion import LEAST, unfold

# What is known at the points of a cell: rows of as many numbers as it has points, matrices row by
# row. The loop over the points is only compiled for several at once where all is in one array.
GRADIENT = 0  # 9: F
ROTATION = 9  # 4: R as a unit quaternion
STRETCH = 13  # t of slack fibres
FIBRE = 14  # 3: a
LOWER = 17  # stretches between which a fibre is slack
UPPER = 18
PASSIVE = 19  # stiffness of a fibre, and that of an active one times the stretch that it wants
ACTIVE = 20
WEIGHT = 21  # w
STRESS = 22  # 9: w T
COFACTOR = 31  # 9: of F, times w
DETERMINANT = 40
ROWS = 41

STEPS = 3  # of Newton's method for a stretch in an iteration, which goes on from the last


class Local(NamedTuple):
    """What the local step finds."""

    work: np.ndarray  # (C, ROWS * POINTS) what is known at the points of each cell
    stiffened: np.ndarray  # (Q,) whether a point was squeezed in this solve
    right: np.ndarray  # (N, 3) right side
    gradient: np.ndarray  # (S, 3) of the regions' volumes
    volumes: np.ndarray  # (M,) of the regions


@compiled
def start_local(model, state, activation):
    """Arrays for the local steps of a solve."""
    cells, fibres = model.cells, model.fibres
    work = np.empty((len(cells.nodes), ROWS * POINTS))
    for c in range(len(work)):
        for p in range(POINTS):
            i = c * POINTS + p
            for k in range(4):
                work[c, (ROTATION + k) * POINTS + p] = state.rotations[i, k]
            for k in range(3):
                work[c, (FIBRE + k) * POINTS + p] = fibres.direction[i, k]
            work[c, STRETCH * POINTS + p] = state.stretches[i]
            work[c, LOWER * POINTS + p] = fibres.lower[i]
            work[c, UPPER * POINTS + p] = fibres.upper[i]
            work[c, PASSIVE * POINTS + p] = fibres.passive[i]
            work[c, ACTIVE * POINTS + p] = activation * fibres.active[i] * fibres.content[i]
            work[c, WEIGHT * POINTS + p] = cells.weights[i]
    return Local(
        work,
        np.zeros(len(cells.weights), np.bool_),
        np.empty_like(model.rest),
        np.empty((len(cells.node), 3)),
        np.empty(len(cells.volumes)),
    )


@compiled
def found_rotations(local):
    """Rotations (Q, 4) as unit quaternions, and stretches (Q,)."""
    work = local.work
    rotations, stretches = np.empty((len(work) * POINTS, 4)), np.empty(len(work) * POINTS)
    for c in range(len(work)):
        for p in range(POINTS):
            stretches[c * POINTS + p] = work[c, STRETCH * POINTS + p]
            for k in range(4):
                rotations[c * POINTS + p, k] = work[c, (ROTATION + k) * POINTS + p]
    return rotations, stretches


@compiled
def local_step(cells, y, tension, local):
    """Fill ``local`` for nodes ``y``: how many points joined the squeezed ones, and the energy of
    these over 2 μ.
    """
    local.right[:] = 0.0
    local.gradient[:] = 0.0
    local.volumes[:] = 0.0
    joined, energy = 0, 0.0
    nodes = cells.nodes
    slot = cells.slot
    right = local.right
    gradient = local.gradient
    width = nodes.shape[1]
    forces = np.empty((6, width))
    for c in range(len(cells.nodes)):
        work = local.work[c]
        deform(y, cells.nodes[c], cells.slopes[c], work)
        _stress_points(work, tension)
        stresses = work[STRESS * POINTS : DETERMINANT * POINTS].reshape((6, 3 * POINTS))
        np.dot(stresses, cells.slopes[c].T, forces)
        for k in range(width):
            for a in range(3):
                right[nodes[c, k], a] += forces[a, k]
                gradient[slot[c, k], a] += forces[3 + a, k]
        for p in range(POINTS):
            i, det = c * POINTS + p, work[DETERMINANT * POINTS + p]
            local.volumes[cells.region[c]] += cells.weights[i] * det
            if det < LEAST and not local.stiffened[i]:
                local.stiffened[i] = True
                joined += 1
            if local.stiffened[i]:
                energy += unfold(np.array(_matrix(work, GRADIENT, p)), cells, c, p, local.right)
    return joined, energy


@compiled(fastmath={"contract"})
def deform(y, nodes, slopes, work):
    """Write the deformation gradients Σ_k y_k ∇N_k at the points of a cell to its ``work``;
    ``nodes`` (27,) are its nodes, ``slopes`` (27, 3 POINTS) the gradients of their shape functions.
    """
    width = 3 * POINTS
    x = work[:width]
    y_ = work[width : 2 * width]
    z = work[2 * width : 3 * width]
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


@compiled
def volumes(cells, y):
    """Volumes (M,) of the regions for nodes y (N, 3)."""
    out = np.zeros(len(cells.volumes))
    work = np.empty(ROWS * POINTS)
    for c in range(len(cells.nodes)):
        deform(y, cells.nodes[c], cells.slopes[c], work)
        for p in range(POINTS):
            f = _matrix(work, GRADIENT, p)
            out[cells.region[c]] += cells.weights[c * POINTS + p] * dot(f[0], cross(f[1], f[2]))
    return out


@compiled(fastmath={"contract"})
def _stress_points(work, tension):
    """R, t, stresses, cofactors and volumes at the points of a cell.

    R is the rotation of F D(t) for the last t, then t minimises |RᵀF - D(t)|² + 2 tension t in
    [lower, 1]; each by a few steps of Newton's method, and over the iterations both converge. The
    target is T = R (t aaᵀ + t^(-1/2) (I - aaᵀ)) and what springs along the fibre want.
    """
    for p in range(POINTS):
        f = _matrix(work, GRADIENT, p)
        a = _vector(work, FIBRE, p)
        fa = _times(f, a)
        t = work[STRETCH * POINTS + p]
        u = 1.0 / np.sqrt(t)
        fd = _plus(f, u, fa, t - u, a)
        r = quaternion_matrix(_turned(work, fd, p))
        ra = _times(r, a)
        # S = RᵀF: s is its part along the fibre, across the sum of those across.
        s = dot(ra, fa)
        across = dot(r[0], f[0]) + dot(r[1], f[1]) + dot(r[2], f[2]) - s
        lower = work[LOWER * POINTS + p]
        t = _fibre_stretch(t, s, across, tension, lower)
        work[STRETCH * POINTS + p] = t
        u = 1.0 / np.sqrt(t)
        length = np.sqrt(dot(fa, fa) + 1e-12)
        slack = min(max(length, lower), work[UPPER * POINTS + p])
        pull = (work[PASSIVE * POINTS + p] * slack + work[ACTIVE * POINTS + p]) / length
        w = work[WEIGHT * POINTS + p]
        along = (
            (t - u) * ra[0] + pull * fa[0],
            (t - u) * ra[1] + pull * fa[1],
            (t - u) * ra[2] + pull * fa[2],
        )
        _put(work, STRESS, p, _plus(r, w * u, along, w, a))
        first = cross(f[1], f[2])
        work[DETERMINANT * POINTS + p] = dot(f[0], first)
        _put_vector(work, COFACTOR, p, _scaled(first, w))
        _put_vector(work, COFACTOR + 3, p, _scaled(cross(f[2], f[0]), w))
        _put_vector(work, COFACTOR + 6, p, _scaled(cross(f[0], f[1]), w))


@compiled(inline="always")
def _turned(work, fd, p):
    """The rotation (4,) at a point, two steps nearer to that of a matrix."""
    q = (
        work[ROTATION * POINTS + p],
        work[(ROTATION + 1) * POINTS + p],
        work[(ROTATION + 2) * POINTS + p],
        work[(ROTATION + 3) * POINTS + p],
    )
    q = turn_towards(fd, turn_towards(fd, q))
    work[ROTATION * POINTS + p] = q[0]
    work[(ROTATION + 1) * POINTS + p] = q[1]
    work[(ROTATION + 2) * POINTS + p] = q[2]
    work[(ROTATION + 3) * POINTS + p] = q[3]
    return q


@compiled(inline="always")
def _fibre_stretch(t, s, across, tension, lower):
    """The stretch t of slack fibres, some of Newton's steps nearer to that of least energy."""
    for _ in range(STEPS):
        v = 1.0 / t
        root = np.sqrt(v)
        slope = t - v * v - s + 0.5 * across * v * root + tension
        bend = 1.0 + 2.0 * v * v * v - 0.75 * across * v * v * root
        t = min(max(t - slope / max(bend, 0.5), lower), 1.0)
    return t


@compiled(inline="always")
def _vector(work, row, p):
    return work[row * POINTS + p], work[(row + 1) * POINTS + p], work[(row + 2) * POINTS + p]


@compiled(inline="always")
def _matrix(work, row, p):
    return _vector(work, row, p), _vector(work, row + 3, p), _vector(work, row + 6, p)


@compiled(inline="always")
def _put(work, row, p, matrix):
    _put_vector(work, row, p, matrix[0])
    _put_vector(work, row + 3, p, matrix[1])
    _put_vector(work, row + 6, p, matrix[2])


@compiled(inline="always")
def _put_vector(work, row, p, vector):
    work[row * POINTS + p] = vector[0]
    work[(row + 1) * POINTS + p] = vector[1]
    work[(row + 2) * POINTS + p] = vector[2]


@compiled(inline="always")
def _times(m, v):
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@compiled(inline="always")
def _scaled(v, share):
    return share * v[0], share * v[1], share * v[2]


@compiled(inline="always")
def _plus(m, share, u, factor, v):
    """Rows of share m + factor u vᵀ."""
    return (
        _row(m[0], share, factor * u[0], v),
        _row(m[1], share, factor * u[1], v),
        _row(m[2], share, factor * u[2], v),
    )


@compiled(inline="always")
def _row(m, share, factor, v):
    return share * m[0] + factor * v[0], share * m[1] + factor * v[1], share * m[2] + factor * v[2]
