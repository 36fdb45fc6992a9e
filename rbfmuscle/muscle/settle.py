"""Bringing an RBF muscle's solid to equilibrium, in one compiled call that needs no lock.

Each iteration (`iteration.py`) finds rotations and stretches (`local_step.py`), then the nodes for
these with a matrix that never changes and pressures that keep the volumes (`global_step.py`), and
contacts in the same metric (`contact_forces.py`). Pressures are kept from iteration to iteration,
so that the fixed point of the iteration is the equilibrium; Anderson acceleration gets there
sooner.

A surface of points on a bone of flat facets has many equilibria, because each point has to be
lifted over each edge. A muscle on a bone has not. So the solid settles with contacts that yield a
little, on bones whose facets are rounded (`rounded_bones.py`): one shape for each pose. What is
then left in a bone is lifted out of it in the metric of the energy, volumes kept. The next sub-step
starts from the settled shape, not from the lifted one.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import Obstacles
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.anderson import no_memory
from rbfmuscle.muscle.contact_forces import contact_push, no_answers
from rbfmuscle.muscle.global_step import expansion, find_metric
from rbfmuscle.muscle.inversion import stiffened_inverse
from rbfmuscle.muscle.iteration import (
    MARGIN,
    TOLERANCE,
    YIELDING,
    Iterate,
    Problem,
    Solver,
    advance,
    contact_law,
    iterate,
    shorten,
)
from rbfmuscle.muscle.local_step import found_rotations, local_step, start_local, volumes
from rbfmuscle.muscle.model import SolidModel, Stiffness, carry
from rbfmuscle.muscle.near_points import (
    carry_near,
    find_exact_touch,
    find_near,
    keep_rounded,
    take_near,
)
from rbfmuscle.muscle.rounded_bones import RoundedBones
from rbfmuscle.muscle.state import SolidState, tension

# All lengths are relative to the muscle's size.
SETTLED = 1e-5  # an iteration that moves no material farther was the last one
SETTLED_BESIDE = 1e-4  # the same beside neighbours, whose planes are not known better
# The same where the bones stand still and only the activation changes, and how many times the
# iterations it may take.
SETTLED_STILL, ROUNDS_STILL = 1e-7, 10
LONGEST = 0.2  # a longer step is shortened to it
GROWTH = 2.0  # a motion beyond this multiple of the least so far restarts the acceleration
MEMORY = 5  # steps that Anderson acceleration combines
# Iterations in which the motion has not halved, after which steps are plain until it has: where a
# muscle slips over an edge of a bone, accelerated ones go round in circles.
STALLED = 12
NEAR = 0.015  # contact points nearer to an obstacle take part in a solve
STALE = 0.4  # share of NEAR by which a node moves before they are chosen again
# Share of YIELDING by which obstacles yield where room is made in what is shown.
SHOWN_YIELDING = 0.1
DRIFT = 5e-3  # relative change of a region's volume by a lift that is undone before the next
LIFTS = 3  # linear steps, at most, that lift what is left in a bone out of it

DONE = 0  # how a solve ended
NO_ROOM = 1
DIVERGED = 2


class Report(NamedTuple):
    """How a solve ended.

    ``status`` is `DONE`, `NO_ROOM` (the table of rounded bones is full: grow it and solve again)
    or `DIVERGED`. The ``residual`` is
    the greatest motion that an unshortened step would still make, of the muscle's size;
    ``volume_error`` the greatest relative error of a region's volume. ``caps`` counts what ended at
    its greatest number: the iteration, its last contact forces, lifting.
    """

    status: int
    iterations: int
    residual: float
    volume_error: float
    caps: int


class Settled(NamedTuple):
    """What a solve changes of a `SolidState`, fields as there."""

    nodes: np.ndarray
    lifted_nodes: np.ndarray
    points: np.ndarray
    rotations: np.ndarray
    stretches: np.ndarray
    pressures: np.ndarray
    forces: np.ndarray


class Ended(NamedTuple):
    """How the iteration ended, as in `Report`."""

    status: int
    iterations: int
    residual: float
    caps: int


def settle(
    model: SolidModel,
    stiffness: Stiffness,
    state: SolidState,
    obstacles: Obstacles,
    rounded: RoundedBones,
    *,
    room: bool = False,
) -> tuple[SolidState, Report]:
    """The state in equilibrium under elasticity, pressures and contacts, and a `Report`.

    With ``room`` nodes stay as they are, and only those shown move, by the planes of neighbours and
    then out of bones.
    """
    found, report = _settle(model, stiffness, state, obstacles, rounded, room)
    return state._replace(**found._asdict()), report


@compiled
def _settle(model, stiffness, state, obstacles, rounded, room):
    """What changes of a state, and a `Report`; see `settle`."""
    springs = np.dot(model.springs, state.anchors)
    pull = tension(model.end, model.end_distance, state.anchors)
    given = Problem(model, stiffness, obstacles, rounded, springs, state.activation[0], pull)
    now = Iterate(state.nodes.copy(), state.pressures.copy(), np.zeros_like(state.nodes))
    local = start_local(model, state, given.activation)
    forces = _start_forces(state.forces, obstacles)
    joined = local_step(model.cells, now.y, pull, local)[0]
    metric, sound = _new_metric(given, local, joined)
    near = _choose_near(given, forces, now.y)
    solver = Solver(metric, sound, near, no_answers(near, metric))
    rotations, stretches = state.rotations, state.stretches
    if room:
        ended = Ended(DONE, 0, 0.0, 0)
        shown = now.y + _push_out(given, solver, now.y, np.inf)
    else:
        solver, ended = _converge(given, state, now, local, solver, forces)
        rotations, stretches = found_rotations(local)
        shown = now.y
    _note_forces(solver.near, forces)
    lifted_nodes, left = _lifted(given, solver, shown)
    keep_rounded(solver.near, rounded.known)
    points = carry(model.embedding, lifted_nodes)
    found = Settled(now.y, lifted_nodes, points, rotations, stretches, now.pressure, forces)
    error = _volume_error(model.cells, lifted_nodes)
    caps = ended.caps + left
    return found, Report(ended.status, ended.iterations, ended.residual, error, caps)


@compiled
def _converge(given, state, now, local, solver, forces):
    """Iterate until no material moves any farther; the solver in the end, and how it `Ended`."""
    size = given.model.size
    memory = no_memory(MEMORY, now.y.size + len(now.pressure), now.y.size)
    limit, most = _limits(given, state)
    least, halved = np.inf, np.inf
    done, since = 0, 0
    travelled = 0.0
    while True:
        step = iterate(given, now, local, solver, travelled)
        moved = step.moved
        done += 1
        now.push[:] = step.push
        if moved > GROWTH * least or moved > LONGEST * size:
            memory.steps[0] = 0
        least = moved if moved > GROWTH * least else min(least, moved)
        shorten(now, step, LONGEST * size)
        status = DONE
        if not solver.sound or not step.room or not np.isfinite(moved):
            status = DIVERGED if step.room else NO_ROOM
        if status != DONE or moved < limit or done == most:
            now.y[:] = step.nodes
            now.pressure[:] = step.pressures
            caps = int(not moved < limit) + int(step.capped)
            return solver, Ended(status, done, step.residual / size, caps)
        if moved < 0.5 * halved:
            halved = moved
            since = done
        travelled += advance(now, step, memory, done - since < STALLED)
        solver = _renewed(given, now, local, solver, forces, memory)


@compiled
def _renewed(given, now, local, solver, forces, memory):
    """The local step where the iteration is now, and the solver for it: with another metric where
    points were squeezed, and other near points where nodes moved far.
    """
    metric, sound, near, answers = solver
    joined = local_step(given.model.cells, now.y, given.tension, local)[0]
    if joined > 0:
        metric, sound = _new_metric(given, local, joined)
        memory.steps[0] = 0
        answers = no_answers(near, metric)
    if np.abs(now.y - near.y).max() > STALE * NEAR * given.model.size:
        _note_forces(near, forces)
        near = _choose_near(given, forces, now.y)
        answers = no_answers(near, metric)
        now.push[:] = 0.0
    return Solver(metric, sound, near, answers)


@compiled(inline="always")
def _limits(given, state):
    """Motion of material [scene unit] below which a solve ends, and the greatest number of
    iterations.
    """
    size, farthest = given.model.size, 0.0
    for i in range(len(state.step)):
        for a in range(3):
            farthest = max(farthest, abs(state.step[i, a]))
    if farthest <= SETTLED_STILL * size:
        return SETTLED_STILL * size, ROUNDS_STILL * given.model.iterations
    beside = len(given.obstacles.planes.softness) > 0
    return (SETTLED_BESIDE if beside else SETTLED) * size, given.model.iterations


@compiled
def _new_metric(given, local, joined):
    """The metric of corrections, with the stiffness of squeezed points; whether there is one."""
    model, inverse = given.model, given.stiffness.inverse
    if joined > 0:
        inverse = stiffened_inverse(inverse, model.cells, np.flatnonzero(local.stiffened))
    return find_metric(model.cells, local.gradient, inverse)


@compiled
def _choose_near(given, forces, y):
    """The contact points near an obstacle, with the forces on them until now."""
    model, obstacles = given.model, given.obstacles
    found, gap = find_near(carry(model.embedding, y), obstacles, NEAR * model.size)
    most, rounded = given.stiffness.most, given.rounded.known
    return take_near(found, gap, model, most, obstacles, rounded, forces, y)


@compiled(inline="always")
def _start_forces(forces, obstacles):
    """Contact forces (n, obstacles) that a solve starts from: none where the obstacles are
    others.
    """
    sources = len(obstacles.poses) + len(obstacles.planes.softness)
    return forces.copy() if forces.shape[1] == sources else np.zeros((len(forces), sources))


@compiled
def _note_forces(near, forces):
    """Fill the forces (n, obstacles) on all contact points."""
    forces[:] = 0.0
    for k in range(len(near.which)):
        forces[near.which[k]] = near.forces[k]


@compiled
def _push_out(given, solver, y, softest):
    """Motion (N, 3) of nodes y that stand still, out of obstacles that are at most so soft.

    Bones and planes as hard do not yield; where softer planes are asked for too, all yield a
    little. Zero where nothing is left in one of them.
    """
    size, push = given.model.size, np.zeros_like(y)
    near = solver.near
    here, reach = carry_near(near, y, MARGIN * size)
    touch = find_exact_touch(near, here, reach, given.obstacles, softest)
    hard = softest <= 1.0
    if hard and (len(touch.gap) == 0 or touch.gap.min() > -TOLERANCE * size):
        return push
    still, none = np.zeros((len(near.which), 3)), np.zeros_like(near.forces)
    law = contact_law(given, touch, near, 0.0 if hard else SHOWN_YIELDING * YIELDING, 1.0)
    found = contact_push(
        touch, still, near, solver.metric, solver.answers, law, none, TOLERANCE * size
    )
    return found.nodes


@compiled(inline="always")
def _lifted(given, solver, y):
    """Nodes (N, 3), moved so far that no contact point is left in an obstacle that does not yield;
    1 where some may be left all the same, else 0.
    """
    cells = given.model.cells
    settled = volumes(cells, y)
    for turn in range(LIFTS):
        push = _push_out(given, solver, y, 1.0)
        if not push.any():
            return y, 0
        y = y + push
        # A push keeps the volumes to first order.
        lacking = settled - volumes(cells, y)
        if turn < LIFTS - 1 and (np.abs(lacking) > DRIFT * cells.volumes).any():
            y = y + expansion(lacking, solver.metric)
    return y, 1


@compiled(inline="always")
def _volume_error(cells, y):
    """Greatest relative error of a region's volume for nodes y (N, 3)."""
    return np.abs(volumes(cells, y) / cells.volumes - 1.0).max()
