"""What changes of an RBF muscle's solid, and the steps that move it with the bones.

A state is never changed in place: each step returns another one. So a state is its own snapshot.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.harmonic import exponential_loop, logarithm_loop
from rbfmuscle.geometry.rotations import turned_quaternions
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.model import MOST_TONE, TONE, SolidModel, carry

# Greatest multiple of the last sub-step's correction that the next one starts with.
MOST_TREND = 1.5


class SolidState(NamedTuple):
    """A solid of N nodes, Q quadrature points, M regions, n contact points and h held ones.

    Nodes are in equilibrium with contacts that yield a little; those ``shown`` are the same with
    what is left in a bone moved out.
    """

    nodes: np.ndarray  # (N, 3)
    shown: np.ndarray  # (N, 3)
    points: np.ndarray  # (n, 3) contact points, carried by the shown nodes or fixed to a bone
    rotations: np.ndarray  # (Q, 4) unit quaternions
    stretches: np.ndarray  # (Q,) of slack fibres
    pressures: np.ndarray  # (M,) over 2 μ
    forces: np.ndarray  # (n, obstacles) of contacts, over 2 μ
    anchors: np.ndarray  # (h, 3) where the bones hold the held points
    # The last step of the anchors (h, 3), and nodes (N, 3) and pressures (M,) as first predicted.
    step: np.ndarray
    start: np.ndarray
    start_pressures: np.ndarray
    # Step of the anchors before, and what the solve then added to nodes and pressures.
    last_step: np.ndarray
    correction: np.ndarray
    correction_pressures: np.ndarray
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
        np.zeros_like(held),
        np.zeros_like(nodes),
        np.zeros(regions),
        np.zeros(1),
    )


@compiled(error_model="numpy")
def tension(model, anchors):
    """Tension τ of slack fibres, which goes with the distance between the muscle's ends."""
    middle, count = np.zeros((2, 3)), np.zeros(2)
    for i in range(len(anchors)):
        end = model.end[i]
        if end >= 0:
            count[end] += 1.0
            middle[end] += anchors[i]
    if count[0] == 0.0:
        return 0.0
    square = 0.0
    for a in range(3):
        square += (middle[0, a] / count[0] - middle[1, a] / count[1]) ** 2
    approach = 1.0 - np.sqrt(square) / model.end_distance
    return min(max(0.0, TONE * approach), MOST_TONE)


@compiled(error_model="numpy")
def _along(rest, pose, out):
    """A point at rest where a pose of its bone takes it."""
    for a in range(3):
        out[a] = pose[a, 3]
        for k in range(3):
            out[a] += pose[a, k] * rest[k]


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def predict(model, state, before, after):
    """The state after the bones moved between two sets of poses (b, 4, 4).

    Nodes take a mean of the bones' motions: the twists are averaged with the nodes' weights.
    Where the motion goes on as before, so does the last correction; what is shown has no part in
    that: neighbours add a mean of several corrections (`NeighbourSurface`).
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
    for i in range(len(model.fixed)):
        at = model.fixed[i]
        _along(model.points[at], after[model.fixed_bone[i]], points[at])
    step = anchors - state.anchors
    along = 0.0
    square = 0.0
    for i in range(len(step)):
        for a in range(3):
            along += step[i, a] * state.last_step[i, a]
            square += state.last_step[i, a] ** 2
    share = min(max(along / max(square, 1e-30), -MOST_TREND), MOST_TREND)
    return SolidState(
        nodes=start + share * state.correction,
        shown=start,
        points=points,
        rotations=state.rotations,
        stretches=state.stretches,
        pressures=state.pressures + share * state.correction_pressures,
        forces=state.forces,
        anchors=anchors,
        step=step,
        start=start,
        start_pressures=state.pressures,
        last_step=state.last_step,
        correction=state.correction,
        correction_pressures=state.correction_pressures,
        activation=state.activation,
    )


@compiled(error_model="numpy")
def place_points(model, nodes, before):
    """Contact points (n, 3) as nodes carry them, those that a bone holds exactly as they were
    ``before``.
    """
    points = carry(model.embedding, nodes)
    for at in model.fixed:
        points[at] = before[at]
    return points


def turn(model: SolidModel, state: SolidState, which: Booleans, transform: Floats) -> SolidState:
    """The state after a rigid transform (4, 4) of the nodes, as far as they carry free contact
    points of the mask ``which`` (n,).
    """
    hit, every = np.zeros((2, len(state.nodes)))
    columns, shares = model.embedding.columns, model.embedding.shares
    marked = which & (model.owner < 0)
    np.add.at(hit, columns[marked], shares[marked])
    np.add.at(every, columns, shares)
    share = (hit / np.maximum(every, 1e-12))[:, None]
    moved = state.nodes @ transform[:3, :3].T + transform[:3, 3]
    nodes = state.nodes + share * (moved - state.nodes)
    points = place_points(model, nodes, state.points)
    return state._replace(nodes=nodes, shown=nodes, points=points)


def transform(state: SolidState, motion: Floats) -> SolidState:
    """The state after a rigid motion (4, 4) of the whole muscle."""
    turned, shift = np.ascontiguousarray(motion[:3, :3].T), motion[:3, 3]
    return state._replace(
        nodes=state.nodes @ turned + shift,
        shown=state.shown @ turned + shift,
        points=state.points @ turned + shift,
        rotations=turned_quaternions(state.rotations, motion[:3, :3]),
        anchors=state.anchors @ turned + shift,
        last_step=state.last_step @ turned,
        correction=state.correction @ turned,
    )
