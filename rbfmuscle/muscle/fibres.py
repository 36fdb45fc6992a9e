"""Gradients along the fibres of an RBF muscle, from origin to insertion."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.muscles import attachment_ends
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.solid.model import SolidModel, hung_matrix


def held_at_insertion(model: SolidModel, muscle: Muscle, joints: Sequence[Joint]) -> Booleans:
    """Which of the solid's held points (h,) lie nearer to the second end of the muscle than to the
    first; none where it has one end.
    """
    held = model.points[model.held]
    ends = attachment_ends(muscle, joints)
    if ends is None:
        return np.zeros(len(held), dtype=bool)
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    first, last = (
        cKDTree(vertices[np.concatenate([a.vertices for a in end])]).query(held)[0] for end in ends
    )
    return np.asarray(last < first)


def along_fibres(model: SolidModel, insertion: Booleans) -> Floats:
    """Gradient (Q, 3) at the quadrature points of the share that the points held at the
    ``insertion`` (h,) have in what moves a node.
    """
    matrix = hung_matrix(model)
    share = np.linalg.solve(matrix, model.springs @ np.stack([insertion, ~insertion], axis=1))
    return _gradient(model, share[:, 0] / share.sum(axis=1))


def flux(model: SolidModel, insertion: Booleans) -> Floats:
    """Gradient (Q, 3) of a potential whose flux from the points held at the origin to those at the
    ``insertion`` (h,) is one.
    """
    source = np.where(insertion, 1.0 / max(insertion.sum(), 1), -1.0 / max((~insertion).sum(), 1))
    right = model.hangs @ source
    return _gradient(model, np.linalg.lstsq(model.matrix, right, rcond=None)[0])


def fibre_stretches(model: SolidModel, nodes: Floats) -> Floats:
    """Stretch against rest (Q,) along the fibres at the quadrature points for nodes (N, 3)."""
    direction = model.fibres.direction
    along = [(_gradient(model, nodes[:, axis]) * direction).sum(axis=1) for axis in range(3)]
    return np.asarray(np.linalg.norm(along, axis=0))


def _gradient(model: SolidModel, values: Floats) -> Floats:
    """Gradient (Q, 3) at the quadrature points of values (N,) at the nodes."""
    cells = model.cells
    found = np.einsum("ck,ckb->cb", values[cells.nodes], cells.slopes)
    return np.asarray(found.reshape(len(found), 3, -1).swapaxes(1, 2).reshape(-1, 3))
