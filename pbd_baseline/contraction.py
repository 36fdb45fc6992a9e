"""Rest lengths of edges along and across the fibres: slack fibres of a passive muscle, active ones,
tendon.
"""

import numpy as np

from pbd_baseline.rest import RestState
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import dot, minus, row_of
from rbfmuscle.loops import loop
from rbfmuscle.scene.activation import make_contraction
from rbfmuscle.scene.objects import Muscle

# Weight of tendon edges in the ARAP energy. Beside a belly that shortens by a fifth tendon keeps
# its length within 0.6 %; at 100 it takes up so little in an iteration that a belly between fixed
# bones ends 8 % too long.
TENDON_WEIGHT = 20.0


class MeshFibres:
    """Fibres of a mesh muscle: a frame along the fibre at each edge, and what the edge should be in
    it.

    An edge with the rest vector E, the fibre direction a and the target stretches t along and s
    across (means of its two vertices) is wanted as T E, T = t aaᵀ + s (1 - aaᵀ). With λ the stretch
    against the scan and a the activation,

        t = min(max(λ, lower), upper),    s = (t + a (λ - t))^(-1/2).

    A passive fibre is slack, where nothing pulls, between its stretch in the scan, 1, and 1 /
    stretch_at_rest (or 1 / slack, where the scene does not say). Activation moves both ends of this
    band in proportion towards the stretch at which a fully active fibre has no tension. An active
    fibre pulls along itself alone: with the girth of t it would push outwards too, and the widest
    place of a belly would take all the shortening. Tendon keeps its length, but may stretch by its
    strain at full activation.
    """

    def __init__(self, muscle: Muscle, rest: RestState, *, slack: float) -> None:
        count = len(rest.vertices)
        self.given = make_contraction(muscle)
        self.at_tendon = self.given.tendon[rest.order]
        self.slack = 1.0 if self.given.slack else slack
        self._contracts = self.given.stretch_at_rest != 1.0 or bool(self.at_tendon.any())
        edges = rest.topology.edges
        self.edges = edges
        self.tendon = self.at_tendon[edges].all(axis=1)
        self.vectors = rest.vertices[edges[:, 0]] - rest.vertices[edges[:, 1]]
        one, other = rest.fibres[edges[:, 0]], rest.fibres[edges[:, 1]]
        axis = one + np.where(np.einsum("ij,ij->i", one, other) < 0.0, -1.0, 1.0)[:, None] * other
        size = np.linalg.norm(axis, axis=1, keepdims=True)
        self.known = size[:, 0] > 1e-12  # else the fibres have no direction there
        axis = np.divide(axis, size, out=np.zeros_like(axis), where=size > 1e-12)
        along = np.einsum("ij,ij->i", self.vectors, axis)
        self.along = along[:, None] * axis
        square = np.einsum("ij,ij->i", self.vectors, self.vectors)
        # Weight of an edge in the stretch along the fibre: the fourth power of the cosine between
        # them.
        weights = (along**2 / np.maximum(square, 1e-300)) ** 2
        self.per_length = weights / np.sqrt(square)
        self.total = 1e-9 + np.bincount(edges.T.ravel(), np.tile(weights, 2), count)
        self.across_square = np.maximum(square - along**2, 0.0)
        self.along_square = along**2
        #: Target stretches (n, 2) of the vertices, along the fibres and across.
        self.wanted = np.ones((count, 2))
        self.activate(0.0)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1."""
        given, self.activation = self.given, float(activation)
        least, most = min(1.0, 1.0 / given.stretch_at_rest), max(1.0, 1.0 / given.stretch_at_rest)
        passive = (1.0 - activation) * (1.0 - 1.0 / self.slack)
        lower = least + activation * (given.shortest - least) - passive
        upper = most + activation * (given.shortest - most)
        self.lower = np.where(self.at_tendon, 1.0, lower)
        self.upper = np.where(self.at_tendon, 1.0 + activation * given.tendon_strain, upper)
        self.active = np.where(self.at_tendon, 0.0, activation)

    @property
    def passive(self) -> bool:
        """Whether the fibres are those of a muscle that does not contract."""
        return self.activation == 0.0 and not self._contracts

    def targets(self, points: Floats) -> Floats:
        """Wanted vectors of the edges (e, 3) in the rest frame, for the present points (n, 3)."""
        self._find_wanted(points)
        wanted = 0.5 * (self.wanted[self.edges[:, 0]] + self.wanted[self.edges[:, 1]])
        t, s = np.where(self.known, wanted.T, 1.0)[:, :, None]
        return s * self.vectors + (t - s) * self.along

    def target_lengths(self, points: Floats, chosen: Integers, lengths: Floats) -> None:
        """Fill ``lengths`` (l,) with those of the `targets` of the ``chosen`` edges (l,)."""
        self._find_wanted(points)
        squares = self.along_square, self.across_square
        _length_loop(chosen, self.edges, self.known, self.wanted, squares, lengths)

    def _find_wanted(self, points: Floats) -> None:
        """Find the target stretches for the present points (n, 3)."""
        measured = self.edges, self.per_length, self.total
        _wanted_loop(points, measured, (self.lower, self.upper, self.active), self.wanted)


@loop
def _wanted_loop(points, measured, band, wanted):
    """Target stretches (n, 2) along the fibre and across it at each vertex.

    The present stretch λ is the mean ratio of the vertex's edges, by how much they lie along the
    fibre.
    """
    edges, per_length, total = measured
    lower, upper, active = band
    stretch = np.full(len(points), 1e-9)
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        apart = minus(row_of(points, i), row_of(points, j))
        ratio = per_length[c] * np.sqrt(dot(apart, apart))
        stretch[i] += ratio
        stretch[j] += ratio
    for i in range(len(points)):
        now = stretch[i] / total[i]
        along = min(max(now, lower[i]), upper[i])
        wanted[i, 0] = along
        wanted[i, 1] = 1.0 / np.sqrt(along + active[i] * (now - along))


@loop
def _length_loop(chosen, edges, known, wanted, squares, lengths):
    """|T E|, from E² = (E · a)² + rest by (t E · a)² + s² · rest."""
    along, across = squares
    for c in range(len(chosen)):
        e = chosen[c]
        i, j = edges[e, 0], edges[e, 1]
        t, s = 1.0, 1.0
        if known[e]:
            t = 0.5 * (wanted[i, 0] + wanted[j, 0])
            s = 0.5 * (wanted[i, 1] + wanted[j, 1])
        lengths[c] = np.sqrt(t * t * along[e] + s * s * across[e])
