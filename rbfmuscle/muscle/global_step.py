"""The global step of a solid's iteration: nodes under the targets of the local step, pressures that
keep the volumes of the regions.

With g_r = ∂V_r/∂y the nodes are A⁻¹ (right side + Σ_r p_r g_r). What the volumes then lack is
corrected by pressures q in the metric of A: the motion for a unit pressure of region r is A⁻¹ g_r,
and the volumes that it adds are G_rs = g_r · A⁻¹ g_s. With the volumes that pressures compress,
K_rr = V_r / BULK, the correction solves (G + K) q = lacking. G + K = L Lᵀ; all of this is in the
whitened pressures Lᵀ q, for which the responses are L⁻¹ A⁻¹ g and the matrix is the identity. So a
contact force takes from the volumes what its row of these responses says (`contact_forces.py`).
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.jit import compiled

# Bulk modulus and greatest pressure of a region, over 2 μ: a muscle that bones squeeze yields in
# volume, by a share of pressure / bulk modulus. With 50, Poisson's ratio 0.495, muscles of the leg
# lost up to 4.5 % in a squat; with 200, 0.4988, they lose 1.8 % in as many iterations. The surface
# is drawn at the volume at rest in any case.
BULK, MOST_PRESSURE = 200.0, 3.0
# Over 2 μ: at higher pressures det F bends the energy more than the iteration's matrix does, and
# steps are shortened.
CALM_PRESSURE = 0.5


class Metric(NamedTuple):
    """The metric of a solve's corrections."""

    inverse: np.ndarray  # (N, N) A⁻¹
    response: np.ndarray  # (M, 3, N) L⁻¹ A⁻¹ g
    factor: np.ndarray  # (M, M) L, in the lower triangle


@compiled(fastmath={"contract"})
def add_rows(matrix, rows, shares, out):
    """Add Σ_s shares[s, a] matrix[rows[s]] to out[a], of shares (s, 3) and out (3, N).

    Four rows at a time, and unsigned indices, so that none is tested for counting from the end.
    """
    end, last = np.uint64(out.shape[1]), len(rows)
    s = 0
    while s + 3 < last:
        i = np.uint64(rows[s])
        j = np.uint64(rows[s + 1])
        k = np.uint64(rows[s + 2])
        m = np.uint64(rows[s + 3])
        for a in range(3):
            p = shares[s, a]
            q = shares[s + 1, a]
            r = shares[s + 2, a]
            t = shares[s + 3, a]
            for n in range(end):
                out[a, n] += (
                    p * matrix[i, n] + q * matrix[j, n] + r * matrix[k, n] + t * matrix[m, n]
                )
        s += 4
    while s < last:
        i = np.uint64(rows[s])
        for a in range(3):
            p = shares[s, a]
            for n in range(end):
                out[a, n] += p * matrix[i, n]
        s += 1


@compiled
def find_metric(cells, gradient, inverse):
    """The metric for gradients (S, 3) of the volumes, and whether these are independent."""
    count, nodes = len(cells.volumes), len(inverse)
    response, factor = np.zeros((count, 3, nodes)), np.zeros((count, count))
    for r in range(count):
        first, end = cells.start[r], cells.start[r + 1]
        add_rows(inverse, cells.node[first:end], gradient[first:end], response[r])
    forces = np.zeros((count, 3, nodes))
    for r in range(count):
        for s in range(cells.start[r], cells.start[r + 1]):
            for a in range(3):
                forces[r, a, cells.node[s]] += gradient[s, a]
    rows = forces.reshape((count, 3 * nodes))
    np.dot(response.reshape((count, 3 * nodes)), rows.T, factor)
    for r in range(count):
        factor[r, r] += 1e-9 * factor[r, r] + cells.volumes[r] / BULK
    sound = factor_small(factor)
    for r in range(count):
        for a in range(3):
            for o in range(r):
                for n in range(nodes):
                    response[r, a, n] -= factor[r, o] * response[o, a, n]
            for n in range(nodes):
                response[r, a, n] /= factor[r, r]
    return Metric(inverse, response, factor), sound


@compiled
def factor_small(matrix):
    """Turn the lower triangle of a small matrix into its Cholesky factor; returns whether it is
    positive definite.
    """
    for r in range(len(matrix)):
        for o in range(r + 1):
            for k in range(o):
                matrix[r, o] -= matrix[r, k] * matrix[o, k]
            if o < r:
                matrix[r, o] /= matrix[o, o]
        if not matrix[r, r] > 0.0:
            return False
        matrix[r, r] = np.sqrt(matrix[r, r])
    return True


@compiled
def press(pressure, cells, gradient, out):
    """Add the forces Σ_r p_r g_r of the regions' pressures to ``out`` (N, 3)."""
    for r in range(len(pressure)):
        for s in range(cells.start[r], cells.start[r + 1]):
            for a in range(3):
                out[cells.node[s], a] += pressure[r] * gradient[s, a]


@compiled
def swell(motion, cells, gradient):
    """Volumes (M,), g_r · dy, that a motion (N, 3) of the nodes adds to the regions."""
    out = np.zeros(len(cells.volumes))
    for r in range(len(out)):
        for s in range(cells.start[r], cells.start[r + 1]):
            for a in range(3):
                out[r] += gradient[s, a] * motion[cells.node[s], a]
    return out


@compiled
def calm_share(pressure):
    """Share of a full step that is taken under these pressures."""
    highest = 0.0
    for r in range(len(pressure)):
        highest = max(highest, abs(pressure[r]))
    return 1.0 / max(1.0, highest / CALM_PRESSURE)


@compiled
def global_step(cells, y, pressure, force, local, metric, part):
    """Nodes (N, 3) after ``part`` of a step from ``y`` under the ``force`` of targets and springs
    and the pressures, with the volumes corrected, and the whitened correction (M,) of the
    pressures.
    """
    right = force.copy()
    press(pressure, cells, local.gradient, right)
    free, moved = np.empty_like(y), np.zeros((3, len(y)))
    # A⁻¹ is symmetric: its rows are its columns.
    add_rows(metric.inverse, np.arange(len(y)), right, moved)
    for n in range(len(y)):
        for a in range(3):
            free[n, a] = part * (moved[a, n] - y[n, a])
    change = swell(free, cells, local.gradient)
    for r in range(len(change)):
        rest = cells.volumes[r]
        change[r] = rest * (1.0 - pressure[r] / BULK) - local.volumes[r] - change[r]
    return y + free + expansion(change, metric), change


@compiled
def expansion(lacking, metric):
    """Motion (N, 3) of the nodes that gives the regions the volumes (M,) that they lack, which
    become, in place, the whitened pressures for it.
    """
    for r in range(len(lacking)):
        for o in range(r):
            lacking[r] -= metric.factor[r, o] * lacking[o]
        lacking[r] /= metric.factor[r, r]
    moved = np.zeros((3, len(metric.inverse)))
    add_responses(metric.response, lacking, moved)
    return moved.T


@compiled(fastmath={"contract"})
def add_responses(response, shares, out):
    """Add Σ_r shares_r response_r to out (3, N)."""
    end = np.uint64(out.shape[1])
    for r in range(len(shares)):
        for a in range(3):
            for n in range(end):
                out[a, n] += shares[r] * response[r, a, n]


@compiled
def corrected_pressures(pressure, change, taken, factor, part):
    """Pressures (M,) after a whitened change, of which contacts ``taken`` some: q = L⁻ᵀ (change -
    taken), in units of a full step.
    """
    out = pressure.copy()
    for r in range(len(change) - 1, -1, -1):
        change[r] -= taken[r]
        for o in range(r + 1, len(change)):
            change[r] -= factor[o, r] * change[o]
        change[r] /= factor[r, r]
        out[r] = min(max(pressure[r] + change[r] / part, -MOST_PRESSURE), MOST_PRESSURE)
    return out
