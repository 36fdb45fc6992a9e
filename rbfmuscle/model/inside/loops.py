"""Loops over the quadrature points of a muscle's inside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.rotations import quaternion_matrix
from rbfmuscle.jit import compiled
from rbfmuscle.model.constraints import _rotation_loop
from rbfmuscle.model.contact import solve_contact_forces


class Fibres(NamedTuple):
    """Springs along the fibres at the quadrature points, stiffnesses over twice the shear modulus.

    Attributes
    ----------
    direction : (Q, 3) ndarray
        At rest, unit.
    passive, active : (Q,) ndarray
        Stiffness of a spring that is slack from ``lower`` to ``upper``, and of one that is content at ``content``.
    lower, upper, content : (Q,) ndarray
        Stretches against rest.
    """

    direction: np.ndarray
    passive: np.ndarray
    active: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    content: np.ndarray


@compiled(error_model="numpy")
def turn_loop(y, columns, slopes, q, f, target):
    """Deformation gradients F and their rotations at all points."""
    for i in range(len(columns)):
        for a in range(3):
            for b in range(3):
                f[i, a, b] = 0.0
        for k in range(columns.shape[1]):
            j = columns[i, k]
            for a in range(3):
                v = y[j, a]
                f[i, a, 0] += v * slopes[i, k, 0]
                f[i, a, 1] += v * slopes[i, k, 1]
                f[i, a, 2] += v * slopes[i, k, 2]
        _rotation_loop(f[i], q[i])
        first, second, third = quaternion_matrix(q[i])
        for b in range(3):
            target[i, 0, b], target[i, 1, b], target[i, 2, b] = first[b], second[b], third[b]


@compiled(error_model="numpy")
def stress_loop(f, target, fibres, weights, columns, slopes, region, slot, out, gradient, volume):
    """Right side Σ w T ∇N of the fibres and the rest, volumes of the regions and their gradients.

    ``slot`` (Q, k) says where node k of point q stands in the rows of ``gradient``.
    """
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
        stiff = fibres.passive[i] + fibres.active[i]
        if stiff > 0.0:
            fibre, length = fibres.direction[i], 1e-12
            for a in range(3):
                length += (m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]) ** 2
            length = np.sqrt(length)
            slack = min(max(length, fibres.lower[i]), fibres.upper[i])
            share = w * (fibres.passive[i] * slack + fibres.active[i] * fibres.content[i]) / length
            for a in range(3):
                along = m[a, 0] * fibre[0] + m[a, 1] * fibre[1] + m[a, 2] * fibre[2]
                for b in range(3):
                    v[a, b] += share * along * fibre[b]
        for k in range(columns.shape[1]):
            j, s = columns[i, k], slot[i, k]
            for a in range(3):
                out[j, a] += v[a, 0] * slopes[i, k, 0] + v[a, 1] * slopes[i, k, 1] + v[a, 2] * slopes[i, k, 2]
                gradient[s, a] += (
                    c[a, 0] * slopes[i, k, 0] + c[a, 1] * slopes[i, k, 1] + c[a, 2] * slopes[i, k, 2]
                )


@compiled(error_model="numpy")
def press_loop(pressure, start, node, gradient, out):
    """Add the forces Σ_r p_r ∂V_r/∂y of the regions' pressures."""
    for r in range(len(pressure)):
        for s in range(start[r], start[r + 1]):
            for a in range(3):
                out[node[s], a] += pressure[r] * gradient[s, a]


@compiled(error_model="numpy")
def swell_loop(motion, start, node, gradient, out):
    """Volumes Σ ∂V_r/∂y · dy that a motion of the nodes adds to the regions."""
    for r in range(len(out)):
        out[r] = 0.0
        for s in range(start[r], start[r + 1]):
            for a in range(3):
                out[r] += gradient[s, a] * motion[node[s], a]


@compiled(error_model="numpy")
def respond_loop(start, node, gradient, inverse, response, gram):
    """Motion of the nodes for a unit pressure of each region (M, N, 3), and the volumes that it adds (M, M)."""
    count, nodes = len(start) - 1, len(inverse)
    response[:] = 0.0
    for r in range(count):
        for s in range(start[r], start[r + 1]):
            row = inverse[node[s]]
            for a in range(3):
                g = gradient[s, a]
                for n in range(nodes):
                    response[r, a, n] += row[n] * g
    for r in range(count):
        for o in range(count):
            value = 0.0
            for s in range(start[o], start[o + 1]):
                for a in range(3):
                    value += gradient[s, a] * response[r, a, node[s]]
            gram[r, o] = value


@compiled(error_model="numpy")
def carry_loop(y, columns, shares, out):
    """Places Σ_k share_k y_k of embedded points."""
    for s in range(len(columns)):
        ax, ay, az = 0.0, 0.0, 0.0
        for k in range(columns.shape[1]):
            j, share = columns[s, k], shares[s, k]
            ax += share * y[j, 0]
            ay += share * y[j, 1]
            az += share * y[j, 2]
        out[s, 0], out[s, 1], out[s, 2] = ax, ay, az


@compiled(error_model="numpy")
def _rows_loop(index, normal, response, columns, shares, rows):
    """Motion along its normal that each contact makes for a unit of each region's whitened pressure."""
    for c in range(len(index)):
        i = index[c]
        for r in range(response.shape[0]):
            value = 0.0
            for k in range(columns.shape[1]):
                j = columns[i, k]
                value += shares[i, k] * (
                    normal[c, 0] * response[r, 0, j]
                    + normal[c, 1] * response[r, 1, j]
                    + normal[c, 2] * response[r, 2, j]
                )
            rows[c, r] = value


@compiled(error_model="numpy")
def _answers_loop(index, columns, shares, inverse, answers):
    """Motion of the nodes for a unit force at each contact: rows of W A⁻¹."""
    answers[:] = 0.0
    for c in range(len(index)):
        for k in range(columns.shape[1]):
            share, row = shares[index[c], k], inverse[columns[index[c], k]]
            for j in range(len(row)):
                answers[c, j] += share * row[j]


@compiled(error_model="numpy")
def _pairs_loop(index, normal, rows, answers, columns, shares, yielding):
    """Motion at contact c for a unit force at contact d, the regions' volumes kept."""
    size = len(index)
    gram = np.empty((size, size))
    for c in range(size):
        for d in range(c + 1):
            value = 0.0
            for k in range(columns.shape[1]):
                value += shares[index[c], k] * answers[d, columns[index[c], k]]
            value *= normal[c, 0] * normal[d, 0] + normal[c, 1] * normal[d, 1] + normal[c, 2] * normal[d, 2]
            for r in range(rows.shape[1]):
                value -= rows[c, r] * rows[d, r]
            gram[c, d] = value
            gram[d, c] = value
    least = 1e-7 * np.abs(np.diag(gram)).max()
    for c in range(size):
        gram[c, c] += least + yielding
    return gram


@compiled(error_model="numpy")
def mobility_loop(columns, shares, inverse, out):
    """Motion of each embedded point for a unit force at it: w A⁻¹ w."""
    for s in range(len(columns)):
        out[s] = 0.0
        for k in range(columns.shape[1]):
            for m in range(columns.shape[1]):
                out[s] += shares[s, k] * shares[s, m] * inverse[columns[s, k], columns[s, m]]


@compiled(error_model="numpy")
def touch_loop(
    index, gap, normal, source, motion, inverse, columns, shares, response, table,
    batch, rounds, sweeps, tolerance, yielding, push, taken,
):  # fmt: skip
    """Contact: fill the nodes' ``push`` (N, 3), what it takes from the whitened pressures (M,), and the forces.

    The working set starts from the contacts that pushed before and takes in the deepest violations until none is
    left; forces solve the complementarity problem on it.
    """
    count = len(index)
    need, force, lacking = np.empty(count), np.empty(count), np.empty(count)
    for c in range(count):
        i = index[c]
        need[c] = -gap[c]
        for a in range(3):
            need[c] -= normal[c, a] * motion[i, a]
        force[c] = table[i, source[c]]
    table[:] = 0.0
    push[:] = 0.0
    taken[:] = 0.0
    is_chosen = force > 0.0
    chosen = np.flatnonzero(is_chosen)
    lacking[:] = need
    for _ in range(rounds):
        wanting = np.flatnonzero((lacking > tolerance) & ~is_chosen)
        added = wanting[np.argsort(-lacking[wanting], kind="mergesort")[:batch]]
        if len(added) == 0 and len(chosen) == 0:
            break
        is_chosen[added] = True
        chosen = np.concatenate((chosen, added))
        rows = np.empty((len(chosen), response.shape[0]))
        _rows_loop(index[chosen], normal[chosen], response, columns, shares, rows)
        answers = np.empty((len(chosen), len(push)))
        _answers_loop(index[chosen], columns, shares, inverse, answers)
        gram = _pairs_loop(index[chosen], normal[chosen], rows, answers, columns, shares, yielding)
        strength = force[chosen]
        solve_contact_forces(gram, need[chosen], strength, sweeps, 0.1 * tolerance)
        force[chosen] = strength
        push[:] = 0.0
        taken[:] = 0.0
        for e in range(len(chosen)):
            if strength[e] == 0.0:
                continue
            c = chosen[e]
            for j in range(len(push)):
                for a in range(3):
                    push[j, a] += answers[e, j] * strength[e] * normal[c, a]
            for r in range(len(taken)):
                taken[r] += strength[e] * rows[e, r]
        for r in range(len(taken)):
            for j in range(len(push)):
                for a in range(3):
                    push[j, a] -= taken[r] * response[r, a, j]
        if len(added) == 0:
            break
        for c in range(count):
            i, value = index[c], need[c]
            for k in range(columns.shape[1]):
                j = columns[i, k]
                value -= shares[i, k] * (
                    normal[c, 0] * push[j, 0] + normal[c, 1] * push[j, 1] + normal[c, 2] * push[j, 2]
                )
            lacking[c] = value
    for c in chosen:
        table[index[c], source[c]] = force[c]
