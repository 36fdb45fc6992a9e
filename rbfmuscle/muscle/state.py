"""What changes of an RBF muscle's solid, and the steps that move it with the bones.

A state is never changed in place: each step returns another one. So a state is its own snapshot.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.harmonic import exponential_loop, logarithm_loop
from rbfmuscle.geometry.rotations import turned_quaternions
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.model import ANTI_BUCKLING_TENSION, GREATEST_TENSION, SolidModel, carry

# Greatest multiple of the last sub-step's correction that the next one starts with, and the least
# motion of an attachment, of the muscle's size, in a step whose correction counts.
MOST_TREND, LEAST_STEP = 1.5, 2e-5


class SolidState(NamedTuple):
    """A solid of N nodes, Q quadrature points, M regions, n contact points and h held ones.

    Nodes are in equilibrium with contacts that yield a little; those ``shown`` are the same with
    what is left in a bone moved out.
    """

    nodes: np.ndarray  # (N, 3)
    lifted_nodes: np.ndarray  # (N, 3)
    points: np.ndarray  # (n, 3) contact points, carried by the shown nodes
    rotations: np.ndarray  # (Q, 4) unit quaternions
    stretches: np.ndarray  # (Q,) of slack fibres
    pressures: np.ndarray  # (M,) over 2 μ
    forces: np.ndarray  # (n, obstacles) of contacts, over 2 μ
    anchors: np.ndarray  # (h, 3) where the bones hold the held points
    # The last step of the anchors (h, 3), and nodes (N, 3) and pressures (M,) as first predicted;
    # what a solve added to these is the correction that the next step starts with.
    step: np.ndarray
    start: np.ndarray
    start_pressures: np.ndarray
    activation: np.ndarray  # (1,)


def rest_state(model: SolidModel) -> SolidState:
    """The solid at rest."""
    nodes, held = model.rest.copy(), model.points[model.held]
    regions, count = len(model.cells.volumes), len(model.cells.weights)
    return SolidState(
        nodes,
        nodes,
        model.points.copy(),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.ones(count),
        np.zeros(regions),
        np.zeros((len(model.points), 1)),
        held,
        np.zeros_like(held),
        nodes,
        np.zeros(regions),
        np.zeros(1),
    )


@compiled
def tension(end, distance, anchors):
    """Tension τ of slack fibres: it grows as the muscle's ends, those of the anchors (h, 3) whose
    ``end`` is 0 or 1, approach from their ``distance`` at rest.
    """
    middle, count = np.zeros((2, 3)), np.zeros(2)
    for i in range(len(anchors)):
        if end[i] >= 0:
            count[end[i]] += 1.0
            for a in range(3):
                middle[end[i], a] += anchors[i, a]
    if count[0] == 0.0:
        return 0.0
    square = 0.0
    for a in range(3):
        square += (middle[0, a] / count[0] - middle[1, a] / count[1]) ** 2
    nearer = max(0.0, 1.0 - np.sqrt(square) / distance)
    return min(ANTI_BUCKLING_TENSION * nearer * nearer, GREATEST_TENSION)


@compiled
def _along(rest, pose, out):
    """A point at rest where a pose of its bone takes it."""
    for a in range(3):
        out[a] = pose[a, 3]
        for k in range(3):
            out[a] += pose[a, k] * rest[k]


@compiled
def _relative(before, after):
    """Rigid motion (4, 4) from one pose to another: after · before⁻¹."""
    out = np.eye(4)
    for a in range(3):
        out[a, 3] = after[a, 3]
        for k in range(3):
            out[a, k] = 0.0
            for m in range(3):
                out[a, k] += after[a, m] * before[k, m]
        for k in range(3):
            out[a, 3] -= out[a, k] * before[k, 3]
    return out


def predict(model: SolidModel, state: SolidState, before: Floats, after: Floats) -> SolidState:
    """The state after the bones moved between two sets of poses (b, 4, 4).

    Nodes take a mean of the bones' motions: the twists are averaged with the nodes' weights.
    Where the motion goes on as before, so does the last correction; what is shown has no part in
    that: neighbours add a mean of several corrections (`NeighbourSurface`).
    """
    nodes, start, points, pressures, anchors, step = _predicted(model, state, before, after)
    return state._replace(
        nodes=nodes,
        lifted_nodes=start,
        points=points,
        pressures=pressures,
        anchors=anchors,
        step=step,
        start=start,
        start_pressures=state.pressures,
    )


@compiled
def _predicted(model, state, before, after):
    """Nodes, these without the last correction, contact points, pressures, anchors, and the
    anchors' step.
    """
    twists, one = np.empty((len(before), 6)), np.empty((1, 6))
    for b in range(len(before)):
        logarithm_loop(_relative(before[b], after[b]).reshape((1, 4, 4)), one)
        twists[b] = one[0]
    start = np.empty_like(state.nodes)
    exponential_loop(state.nodes, np.dot(model.motion_weights, twists), start)
    anchors = np.empty_like(state.anchors)
    for i in range(len(anchors)):
        _along(model.points[model.held[i]], after[model.held_bone[i]], anchors[i])
    points = carry(model.embedding, start)
    step = anchors - state.anchors
    along = 0.0
    square = 0.0
    farthest = 0.0
    for i in range(len(step)):
        for a in range(3):
            last = state.step[i, a]
            along += step[i, a] * last
            square += last * last
            farthest = max(farthest, abs(last))
    share = 0.0
    if farthest > LEAST_STEP * model.size:
        share = min(max(along / square, -MOST_TREND), MOST_TREND)
    nodes = start + share * (state.nodes - state.start)
    pressures = state.pressures + share * (state.pressures - state.start_pressures)
    return nodes, start, points, pressures, anchors, step


def transform(state: SolidState, motion: Floats) -> SolidState:
    """The state after a rigid motion (4, 4) of the whole muscle."""
    turned, shift = np.ascontiguousarray(motion[:3, :3].T), motion[:3, 3]
    return state._replace(
        nodes=state.nodes @ turned + shift,
        lifted_nodes=state.lifted_nodes @ turned + shift,
        points=state.points @ turned + shift,
        rotations=turned_quaternions(state.rotations, motion[:3, :3]),
        anchors=state.anchors @ turned + shift,
        step=state.step @ turned,
        start=state.start @ turned + shift,
    )
