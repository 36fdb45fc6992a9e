"""Compiled steps of the iteration that brings a muscle's elastic solid to equilibrium."""

from __future__ import annotations

import numpy as np

from rbfmuscle.jit import compiled
from rbfmuscle.muscle.inversion import unfold_loop
from rbfmuscle.muscle.solid_loops import press_loop, stress_loop, swell_loop, target_loop


@compiled(error_model="numpy")
def local_loop(y, cells, fibres, tone, stiffened, state, f, target, right, gradient, volume):
    """Targets, forces and volumes for nodes ``y``: how many points joined the squeezed ones, and the energy of these.

    ``cells`` holds nodes and slopes of the quadrature points, their weights, and their regions and slots, ``state``
    the rotations and stretches, changed in place.
    """
    columns, slopes, weights, region, slot = cells
    quaternion, stretch = state
    target_loop(y, columns, slopes, fibres.direction, fibres.lower, tone, quaternion, stretch, f, target)
    stress_loop(f, target, fibres, weights, columns, slopes, region, slot, right, gradient, volume)
    return unfold_loop(f, stiffened, weights, columns, slopes, right)


@compiled(error_model="numpy")
def global_loop(y, force, inverse, regions, pressure, law, response, factor, step, change):
    """Nodes ``step`` under a force and the regions' pressures, volumes corrected; the whitened ``change`` of pressure.

    ``regions`` holds where each begins, its nodes, gradients, volumes now and at rest; ``law`` the bulk modulus and
    the pressure beyond which steps are shortened. Returns the share of a full step that was taken. The matrix
    product is that of Bouaziz et al. (2014).
    """
    start, node, gradient, volume, rest = regions
    bulk, calm = law
    highest = 0.0
    for r in range(len(pressure)):
        highest = max(highest, abs(pressure[r]))
    part = 1.0 / max(1.0, highest / calm)
    right = force.copy()
    press_loop(pressure, start, node, gradient, right)
    free = np.dot(inverse, right)
    for n in range(len(y)):
        for a in range(3):
            free[n, a] = part * (free[n, a] - y[n, a])
    swell_loop(free, start, node, gradient, change)
    for r in range(len(change)):
        value = rest[r] * (1.0 - pressure[r] / bulk) - volume[r] - change[r]
        for o in range(r):
            value -= factor[r, o] * change[o]
        change[r] = value / factor[r, r]
    for n in range(len(y)):
        for a in range(3):
            step[n, a] = y[n, a] + free[n, a]
    for r in range(len(change)):
        for a in range(3):
            for n in range(len(y)):
                step[n, a] += change[r] * response[r, a, n]
    return part


@compiled(error_model="numpy")
def ways_loop(y, step, push, columns, shares, margin, here, motion, reach):
    """Embedded points ``here``, their ``motion`` in a step of the nodes, and how far to look for obstacles.

    That is half as far again as they go in the step with the last push on top, and a margin.
    """
    for s in range(len(columns)):
        for a in range(3):
            now, moved, pushed = 0.0, 0.0, 0.0
            for k in range(columns.shape[1]):
                j, share = columns[s, k], shares[s, k]
                now += share * y[j, a]
                moved += share * (step[j, a] - y[j, a])
                pushed += share * push[j, a]
            here[s, a], motion[s, a] = now, moved
            if a == 0:
                reach[s] = 0.0
            reach[s] += (moved + pushed) ** 2
        reach[s] = 1.5 * np.sqrt(reach[s]) + margin


@compiled(error_model="numpy")
def pressure_loop(y, step, push, change, taken, factor, part, most, pressure):
    """Add the contacts' push to the step and the change to the pressures, at most ``most``.

    Returns the greatest motion of a node.
    """
    for r in range(len(change) - 1, -1, -1):
        change[r] -= taken[r]
        for o in range(r + 1, len(change)):
            change[r] -= factor[o, r] * change[o]
        change[r] /= factor[r, r]
        pressure[r] = min(max(pressure[r] + change[r] / part, -most), most)
    largest = 0.0
    for n in range(len(y)):
        square = 0.0
        for a in range(3):
            step[n, a] += push[n, a]
            square += (step[n, a] - y[n, a]) ** 2
        # Written so that NaN is not lost.
        if not square <= largest:
            largest = square
    return np.sqrt(largest)
