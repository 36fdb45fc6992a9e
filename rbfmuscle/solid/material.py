"""The gap of a point to a solid, asked of its field at rest.

A point x of the world is at the material coordinates X of a solid with φ(X) = x, which Newton steps
find from those of the last question. The neighbour's distance at rest D(X), smoothed by a cubic
B-spline, then gives to first order the gap D / |g| with g = ∇ₓD = A⁻ᵀ ∇D, A = ∂φ/∂X: smooth in
space and time, without a search over triangles. A force acts on the point along g / |g|, and the
opposite one on the material of the neighbour at the foot X - D ∇D.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.rounded import RoundedBone, rounded_at
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.loops import loop

NEWTON = 8  # steps that find material coordinates, at most
# Slope of the distance, below which it has no direction: halfway through a thin muscle.
FLAT = 0.01
EXACT = 1e-3  # of a cell: a step of less is the last, as it squares the error


class Material(NamedTuple):
    """Where the points of a solid at rest lie in its lattice, and its distance at rest."""

    origin: Floats  # (3,) at rest, of the lattice
    turn: Floats  # (3, 3) rows: cells of the lattice along a place at rest
    back: Floats  # (3, 3) its inverse
    table: Integers  # (i, j, k) of the box of the lattice, the cell that holds each or is nearest
    cells: Integers  # (C, 3) place of each cell in the box
    nodes: Integers  # (C, 27)
    rest: RoundedBone  # the surface at rest


@loop
def cell_shares(table, cells, u, v, w, shares, slopes):
    """Fill the shape functions (27,) at a place in a lattice, and their slopes (27, 3); returns the
    cell, which beyond the box is the nearest.
    """
    i = min(max(int(np.floor(u)), 0), table.shape[0] - 1)
    j = min(max(int(np.floor(v)), 0), table.shape[1] - 1)
    k = min(max(int(np.floor(w)), 0), table.shape[2] - 1)
    c = table[i, j, k]
    value = np.empty((3, 3))
    slope = np.empty((3, 3))
    for a in range(3):
        at = u if a == 0 else (v if a == 1 else w)
        s = at - cells[c, a]
        value[a, 0] = 0.5 * (1.0 - s) * (1.0 - s)
        value[a, 1] = 0.5 + s - s * s
        value[a, 2] = 0.5 * s * s
        slope[a, 0] = s - 1.0
        slope[a, 1] = 1.0 - 2.0 * s
        slope[a, 2] = s
    n = 0
    for a in range(3):
        for b in range(3):
            for d in range(3):
                shares[n] = value[0, a] * value[1, b] * value[2, d]
                slopes[n, 0] = slope[0, a] * value[1, b] * value[2, d]
                slopes[n, 1] = value[0, a] * slope[1, b] * value[2, d]
                slopes[n, 2] = value[0, a] * value[1, b] * slope[2, d]
                n += 1
    return c


@loop
def ask_material(material, y, points, place, gap, normal, columns, shares):
    """Gaps (n,) of points (n, 3) of the world to a solid with nodes y (N, 3), and their unit
    normals (n, 3).

    ``place`` (n, 3) in the lattice is where the search starts, and ends. ``columns`` and ``shares``
    (n, 27) are filled with those of the foot on the surface. A gap is infinite where the surface is
    farther than it is known, the map is folded, or the point lies exactly halfway through.
    """
    table = material.table
    cells = material.cells
    nodes = material.nodes
    turn = material.turn
    back = material.back
    share = np.empty(27)
    slope = np.empty((27, 3))
    j = np.empty((3, 3))
    x = np.empty(3)
    h = np.empty((3, 3))
    rest = np.empty(3)
    for i in range(len(points)):
        gap[i] = np.inf
        normal[i] = 0.0
        found = False
        for _ in range(NEWTON):
            c = cell_shares(table, cells, place[i, 0], place[i, 1], place[i, 2], share, slope)
            x[:] = 0.0
            j[:] = 0.0
            for k in range(27):
                n = nodes[c, k]
                for a in range(3):
                    x[a] += share[k] * y[n, a]
                    for b in range(3):
                        j[a, b] += slope[k, b] * y[n, a]
            # Rows of the adjugate: h / det is the inverse of j.
            for a in range(3):
                p = (a + 1) % 3
                q = (a + 2) % 3
                for b in range(3):
                    u = (b + 1) % 3
                    v = (b + 2) % 3
                    h[a, b] = j[u, p] * j[v, q] - j[u, q] * j[v, p]
            det = j[0, 0] * h[0, 0] + j[0, 1] * h[1, 0] + j[0, 2] * h[2, 0]
            if not abs(det) > 0.0:
                break
            far = 0.0
            for a in range(3):
                step = 0.0
                for b in range(3):
                    step += h[a, b] * (points[i, b] - x[b]) / det
                rest[a] = step
                far = max(far, abs(step))
            limit = 1.0 / max(far, 1.0)
            for a in range(3):
                place[i, a] += limit * rest[a]
            if far < EXACT:
                found = True
                break
        if not found:
            continue
        for a in range(3):
            rest[a] = material.origin[a]
            for b in range(3):
                rest[a] += back[a, b] * place[i, b]
        _, distance, gx, gy, gz = rounded_at(material.rest, rest[0], rest[1], rest[2], FLAT)
        if not np.isfinite(distance):
            continue
        # g = A⁻ᵀ ∇D with A⁻¹ = back · j⁻¹: the place at rest by the place in the world.
        length = 0.0
        for a in range(3):
            value = 0.0
            for b in range(3):
                along = back[0, b] * gx + back[1, b] * gy + back[2, b] * gz
                value += h[b, a] * along / det
            normal[i, a] = value
            length += value * value
        length = np.sqrt(length)
        gap[i] = distance / length
        for a in range(3):
            normal[i, a] /= length
        for a in range(3):
            step = turn[a, 0] * gx + turn[a, 1] * gy + turn[a, 2] * gz
            x[a] = place[i, a] - distance * step
        c = cell_shares(table, cells, x[0], x[1], x[2], share, slope)
        for k in range(27):
            columns[i, k] = nodes[c, k]
            # Beyond the material a foot would push with shares below zero.
            shares[i, k] = max(share[k], 0.0)
        total = shares[i].sum()
        for k in range(27):
            shares[i, k] /= total
