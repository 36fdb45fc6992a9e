"""Rest lengths of edges along and across the fibres: slack fibres of a passive muscle, active ones, tendon."""

from __future__ import annotations

import numpy as np

from pbd_baseline.rest import RestState
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled
from rbfmuscle.scene.activation.keys import Contraction
from rbfmuscle.scene.activation.law import FibreLaw
from rbfmuscle.scene.activation.resolve import resolve_contraction
from rbfmuscle.scene.objects import Muscle

# Weight of tendon edges in the ARAP energy. Beside a belly that shortens by a fifth tendon keeps its length within
# 0.6 %; at 100 it takes up so little in an iteration that a belly between fixed bones ends 8 % too long.
TENDON_WEIGHT = 20.0


class MeshFibres:
    """Fibres of a mesh muscle: a frame along the fibre at each edge, and what the edge should be in it.

    An edge with the rest vector E, the fibre direction a and the target stretches t along and s across (means of its
    two vertices) is wanted as T E, T = t aaᵀ + s (1 - aaᵀ). A passive fibre may have any stretch t from 1 / slack to 1,
    with s = t^(-1/2).

    Parameters
    ----------
    muscle : Muscle
    rest : RestState
    slack : float
        Of the passive fibres where the muscle gives none of its own, 1 or more.
    """

    def __init__(self, muscle: Muscle, rest: RestState, *, slack: float) -> None:
        count = len(rest.vertices)
        given = resolve_contraction(muscle)
        if given is None:
            given = Contraction(1.0, 1.0, np.zeros(len(rest.vertices), dtype=bool), 0.0)
        tendon = np.asarray(given.tendon)[rest.order]
        self.slack = 1.0 if given.slack else slack
        self.law = FibreLaw(tendon, given, hold=1.0)
        edges = rest.topology.edges
        self.edges = edges
        self.tendon = tendon[edges].all(axis=1)
        self.vectors = rest.vertices[edges[:, 0]] - rest.vertices[edges[:, 1]]
        one, other = rest.fibres[edges[:, 0]], rest.fibres[edges[:, 1]]
        axis = one + np.where(np.einsum("ij,ij->i", one, other) < 0.0, -1.0, 1.0)[:, None] * other
        size = np.linalg.norm(axis, axis=1, keepdims=True)
        self.known = size > 1e-12  # else the fibres have no direction there
        axis = np.divide(axis, size, out=np.zeros_like(axis), where=self.known)
        along = np.einsum("ij,ij->i", self.vectors, axis)
        self.along = along[:, None] * axis
        square = np.einsum("ij,ij->i", self.vectors, self.vectors)
        self.lengths = np.sqrt(square)
        # Weight of an edge in the stretch along the fibre: the fourth power of the cosine between them.
        self.weights = (along**2 / np.maximum(square, 1e-300)) ** 2
        self.stretch = np.ones(count)
        self.activate(0.0)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1."""
        self.law.activate(activation)
        belly = ~self.law.tendon
        self.law.lower[belly] -= (1.0 - activation) * (1.0 - 1.0 / self.slack)

    @property
    def activation(self) -> float:
        """Present activation, 0 to 1."""
        return self.law.activation

    def targets(self, points: Floats) -> Floats:
        """Wanted vectors of the edges (e, 3) in the rest frame, for the present points (n, 3)."""
        _stretch_loop(points, self.edges, self.lengths, self.weights, self.stretch)
        along, across = self.law.goal(self.stretch)
        t = 0.5 * (along[self.edges[:, 0]] + along[self.edges[:, 1]])[:, None]
        s = 0.5 * (across[self.edges[:, 0]] + across[self.edges[:, 1]])[:, None]
        t, s = np.where(self.known, t, 1.0), np.where(self.known, s, 1.0)
        return s * self.vectors + (t - s) * self.along


@compiled(error_model="numpy")
def _stretch_loop(points, edges, lengths, weights, stretch):
    """Stretch along the fibre at each vertex: mean ratio of its edges, by how much they lie along the fibre."""
    total = np.full(len(stretch), 1e-9)
    stretch[:] = 1e-9
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        square = 0.0
        for k in range(3):
            square += (points[i, k] - points[j, k]) ** 2
        ratio = weights[c] * np.sqrt(square) / lengths[c]
        stretch[i] += ratio
        stretch[j] += ratio
        total[i] += weights[c]
        total[j] += weights[c]
    stretch /= total
