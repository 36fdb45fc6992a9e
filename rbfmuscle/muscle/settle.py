"""Bringing an RBF muscle's solid to equilibrium, in one compiled call that needs no lock.

Each iteration finds rotations and stretches (`local_step.py`), then the nodes for these with a
matrix that never changes and pressures that keep the volumes (`global_step.py`), and contacts in
the same metric (`contact_forces.py`). Pressures are kept from iteration to iteration, so that the
fixed point of the iteration is the equilibrium; Anderson acceleration gets there sooner.

A surface of points on a bone of flat facets has many equilibria, because each point has to be
lifted over each edge. A muscle on a bone has not. So the solid settles with contacts that yield a
little, on bones whose facets are rounded (`rounded_bones.py`): one shape for each pose. What is
then left in a bone is lifted out of it in the metric of the energy, volumes kept. The next sub-step
starts from the settled shape, not from the lifted one.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import Obstacles
from rbfmuscle.geometry.surfaces import farthest_move
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.anderson import mix, no_memory
from rbfmuscle.muscle.contact_forces import Law, contact_push, no_answers
from rbfmuscle.muscle.global_step import (
    calm_share,
    corrected_pressures,
    expansion,
    find_metric,
    global_step,
)
from rbfmuscle.muscle.inversion import stiffened_inverse
from rbfmuscle.muscle.local_step import found_rotations, local_step, start_local, volumes
from rbfmuscle.muscle.model import SolidModel, Stiffness, carry
from rbfmuscle.muscle.near_points import (
    carry_near,
    find_exact_touch,
    find_near,
    find_touch,
    keep_rounded,
    near_motion,
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
TOLERANCE = 2e-5  # violation of a contact that is left
MARGIN = 0.003  # obstacles are looked for beyond where a point goes by this
NEAR = 0.015  # contact points nearer to an obstacle take part in a solve
STALE = 0.4  # share of NEAR by which a node moves before they are chosen again
YIELDING = 1e-4  # how far a contact yields under a pressure of 2 μ
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


class Problem(NamedTuple):
    """What is given through a solve."""

    model: SolidModel
    stiffness: Stiffness
    obstacles: Obstacles
    rounded: RoundedBones
    springs: np.ndarray  # (N, 3) forces of the springs at held points on nodes at the origin
    activation: float
    tension: float  # of slack fibres


class Step(NamedTuple):
    """One step of the iteration."""

    nodes: np.ndarray  # (N, 3)
    pressures: np.ndarray  # (M,)
    push: np.ndarray  # (N, 3) motion of the nodes by contact
    moved: float  # greatest motion of material [scene unit]
    residual: float  # what that is without shortening
    capped: bool  # whether contact forces are those of a capped solve
    room: bool  # whether the table of rounded bones had room


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
    y = state.nodes.copy()
    pressure = state.pressures.copy()
    local = start_local(model, state, given.activation)
    joined = local_step(model.cells, y, pull, local)[0]
    metric, sound = _new_metric(given, local, joined)
    forces = _start_forces(state.forces, obstacles)
    near = _choose_near(given, forces, y)
    answers, push = no_answers(near, metric), np.zeros_like(y)
    memory = no_memory(MEMORY, y.size + len(pressure), y.size)
    limit, most = _limits(given, state)
    least = np.inf
    status = DONE
    done = 0
    caps = 0
    residual = 0.0
    halved = np.inf
    since = 0
    travelled = 0.0
    lifted_nodes = y
    if room:
        lifted_nodes = y + _push_out(given, near, metric, answers, y, np.inf)
    while not room:
        step = _iterate(given, y, pressure, push, local, metric, near, answers, travelled)
        moved = step.moved
        done += 1
        push[:] = step.push
        if moved > GROWTH * least or moved > LONGEST * model.size:
            memory.steps[0] = 0
        least = moved if moved > GROWTH * least else min(least, moved)
        _shorten(y, pressure, step, LONGEST * model.size)
        if not sound or not step.room or not np.isfinite(moved):
            status = DIVERGED if step.room else NO_ROOM
        if status != DONE or moved < limit or done == most:
            y[:] = step.nodes
            pressure[:] = step.pressures
            caps = int(not moved < limit) + int(step.capped)
            residual = step.residual / model.size
            break
        if moved < 0.5 * halved:
            halved = moved
            since = done
        travelled += _advance(y, pressure, step, memory, done - since < STALLED)
        joined = local_step(model.cells, y, pull, local)[0]
        if joined > 0:
            metric, sound = _new_metric(given, local, joined)
            memory.steps[0] = 0
            answers = no_answers(near, metric)
        if np.abs(y - near.y).max() > STALE * NEAR * model.size:
            _note_forces(near, forces)
            near = _choose_near(given, forces, y)
            answers = no_answers(near, metric)
            push[:] = 0.0
    _note_forces(near, forces)
    lifted_nodes, left = _lifted(given, lifted_nodes, metric, near, answers)
    keep_rounded(near, rounded.known)
    points = carry(model.embedding, lifted_nodes)
    rotations, stretches = found_rotations(local)
    if room:
        rotations, stretches = state.rotations, state.stretches
    found = Settled(y, lifted_nodes, points, rotations, stretches, pressure, forces)
    report = Report(status, done, residual, _volume_error(model.cells, lifted_nodes), caps + left)
    return found, report


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


@compiled(inline="always")
def _iterate(given, y, pressure, push, local, metric, near, answers, travelled):
    """One global step with volumes and contacts.

    ``push`` is that of the step before, ``travelled`` how far nodes have gone at most.
    """
    model = given.model
    size = given.model.size
    part = calm_share(pressure)
    force = local.right + given.springs
    new, change = global_step(model.cells, y, pressure, force, local, metric, part)
    # Contacts that push now push in the next iteration too: where the points will then go decides
    # what they meet.
    here, motion, reach = near_motion(near, y, new, push, MARGIN * size, travelled)
    touch, room = find_touch(near, here, reach, travelled, given.obstacles, given.rounded)
    law = _law(given, touch, near, YIELDING / part, part)
    found = contact_push(touch, motion, near, metric, answers, law, near.forces, TOLERANCE * size)
    pressures = corrected_pressures(pressure, change, found.taken, metric.factor, part)
    new += found.nodes
    moved = _material_move(model.reach, y, new)
    return Step(new, pressures, found.nodes, moved, moved / part, found.capped, room)


@compiled(inline="always")
def _material_move(reach, y, new):
    """How far material goes, about, when nodes move from y to new (N, 3), infinity where one is not
    finite: nodes that hold none settle slowly, and move nothing.
    """
    most = 0.0
    for n in range(len(y)):
        square = 0.0
        for a in range(3):
            square += (reach[n] * (new[n, a] - y[n, a])) ** 2
        if not square <= most:
            most = square if np.isfinite(square) else np.inf
    return np.sqrt(most)


@compiled
def _law(given, touch, near, yielding, part):
    """How contacts yield: by ``yielding`` of the muscle's size under a pressure of 2 μ, soft planes
    more, up to a ``part`` of their greatest forces.
    """
    bones, softness = len(given.obstacles.poses), given.obstacles.planes.softness
    give = yielding * given.model.size / given.model.area
    law = Law(np.empty(len(touch.point)), np.empty(len(touch.point)))
    for c in range(len(touch.point)):
        kind = touch.source[c] - bones
        law.yielding[c] = give * (softness[kind] if kind >= 0 else 1.0)
        law.most[c] = near.most[touch.point[c]] * part
    return law


@compiled(inline="always")
def _shorten(y, pressure, step, longest):
    """Shorten a step, in place, where material goes farther than ``longest``."""
    if step.moved > longest:
        share = longest / step.moved
        step.nodes[:] = y + share * (step.nodes - y)
        step.pressures[:] = pressure + share * (step.pressures - pressure)


@compiled(inline="always")
def _advance(y, pressure, step, memory, accelerated):
    """Turn nodes and pressures, in place, into those that the next iteration starts from; returns
    how far the nodes go at most.
    """
    before = y.copy()
    if accelerated:
        _accelerate(y, pressure, step, memory)
    else:
        memory.steps[0] = 0
        y[:] = step.nodes
        pressure[:] = step.pressures
    return farthest_move(y, before)


@compiled(inline="always")
def _accelerate(y, pressure, step, memory):
    """Turn nodes and pressures, in place, into the mixture of the last steps."""
    count = y.size
    here, there = np.empty(count + len(pressure)), np.empty(count + len(pressure))
    here[:count] = y.ravel()
    here[count:] = pressure
    there[:count] = step.nodes.ravel()
    there[count:] = step.pressures
    mixed = mix(memory, here, there)
    y[:] = mixed[:count].reshape(y.shape)
    pressure[:] = mixed[count:]


@compiled
def _push_out(given, near, metric, answers, y, softest):
    """Motion (N, 3) of nodes y that stand still, out of obstacles that are at most so soft.

    Bones and planes as hard do not yield; where softer planes are asked for too, all yield a
    little. Zero where nothing is left in one of them.
    """
    size, push = given.model.size, np.zeros_like(y)
    here, reach = carry_near(near, y, MARGIN * size)
    touch = find_exact_touch(near, here, reach, given.obstacles, softest)
    hard = softest <= 1.0
    if hard and (len(touch.gap) == 0 or touch.gap.min() > -TOLERANCE * size):
        return push
    still, none = np.zeros((len(near.which), 3)), np.zeros_like(near.forces)
    law = _law(given, touch, near, 0.0 if hard else SHOWN_YIELDING * YIELDING, 1.0)
    found = contact_push(touch, still, near, metric, answers, law, none, TOLERANCE * size)
    return found.nodes


@compiled(inline="always")
def _lifted(given, y, metric, near, answers):
    """Nodes (N, 3), moved so far that no contact point is left in an obstacle that does not yield;
    1 where some may be left all the same, else 0.
    """
    cells = given.model.cells
    settled = volumes(cells, y)
    for turn in range(LIFTS):
        push = _push_out(given, near, metric, answers, y, 1.0)
        if not push.any():
            return y, 0
        y = y + push
        # A push keeps the volumes to first order.
        lacking = settled - volumes(cells, y)
        if turn < LIFTS - 1 and (np.abs(lacking) > DRIFT * cells.volumes).any():
            y = y + expansion(lacking, metric)
    return y, 1


@compiled(inline="always")
def _volume_error(cells, y):
    """Greatest relative error of a region's volume for nodes y (N, 3)."""
    return np.abs(volumes(cells, y) / cells.volumes - 1.0).max()
