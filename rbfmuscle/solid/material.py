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
from rbfmuscle.geometry.frames import cross, dot, minus, row_of
from rbfmuscle.loops import loop

NEWTON = 8  # steps that find material coordinates, at most
# Slope of the distance, below which it has no direction: halfway through a thin muscle.
FLAT = 0.01
EXACT = 1e-3  # of a cell: a step of less is the last, as it squares the error
ZERO = 0.0, 0.0, 0.0


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
def cell_at(table, place):
    """The cell at a place in a lattice, three numbers; beyond the box the nearest one."""
    i = min(max(int(np.floor(place[0])), 0), table.shape[0] - 1)
    j = min(max(int(np.floor(place[1])), 0), table.shape[1] - 1)
    k = min(max(int(np.floor(place[2])), 0), table.shape[2] - 1)
    return table[i, j, k]


@loop
def line_weights(s):
    """Weights of the three nodes along an axis at a place ``s`` in a cell, and their slopes."""
    weights = 0.5 * (1.0 - s) * (1.0 - s), 0.5 + s - s * s, 0.5 * s * s
    return weights, (s - 1.0, 1.0 - 2.0 * s, s)


@loop(fastmath={"contract"})
def map_at(nodes, cell, y, place):
    """Where the map takes a ``place`` in a cell, three numbers, and its derivatives by the place
    along each axis of the lattice.

    ``nodes`` (27,) are those of the ``cell``, three numbers; ``y`` (N, 3) is where they are.
    """
    weights_u, slopes_u = line_weights(place[0] - cell[0])
    weights_v, slopes_v = line_weights(place[1] - cell[1])
    weights_w, slopes_w = line_weights(place[2] - cell[2])
    x = ZERO
    by_u = ZERO
    by_v = ZERO
    by_w = ZERO
    for a in range(3):
        plane = ZERO
        plane_v = ZERO
        plane_w = ZERO
        for b in range(3):
            line = ZERO
            line_w = ZERO
            for d in range(3):
                node = row_of(y, nodes[9 * a + 3 * b + d])
                line = _sum(line, weights_w[d], node)
                line_w = _sum(line_w, slopes_w[d], node)
            plane = _sum(plane, weights_v[b], line)
            plane_v = _sum(plane_v, slopes_v[b], line)
            plane_w = _sum(plane_w, weights_v[b], line_w)
        x = _sum(x, weights_u[a], plane)
        by_u = _sum(by_u, slopes_u[a], plane)
        by_v = _sum(by_v, weights_u[a], plane_v)
        by_w = _sum(by_w, weights_u[a], plane_w)
    return x, by_u, by_v, by_w


@loop
def _sum(total, share, part):
    """Total + share part, of vectors of three numbers."""
    return total[0] + share * part[0], total[1] + share * part[1], total[2] + share * part[2]


@loop
def ask_material(material, y, points, place, gap, normal, columns, shares):
    """Gaps (n,) of points (n, 3) of the world to a solid with nodes y (N, 3), and their unit
    normals (n, 3).

    ``place`` (n, 3) in the lattice is where the search starts, and ends. ``columns`` and ``shares``
    (n, 27) are filled with those of the foot on the surface. A gap is infinite where the surface is
    farther than it is known, the map is folded, or the point lies exactly halfway through.
    """
    turn = material.turn
    back = material.back
    origin = material.origin[0], material.origin[1], material.origin[2]
    for i in range(len(points)):
        gap[i] = np.inf
        normal[i] = 0.0
        found = False
        at = row_of(place, i)
        for _ in range(NEWTON):
            c = cell_at(material.table, at)
            x, by_u, by_v, by_w = map_at(material.nodes[c], row_of(material.cells, c), y, at)
            # Over det, the rows of the inverse of the derivative.
            inverse_u = cross(by_v, by_w)
            inverse_v = cross(by_w, by_u)
            inverse_w = cross(by_u, by_v)
            det = dot(by_u, inverse_u)
            if not abs(det) > 0.0:
                break
            left = minus(row_of(points, i), x)
            u = dot(inverse_u, left) / det
            v = dot(inverse_v, left) / det
            w = dot(inverse_w, left) / det
            far = max(abs(u), abs(v), abs(w))
            at = _sum(at, 1.0 / max(far, 1.0), (u, v, w))
            if far < EXACT:
                found = True
                break
        for a in range(3):
            place[i, a] = at[a]
        if not found:
            continue
        rest = origin
        for a in range(3):
            rest = _sum(rest, at[a], (back[0, a], back[1, a], back[2, a]))
        _, distance, gx, gy, gz = rounded_at(material.rest, *rest, FLAT)
        if not np.isfinite(distance):
            continue
        # g = A⁻ᵀ ∇D with A⁻¹ = back · j⁻¹: the place at rest by the place in the world.
        g = ZERO
        for a, inverse in enumerate((inverse_u, inverse_v, inverse_w)):
            along = dot((back[0, a], back[1, a], back[2, a]), (gx, gy, gz))
            g = _sum(g, along / det, inverse)
        length = np.sqrt(dot(g, g))
        gap[i] = distance / length
        for a in range(3):
            normal[i, a] = g[a] / length
        foot = at
        for a in range(3):
            foot = _sum(foot, -distance * (gx, gy, gz)[a], (turn[0, a], turn[1, a], turn[2, a]))
        c = cell_at(material.table, foot)
        cell = row_of(material.cells, c)
        weights_u, _ = line_weights(foot[0] - cell[0])
        weights_v, _ = line_weights(foot[1] - cell[1])
        weights_w, _ = line_weights(foot[2] - cell[2])
        total = 0.0
        for a in range(3):
            for b in range(3):
                for d in range(3):
                    k = 9 * a + 3 * b + d
                    columns[i, k] = material.nodes[c, k]
                    # Beyond the material a foot would push with shares below zero.
                    shares[i, k] = max(weights_u[a] * weights_v[b] * weights_w[d], 0.0)
                    total += shares[i, k]
        for k in range(27):
            shares[i, k] /= total
