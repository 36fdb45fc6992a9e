"""What changes of an RBF muscle's solid, and the steps that move it with the bones.

A state is never changed in place: each step returns another one. So a state is its own snapshot.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import turned_quaternions
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.solid.metric import Metric
from rbfmuscle.solid.model import ANTI_BUCKLING_TENSION, GREATEST_TENSION, SolidModel

# Greatest multiple of the last sub-step's correction that the next one starts with, and the least
# motion of an attachment, of the muscle's size, in a step whose correction counts.
MOST_TREND, LEAST_STEP = 1.5, 2e-5


class SolidState(NamedTuple):
    """A solid of N nodes, Q quadrature points, M regions, n contact points and h held ones."""

    nodes: np.ndarray  # (N, 3) in equilibrium with contacts that yield a little
    lifted_nodes: np.ndarray  # (N, 3) for the shown surface: what is left in a bone moved out
    points: np.ndarray  # (n, 3) contact points, carried by the lifted nodes
    rotations: np.ndarray  # (Q, 4) unit quaternions
    stretches: np.ndarray  # (Q,) of slack fibres
    pressures: np.ndarray  # (M,) over 2 μ
    forces: np.ndarray  # (n, b) of contacts with the bones in reach, over 2 μ
    anchors: np.ndarray  # (h, 3) where the bones hold the held points
    # The last step of the anchors (h, 3), and nodes (N, 3) and pressures (M,) as first predicted;
    # what a solve added to these is the correction that the next step starts with.
    step: np.ndarray
    start: np.ndarray
    start_pressures: np.ndarray
    activation: float
    metric: Metric | None  # of the last solve
    turn: np.ndarray  # (3, 3) rotation of the solid since then
    settled_in: int  # iterations of the last solve
    slowness: float  # way to the equilibrium over a step, as the last solve saw it


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
        np.zeros((len(model.points), 0)),
        held,
        np.zeros_like(held),
        nodes,
        np.zeros(regions),
        0.0,
        None,
        np.eye(3),
        0,
        0.0,
    )


def tension(model: SolidModel, anchors: Floats) -> float:
    """Tension τ of slack fibres over 2 μ: it grows as the muscle's ends, those of the anchors
    (h, 3) that `SolidModel.end` marks, approach from their distance at rest.
    """
    first, last = anchors[model.end == 0], anchors[model.end == 1]
    if len(first) == 0:
        return 0.0
    distance = float(np.linalg.norm(first.mean(axis=0) - last.mean(axis=0)))
    nearer = max(0.0, 1.0 - distance / model.end_distance)
    return min(ANTI_BUCKLING_TENSION * nearer * nearer, GREATEST_TENSION)


def predict(model: SolidModel, state: SolidState, before: Floats, after: Floats) -> SolidState:
    """The state after the bones moved between two sets of poses (b, 4, 4).

    Nodes take the mean of the bones' motions with the nodes' weights, see `blended_motion`.
    Where the motion goes on as before, so does the last correction. Contact points are those of
    the mean motion alone, from which a solve tells what passed through a bone.
    """
    start = blended_motion(state.nodes, model.motion_weights, after @ np.linalg.inv(before))
    pose = after[model.held_bone]
    held = model.points[model.held]
    anchors = np.einsum("hab,hb->ha", pose[:, :3, :3], held) + pose[:, :3, 3]
    step = anchors - state.anchors
    share = 0.0
    if np.abs(state.step).max(initial=0.0) > LEAST_STEP * model.size:
        along = float(np.vdot(step, state.step) / np.vdot(state.step, state.step))
        share = min(max(along, -MOST_TREND), MOST_TREND)
    return state._replace(
        nodes=start + share * (state.nodes - state.start),
        pressures=state.pressures + share * (state.pressures - state.start_pressures),
        anchors=anchors,
        step=step,
        start=start,
        start_pressures=state.pressures,
    )


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
        turn=motion[:3, :3] @ state.turn,
        start=state.start @ turned + shift,
    )
