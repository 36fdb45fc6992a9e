"""One iteration of a muscle's solid towards equilibrium, and the way to the next.

The nodes y go to y + c (A⁻¹ f - y) under the forces f of targets, springs and pressures, with the
volumes corrected (`global_step.py`) and out of the obstacles (`contact_forces.py`); c is the calm
share. Anderson acceleration mixes the last steps (`anderson.py`).
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import Obstacles
from rbfmuscle.geometry.surfaces import farthest_move
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.anderson import mix
from rbfmuscle.muscle.contact_forces import Answers, Law, contact_push
from rbfmuscle.muscle.global_step import Metric, calm_share, corrected_pressures, global_step
from rbfmuscle.muscle.model import SolidModel, Stiffness
from rbfmuscle.muscle.near_points import Near, find_touch, near_motion
from rbfmuscle.muscle.rounded_bones import RoundedBones

# All lengths are relative to the muscle's size.
TOLERANCE = 2e-5  # violation of a contact that is left
MARGIN = 0.003  # obstacles are looked for beyond where a point goes by this
YIELDING = 1e-4  # how far a contact yields under a pressure of 2 μ


class Problem(NamedTuple):
    """What is given through a solve."""

    model: SolidModel
    stiffness: Stiffness
    obstacles: Obstacles
    rounded: RoundedBones
    springs: np.ndarray  # (N, 3) forces of the springs at held points on nodes at the origin
    activation: float
    tension: float  # of slack fibres


class Solver(NamedTuple):
    """What is chosen anew now and then as nodes move."""

    metric: Metric  # of corrections
    sound: bool  # whether there is one
    near: Near  # contact points near an obstacle
    answers: Answers  # of these to forces


class Iterate(NamedTuple):
    """Where the iteration is; changed in place."""

    y: np.ndarray  # (N, 3) nodes
    pressure: np.ndarray  # (M,)
    push: np.ndarray  # (N, 3) motion of the nodes by contact in the last step


class Step(NamedTuple):
    """One step of the iteration."""

    nodes: np.ndarray  # (N, 3)
    pressures: np.ndarray  # (M,)
    push: np.ndarray  # (N, 3) motion of the nodes by contact
    moved: float  # greatest motion of material [scene unit]
    residual: float  # what that is without shortening
    capped: bool  # whether contact forces are those of a capped solve
    room: bool  # whether the table of rounded bones had room


@compiled(inline="always")
def iterate(given, now, local, solver, travelled):
    """One global step with volumes and contacts; ``travelled`` is how far nodes have gone at
    most.
    """
    model = given.model
    size = given.model.size
    y = now.y
    pressure = now.pressure
    metric = solver.metric
    near = solver.near
    part = calm_share(pressure)
    force = local.right + given.springs
    new, change = global_step(model.cells, y, pressure, force, local, metric, part)
    # Contacts that push now push in the next iteration too: where the points will then go decides
    # what they meet.
    here, motion, reach = near_motion(near, y, new, now.push, MARGIN * size, travelled)
    touch, room = find_touch(near, here, reach, travelled, given.obstacles, given.rounded)
    law = contact_law(given, touch, near, YIELDING / part, part)
    found = contact_push(
        touch, motion, near, metric, solver.answers, law, near.forces, TOLERANCE * size
    )
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
def contact_law(given, touch, near, yielding, part):
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
def shorten(now, step, longest):
    """Shorten a step, in place, where material goes farther than ``longest``."""
    if step.moved > longest:
        share = longest / step.moved
        step.nodes[:] = now.y + share * (step.nodes - now.y)
        step.pressures[:] = now.pressure + share * (step.pressures - now.pressure)


@compiled(inline="always")
def advance(now, step, memory, accelerated):
    """Go on to the nodes and pressures that the next iteration starts from; returns how far the
    nodes go at most.
    """
    before = now.y.copy()
    if accelerated:
        _accelerate(now, step, memory)
    else:
        memory.steps[0] = 0
        now.y[:] = step.nodes
        now.pressure[:] = step.pressures
    return farthest_move(now.y, before)


@compiled(inline="always")
def _accelerate(now, step, memory):
    """Go on to the mixture of the last steps."""
    count = now.y.size
    here, there = np.empty(count + len(now.pressure)), np.empty(count + len(now.pressure))
    here[:count] = now.y.ravel()
    here[count:] = now.pressure
    there[:count] = step.nodes.ravel()
    there[count:] = step.pressures
    mixed = mix(memory, here, there)
    now.y[:] = mixed[:count].reshape(now.y.shape)
    now.pressure[:] = mixed[count:]
