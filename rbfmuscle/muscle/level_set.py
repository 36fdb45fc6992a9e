"""Vertices brought onto the level set of a muscle's field: compiled functions of one frame.

With F the field that a vertex blends (`rbfmuscle.implicit.blend`), r its level offset, d the
distance to the bones and s the level that gives the muscle its volume at rest, each vertex is
brought onto the zero set of

    max(F(x) - r - s, -d(x)).

A Newton step on the field is  x += (s + r - F) g / max(|g|, g_0)^2,  g = grad F, with g_0 a share
of |g| at rest, so that what falls on a fold of the field does not leap; a change ds of the level
moves the vertex by  ds g / |g|^2. On a bone it is  x -= d grad d.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.surfaces import volume_rate
from rbfmuscle.implicit.blend import blend_loop
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.bone_distances import ask_bones
from rbfmuscle.muscle.surface_limits import lift

# Lengths below are in mean edges of the mesh at rest.
# No vertex goes farther from where the material carries it than FARTHEST times the square of the
# share that the field's slope there has of its slope at rest, 0 where that is UNSURE; but always
# by ALWAYS. Where sheets of a muscle meet, the slope sinks within few frames: by the share itself
# vertices of the leg's muscles jump by up to 0.85 mm in a squat, by its square 0.63.
FARTHEST = 1.0
UNSURE = 0.3
ALWAYS = 0.05
SURE = 0.7  # a share of the slope at rest, below which steps are shortened
SETTLED = 0.01  # a step of less is one whose error, of second order, does not count
# Rounds, at most.
NEWTON = 6
LEVELS = 20
# How a surface came out.
FITTED, NO_FIT, NOT_FINITE, NO_LEVEL, CROSSED, NO_VOLUME = range(6)


@compiled
def reach_level(model, state, obstacles, fit, work):
    """Bring the vertices onto the level set that has the volume; how that ended."""
    edge, level = work.edge, state.level[0]
    allowed = np.full(len(model.offset), -1.0)
    for _ in range(LEVELS):
        if not _project(model, state, obstacles, fit, work, level, allowed):
            return NOT_FINITE
        volume, rate = volume_rate(work.vertices, model.faces, work.direction)
        if not rate > 0.0:
            return NO_LEVEL
        step, largest = (model.volume - volume) / rate, _fastest(work)
        step = min(max(step, -edge / largest), edge / largest)
        level += step
        shift(work, step)
        if abs(step) * largest < SETTLED * edge:
            state.level[0] = level
            return FITTED
    return NO_LEVEL


class Newton(NamedTuple):
    """A step of Newton's method; all arrays by vertex."""

    todo: np.ndarray  # what has not settled
    value: np.ndarray  # of the field
    gradient: np.ndarray  # (n, 3)
    miss: np.ndarray  # what its value lacks, or its distance from a bone
    rows: np.ndarray  # the first are those that a bone is asked for, in order
    limit: np.ndarray  # how far from a bone each of these goes along the field


@compiled
def _project(model, state, obstacles, fit, work, level, allowed):
    """Newton steps of all vertices onto the level, no farther from the material than the field is
    to be trusted; False where the field is not finite.
    """
    n, edge = len(model.offset), work.edge
    newton = Newton(
        np.ones(n, np.bool_),
        np.empty(n),
        np.empty((n, 3)),
        np.empty(n),
        np.empty(n, np.int64),
        np.empty(n),
    )
    for _ in range(NEWTON):
        blend_loop(
            work.vertices, fit[0], fit[1], model.blend, newton.todo, newton.value, newton.gradient
        )
        count = _aim(model, work, level, newton)
        if count < 0:
            return False
        some = newton.rows[:count], newton.limit[:count]
        _turn_to_bones(obstacles, state, work, some[0], some[1], newton.miss)
        settled = True
        for v in range(n):
            if newton.todo[v]:
                length = _move(work.vertices, v, work.direction, newton.miss[v], edge)
                newton.todo[v] = length > SETTLED * edge
                settled &= not newton.todo[v]
        if settled:
            break
    for v in range(n):
        if not work.on_field[v]:
            work.direction[v] = 0.0
    _measure_trust(model, fit, work, allowed)
    _bound(work, allowed)
    lift(obstacles, state, work, np.flatnonzero(work.left & work.near))
    return True


@compiled
def _aim(model, work, level, newton):
    """Directions of the steps, what each lacks, and how many may meet a bone on the way; -1 where
    the field is not finite.
    """
    gradient = newton.gradient
    count = 0
    for v in range(len(newton.todo)):
        if not newton.todo[v]:
            continue
        square = gradient[v, 0] ** 2 + gradient[v, 1] ** 2 + gradient[v, 2] ** 2
        if not (square < np.inf and abs(newton.value[v]) < np.inf):
            return -1
        least = SURE * model.slope[v]
        work.odd[v] |= square <= least * least
        square = max(square, least * least, 2.3e-308)
        newton.miss[v] = level + model.offset[v] - newton.value[v]
        for a in range(3):
            work.direction[v, a] = gradient[v, a] / square
        work.on_field[v] = True
        if work.near[v]:
            newton.rows[count] = v
            newton.limit[count] = work.clearance[v] + newton.miss[v] / np.sqrt(square)
            count += 1
    return count


@compiled
def _turn_to_bones(obstacles, state, work, rows, limit, miss):
    """Where a bone is the surface, the step onto it replaces that onto the field."""
    distance, outward = np.empty(len(rows)), np.empty((len(rows), 3))
    ask_bones(obstacles, state, work.vertices, rows, limit, 0.0, distance, outward)
    for i in range(len(rows)):
        v = rows[i]
        gap = distance[i] - work.clearance[v]
        if distance[i] < limit[i]:
            work.on_field[v] = False
            miss[v] = -gap
            for a in range(3):
                work.direction[v, a] = outward[i, a]


@compiled(inline="always")
def _move(vertices, v, direction, share, most):
    """x += share * direction, by no more than a length; the length that it asked for."""
    length = np.sqrt(direction[v, 0] ** 2 + direction[v, 1] ** 2 + direction[v, 2] ** 2)
    length *= abs(share)
    share = share * most / length if length > most else share
    for a in range(3):
        vertices[v, a] += share * direction[v, a]
    return length


@compiled
def _measure_trust(model, fit, work, allowed):
    """How far each vertex may go that went some way, by the slope where the material carries it:
    measured where the search began, it would depend on the last frame.
    """
    n, edge = len(allowed), work.edge
    asked = np.zeros(n, np.bool_)
    for v in range(n):
        if allowed[v] < 0.0:
            square = 0.0
            for a in range(3):
                square += (work.vertices[v, a] - work.carried[v, a]) ** 2
            asked[v] = not square <= (ALWAYS * edge) ** 2
    value = np.empty(n)
    gradient = np.empty((n, 3))
    blend_loop(work.carried, fit[0], fit[1], model.blend, asked, value, gradient)
    for v in range(n):
        if asked[v]:
            square = gradient[v, 0] ** 2 + gradient[v, 1] ** 2 + gradient[v, 2] ** 2
            allowed[v] = edge * max(_trust(np.sqrt(square), model.slope[v]), ALWAYS)


@compiled
def _trust(slope, at_rest):
    """How far, in mean edges, a vertex may go from the material for a field of this slope."""
    if not at_rest > UNSURE:
        return 0.0
    return FARTHEST * min(max((slope / at_rest - UNSURE) / (1.0 - UNSURE), 0.0), 1.0) ** 2


@compiled
def _bound(work, allowed):
    """Bring back what went beyond where the field is to be trusted, which stays, and mark it."""
    edge = work.edge
    for v in range(len(allowed)):
        # A way to a bone from outside it, which the field asked for, is bounded too.
        bounded = work.on_field[v] or (work.least[v] >= 0.0 and allowed[v] < FARTHEST * edge)
        square = 0.0
        for a in range(3):
            square += (work.vertices[v, a] - work.carried[v, a]) ** 2
        work.left[v] = bounded and allowed[v] >= 0.0 and square > allowed[v] ** 2
        if work.left[v]:
            share = allowed[v] / max(np.sqrt(square), 1e-300)
            for a in range(3):
                away = work.vertices[v, a] - work.carried[v, a]
                work.vertices[v, a] = work.carried[v, a] + share * away
                work.direction[v, a] = 0.0


@compiled
def _fastest(work):
    """Greatest motion of a vertex for a unit of level."""
    most = 2.3e-308
    for v in range(len(work.direction)):
        square = 0.0
        for a in range(3):
            square += work.direction[v, a] ** 2
        most = max(most, square)
    return np.sqrt(most)


@compiled
def shift(work, step):
    """Move the vertices as the level set moves with its level, to first order."""
    for v in range(len(work.vertices)):
        for a in range(3):
            work.vertices[v, a] += step * work.direction[v, a]
