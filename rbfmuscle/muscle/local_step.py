"""The local step of a solid's iteration: what each quadrature point wants, for the present nodes.

At each point R and t minimise the energy (`model.py`), and what is squeezed wants a volume
(`inversion.py`). The energy is then quadratic in the nodes, with a matrix that does not depend on
R and t and the right side Σ_q w_q T_q ∇N (Bouaziz et al. 2014, "Projective dynamics").
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.rotations import quaternion_matrix, rotation_loop
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.inversion import unfold_loop


class Local(NamedTuple):
    """What the local step finds."""

    rotations: np.ndarray  # (Q, 4) unit quaternions
    stretches: np.ndarray  # (Q,) t of slack fibres
    f: np.ndarray  # (Q, 3, 3) deformation gradients
    target: np.ndarray  # (Q, 3, 3) R D(t)
    stiffened: np.ndarray  # (Q,) whether a point was squeezed in this solve
    right: np.ndarray  # (N, 3) right side
    gradient: np.ndarray  # (S, 3) of the regions' volumes
    volumes: np.ndarray  # (M,) of the regions


@compiled(error_model="numpy")
def start_local(model, state):
    """Arrays for the local steps of a solve."""
    count = len(model.cells.weights)
    return Local(
        state.rotations.copy(),
        state.stretches.copy(),
        np.empty((count, 3, 3)),
        np.empty((count, 3, 3)),
        np.zeros(count, np.bool_),
        np.empty_like(model.rest),
        np.empty((len(model.cells.node), 3)),
        np.empty(len(model.cells.volumes)),
    )


@compiled(error_model="numpy")
def local_step(model, y, activation, tension, local):
    """Fill ``local`` for nodes ``y``: how many points joined the squeezed ones, and the energy of
    these over 2 μ.
    """
    cells, fibres = model.cells, model.fibres
    target_loop(y, cells, fibres, tension, local)
    stress_loop(cells, fibres, activation, local)
    return unfold_loop(
        local.f, local.stiffened, cells.weights, cells.columns, cells.slopes, local.right
    )


@compiled(error_model="numpy", fastmath={"contract"})
def gradient_rows(y, columns, slopes, i):
    """Rows of the deformation gradient Σ_k y_k ∇N_k at point i."""
    xx = 0.0
    xy = 0.0
    xz = 0.0
    yx = 0.0
    yy = 0.0
    yz = 0.0
    zx = 0.0
    zy = 0.0
    zz = 0.0
    for k in range(columns.shape[1]):
        j = columns[i, k]
        u = slopes[i, k, 0]
        v = slopes[i, k, 1]
        w = slopes[i, k, 2]
        x = y[j, 0]
        xx = xx + x * u
        xy = xy + x * v
        xz = xz + x * w
        x = y[j, 1]
        yx = yx + x * u
        yy = yy + x * v
        yz = yz + x * w
        x = y[j, 2]
        zx = zx + x * u
        zy = zy + x * v
        zz = zz + x * w
    return (xx, xy, xz), (yx, yy, yz), (zx, zy, zz)


@compiled(error_model="numpy")
def target_loop(y, cells, fibres, tension, local):
    """Deformation gradients F and their targets R (t aaᵀ + t^(-1/2) (I - aaᵀ)) at all points.

    R is the rotation of F D(t) for the last t, then t minimises |RᵀF - D(t)|² + 2 tension t in
    [least, 1] by Newton's method; over the iterations both converge.
    """
    columns, slopes = cells.columns, cells.slopes
    fibre, least = fibres.direction, fibres.lower
    q = local.rotations
    t = local.stretches
    f = local.f
    target = local.target
    fd, rotation = np.empty((3, 3)), np.empty(4)
    for i in range(len(columns)):
        first, second, third = gradient_rows(y, columns, slopes, i)
        e0 = fibre[i, 0]
        e1 = fibre[i, 1]
        e2 = fibre[i, 2]
        u = 1.0 / np.sqrt(t[i])
        for b in range(3):
            f[i, 0, b] = first[b]
            f[i, 1, b] = second[b]
            f[i, 2, b] = third[b]
        for a in range(3):
            along = (t[i] - u) * (f[i, a, 0] * e0 + f[i, a, 1] * e1 + f[i, a, 2] * e2)
            fd[a, 0] = u * f[i, a, 0] + along * e0
            fd[a, 1] = u * f[i, a, 1] + along * e1
            fd[a, 2] = u * f[i, a, 2] + along * e2
        for k in range(4):
            rotation[k] = q[i, k]
        rotation_loop(fd, rotation)
        for k in range(4):
            q[i, k] = rotation[k]
        first, second, third = quaternion_matrix(rotation)
        for b in range(3):
            target[i, 0, b] = first[b]
            target[i, 1, b] = second[b]
            target[i, 2, b] = third[b]
        if least[i] < 1.0:
            # S = RᵀF: s is its part along the fibre, m the sum of those across.
            s, m = 0.0, 0.0
            for a in range(3):
                fa = f[i, a, 0] * e0 + f[i, a, 1] * e1 + f[i, a, 2] * e2
                ra = target[i, a, 0] * e0 + target[i, a, 1] * e1 + target[i, a, 2] * e2
                s += ra * fa
                for b in range(3):
                    m += target[i, a, b] * f[i, a, b]
            m -= s
            v = t[i]
            for _ in range(4):
                v15 = v * np.sqrt(v)
                g = v - 1.0 / (v * v) - s + 0.5 * m / v15 + tension
                h = 1.0 + 2.0 / (v * v * v) - 0.75 * m / (v15 * v)
                v = min(max(v - g / max(h, 0.5), least[i]), 1.0)
            t[i] = v
            u = 1.0 / np.sqrt(v)
            for a in range(3):
                ra = target[i, a, 0] * e0 + target[i, a, 1] * e1 + target[i, a, 2] * e2
                ra *= v - u
                target[i, a, 0] = u * target[i, a, 0] + ra * e0
                target[i, a, 1] = u * target[i, a, 1] + ra * e1
                target[i, a, 2] = u * target[i, a, 2] + ra * e2


@compiled(error_model="numpy")
def stress_loop(cells, fibres, activation, local):
    """Right side Σ w T ∇N of the fibres and the rest, volumes of the regions and their
    gradients.
    """
    columns = cells.columns
    slopes = cells.slopes
    region = cells.region
    slot = cells.slot
    weights = cells.weights
    f = local.f
    target = local.target
    out = local.right
    gradient = local.gradient
    volume = local.volumes
    out[:] = 0.0
    gradient[:] = 0.0
    volume[:] = 0.0
    v, c = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(f)):
        m = f[i]
        c[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
        c[0, 1] = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
        c[0, 2] = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
        c[1, 0] = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
        c[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
        c[1, 2] = m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
        c[2, 0] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
        c[2, 1] = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
        c[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        w = weights[i]
        volume[region[i]] += w * (m[0, 0] * c[0, 0] + m[0, 1] * c[0, 1] + m[0, 2] * c[0, 2])
        for a in range(3):
            for b in range(3):
                v[a, b] = w * target[i, a, b]
                c[a, b] *= w
        active = activation * fibres.active[i]
        if fibres.passive[i] + active > 0.0:
            fibre, length = fibres.direction[i], 1e-12
            for a in range(3):
                length += (m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]) ** 2
            length = np.sqrt(length)
            slack = min(max(length, fibres.lower[i]), fibres.upper[i])
            share = w * (fibres.passive[i] * slack + active * fibres.content[i]) / length
            for a in range(3):
                along = m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]
                for b in range(3):
                    v[a, b] += share * along * fibre[b]
        for k in range(columns.shape[1]):
            j, s = columns[i, k], slot[i, k]
            for a in range(3):
                out[j, a] += (
                    v[a, 0] * slopes[i, k, 0]
                    + v[a, 1] * slopes[i, k, 1]
                    + v[a, 2] * slopes[i, k, 2]
                )
                gradient[s, a] += (
                    c[a, 0] * slopes[i, k, 0]
                    + c[a, 1] * slopes[i, k, 1]
                    + c[a, 2] * slopes[i, k, 2]
                )
