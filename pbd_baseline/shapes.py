"""What gives a mesh muscle its shape: one class for each method of the paper, and the as-rigid-as-
possible energy that some of them lower, by local rotations, the global solve or constraints.

E(x) = 1/4 sum over edges of w_ij (|e_ij - R_i E_ij|^2 + |e_ij - R_j E_ij|^2), with e = x_i - x_j, E
the same at rest, each R_i the rotation that makes E least (Sorkine and Alexa 2007). With the
rotations optimal the gradient of E is its partial derivative with R frozen: grad_i E = sum_j w_ij
(e_ij - (R_i + R_j) E_ij / 2).
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from pbd_baseline.constraints import BendingConstraint, ContactConstraint, EdgeConstraint
from pbd_baseline.contraction import TENDON_WEIGHT, MeshFibres
from pbd_baseline.rest import PBDOptions, RestState, edge_stiffness
from pbd_baseline.topology import Topology, colour, members_in_order
from rbfmuscle.geometry.arrays import Floats, box_size
from rbfmuscle.geometry.frames import rotate, row_of, turn_towards, turned_quaternions
from rbfmuscle.geometry.harmonic import cotangent_laplacian, graph_laplacian
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.loops import loop

# Newton steps for the rotations: warm starts need one or two, a turn by 30 degrees at once four.
# At most so many, or to this squared angle: the next sweep goes on from where these end.
ROTATION_STEPS = 8
ROTATION_ERROR = 1e-12
LEAST_WEIGHT = 1e-9  # of an edge, so that its compliance is finite


class ARAP:
    """ARAP energy of a mesh, with the rotation (w, x, y, z) of each vertex in ``quaternions`` (n,
    4).

    The ``laplacian`` (n, n) has cotangent weights, clamped from below, times the edges' factor
    ``stiffer``.
    """

    def __init__(
        self, vertices: Floats, topology: Topology, *, stiffer: Floats | float = 1.0
    ) -> None:
        self.topology = topology
        self.laplacian = cotangent_laplacian(vertices, topology.faces)
        i, j = topology.edges.T
        self.weights = -np.asarray(self.laplacian[i, j]).ravel()
        if np.any(stiffer != 1.0):
            self.weights = self.weights * stiffer
            self.laplacian = graph_laplacian(i, j, self.weights, topology.vertex_count)
        self.rest = np.ascontiguousarray(vertices[i] - vertices[j])
        self.quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (topology.vertex_count, 1))

    def fit_rotations(self, points: Floats) -> None:
        """The local step: the best rotation of every one-ring, from the present ones on."""
        t = self.topology
        rings = t.ring_start, t.ring, t.ring_edge, t.edges
        _rotation_loop(points, rings, self.rest, self.weights, self.quaternions)

    def targets(self) -> Floats:
        """Right side (n, 3) of the global step: sum_j w_ij (R_i + R_j) E_ij / 2."""
        out = np.zeros((len(self.quaternions), 3))
        _target_loop(self.topology.edges, self.rest, self.weights, self.quaternions, out)
        return out


@loop
def _rotation_loop(points, rings, rest, weights, quaternions):
    start, ring, ring_edge, edges = rings
    moment = np.empty((3, 3))
    for i in range(len(quaternions)):
        moment[:] = 0.0
        for k in range(start[i], start[i + 1]):
            j, c = ring[k], ring_edge[k]
            sign = weights[c] if edges[c, 0] == i else -weights[c]
            for a in range(3):
                pull = sign * (points[i, a] - points[j, a])
                for b in range(3):
                    moment[a, b] += pull * rest[c, b]
        # One-rings are nearly flat, so the moment has rank two and a polar decomposition is not
        # defined; the rotation that these steps lead to is.
        rows = row_of(moment, 0), row_of(moment, 1), row_of(moment, 2)
        q = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        for _ in range(ROTATION_STEPS):
            turned = turn_towards(rows, q)
            square = 0.0
            for k in range(4):
                square += 4.0 * (turned[k] - q[k]) ** 2
            q = turned
            if square < ROTATION_ERROR:
                break
        for k in range(4):
            quaternions[i, k] = q[k]


@loop
def _target_loop(edges, rest, weights, quaternions, out):
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        one, two = rotate(quaternions[i], rest[c]), rotate(quaternions[j], rest[c])
        for k in range(3):
            pull = 0.5 * weights[c] * (one[k] + two[k])
            out[i, k] += pull
            out[j, k] -= pull


@loop
def _constraint_loop(points, inverse_mass, edges, order, rest, quaternions, compliance, time):
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        wi, wj = inverse_mass[i], inverse_mass[j]
        soft = compliance[c] / time
        total = wi + wj + soft
        apart = rest[order[c]]
        one, two = rotate(quaternions[i], apart), rotate(quaternions[j], apart)
        for k in range(3):
            value = points[i, k] - points[j, k] - 0.5 * (one[k] + two[k])
            change = -value / total
            points[i, k] += wi * change
            points[j, k] -= wj * change


# How far one global step of ARAP carries, as a share of the muscle's diagonal.
STEP_REACH = 0.03
# Edges shorter or longer than these multiples of their rest length are hard in any case.
LIMITS = 0.6, 2.2


class Shape:
    """What all methods have in common: how the volume is restored, and what a snapshot holds.

    ``stiffer`` is a factor of the edges' weights (e,), of use to the ARAP models.
    """

    volume_in_sweeps = True
    #: Rotations (n, 4) of neighbourhoods that are remembered from sweep to sweep, of ARAP models.
    quaternions: Floats | None = None

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        self.volume = rest.volume
        self.room = rest.room
        self.inverse_mass = rest.inverse_mass

    def sweep(self, points: np.ndarray, time: float) -> None:
        """One iteration of the given time, in place."""
        raise NotImplementedError

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take what edges shall be from the fibres, at the present points (n, 3)."""
        raise NotImplementedError

    def restore_volume(self, points: np.ndarray, contact: ContactConstraint) -> None:
        """Bring the volume back, in place: where there is room, and out of the way of contacts."""
        self.volume.restore(points, self._swelling(points), contact.planes)

    def transform(self, motion: np.ndarray) -> None:
        """The rotations go along with a rigid motion (4, 4)."""
        if self.quaternions is not None:
            self.quaternions[:] = turned_quaternions(self.quaternions, motion[:3, :3])

    def snapshot(self) -> np.ndarray | None:
        """The rotations; None where there are none."""
        return None if self.quaternions is None else self.quaternions.copy()

    def restore(self, state: Floats | None) -> None:
        """Go back to the rotations of a snapshot."""
        if self.quaternions is not None:
            self.quaternions[:] = state

    def _swelling(self, points: np.ndarray) -> np.ndarray:
        """Direction (n, 3) in which the muscle swells: along the normals, as far as there is
        room.
        """
        direction = self.volume.gradient(points)
        _scale_loop(direction, self.room)
        return direction


class PBDShape(Shape):
    """Edges, softer along the fibres, and dihedral angles, with stiffnesses (Müller 2007)."""

    # Three sweeps change the volume too little for PBD to feel it before the last of them.
    volume_in_sweeps = False
    # Edges longer than so many medians are softer in inverse proportion.
    soft_length = 0.3
    limits = LIMITS

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        stiffness = edge_stiffness(
            rest.vertices, rest.topology.edges, rest.fibres, options.fibre_exponent
        )
        stiffness = stiffness * np.minimum(1.0, self.soft_length / rest.relative_lengths())
        self.edges = EdgeConstraint(
            rest.vertices,
            rest.topology.edges,
            rest.inverse_mass,
            stiffness=stiffness,
            limits=self.limits,
        )
        self.passive = self.edges.stiffness
        self.activation = np.nan  # that the stiffnesses are for
        self.bending = BendingConstraint(
            rest.vertices,
            rest.topology.edges,
            rest.topology.wings,
            rest.inverse_mass,
            stiffness=options.bending,
        )

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take rest lengths and stiffnesses from the fibres: an active fibre is as stiff along as
        across.
        """
        fibres.target_lengths(points, self.edges.order, self.edges.rest)
        if fibres.activation != self.activation:
            self.activation = fibres.activation
            share = np.where(fibres.tendon, 1.0, fibres.activation)[self.edges.order]
            self.edges.stiffness = self.passive + share * (1.0 - self.passive)

    def sweep(self, points: Floats, time: float) -> None:
        """One Gauss-Seidel sweep; PBD knows no time."""
        self.bending.project(points)
        self.edges.project(points)


class XPBDShape(Shape):
    """The same constraints with compliances, one iteration in each of many small steps (Macklin
    2019).

    A muscle without inertia relaxes by c dx/dt = -grad E, so the compliance is divided by the time,
    not by its square.
    """

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        softness = edge_stiffness(
            rest.vertices, rest.topology.edges, rest.fibres, options.fibre_exponent
        )
        topology = rest.topology
        self.edges = EdgeConstraint(rest.vertices, topology.edges, rest.inverse_mass, limits=LIMITS)
        self.bending = BendingConstraint(
            rest.vertices, topology.edges, topology.wings, rest.inverse_mass
        )
        across = options.edge_compliance * rest.relative_lengths()
        self.edge_compliance = (across / np.maximum(softness, 1e-3))[self.edges.order]
        self.passive, self.stiffest = self.edge_compliance, across[self.edges.order]
        # C is an angle: times a length to be comparable with the edges' C
        self.bending_compliance = options.bending_compliance / np.mean(self.edges.rest) ** 2

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take rest lengths and compliances from the fibres: an active fibre is as stiff along as
        across.
        """
        fibres.target_lengths(points, self.edges.order, self.edges.rest)
        share = np.where(fibres.tendon, 1.0, fibres.activation)[self.edges.order]
        mixed = 1.0 / ((1.0 - share) / self.passive + share / self.stiffest)
        self.edge_compliance = np.where(share > 0.0, mixed, self.passive)
        self.edge_compliance[fibres.tendon[self.edges.order]] /= TENDON_WEIGHT

    def sweep(self, points: Floats, time: float) -> None:
        """One small step of the given time."""
        self.edges.compliance = self.edge_compliance / time
        self.bending.compliance = self.bending_compliance / time
        self.bending.project(points)
        self.edges.project(points)


class ARAPShape(Shape):
    """The ARAP energy as PBD constraints, a vector one an edge: the paper's section 6.2, first
    option.

    C = (x_i - x_j) - (R_i + R_j) (X_i - X_j) / 2, grad_i C = 1 = -grad_j C in each component,
    compliance 1 / w_ij: at convergence the gradient of the sum is that of the ARAP energy.
    """

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        self.arap = ARAP(rest.vertices, rest.topology, stiffer=stiffer)
        self.quaternions = self.arap.quaternions
        self.order, _ = colour(rest.topology.edges, rest.inverse_mass)
        self.edges = members_in_order(rest.topology.edges, self.order)
        # a mesh whose median cotangent is 0 has weights of 0
        self.compliance = 1.0 / np.maximum(self.arap.weights[self.order], LEAST_WEIGHT)

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take rest vectors from the fibres."""
        self.arap.rest = fibres.targets(points)

    def sweep(self, points: Floats, time: float) -> None:
        """Rotations, then one Gauss-Seidel sweep over the constraints, a small step."""
        self.arap.fit_rotations(points)
        self.project(points, time)

    def project(self, points: Floats, time: float) -> None:
        """One sweep over the constraints with the present rotations, in place."""
        _constraint_loop(
            points,
            self.inverse_mass,
            self.edges,
            self.order,
            self.arap.rest,
            self.arap.quaternions,
            self.compliance,
            time,
        )


class GlobalARAPShape(Shape):
    """Local rotations and one prefactored global solve: the ARAP of the paper's second option.

    The global step makes E(x) + |x - z|^2 / (2 l^2) least in the surface's own measure, z where
    contact and volume have left the vertices: without it (l infinite) every step forgets the
    contacts, and a stretched muscle is pulled through the bone that it wraps. A free fixed point is
    the same for any l.
    """

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        self.arap = ARAP(rest.vertices, rest.topology, stiffer=stiffer)
        self.quaternions = self.arap.quaternions
        self.free = np.flatnonzero(rest.inverse_mass > 0.0)
        self.held = np.flatnonzero(rest.inverse_mass == 0.0)
        reach = STEP_REACH * box_size(rest.vertices)
        self.mass = vertex_areas(rest.vertices, rest.topology.faces)[self.free, None] / reach**2
        rows = self.arap.laplacian[self.free]
        matrix = (rows[:, self.free] + sparse.diags(self.mass[:, 0])).tocsc()
        symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        self.factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", **symmetric)
        self.coupling = rows[:, self.held].tocsr()

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take rest vectors from the fibres; the matrix of the global step does not change."""
        self.arap.rest = fibres.targets(points)

    def sweep(self, points: Floats, time: float) -> None:
        """One local and one global step."""
        self.arap.fit_rotations(points)
        right = self.arap.targets()[self.free] + self.mass * points[self.free]
        right -= self.coupling @ points[self.held]
        points[self.free] = self.factor.solve(right)

    def _swelling(self, points: np.ndarray) -> np.ndarray:
        """L^-1 of the volume's gradient: its smooth (Sobolev) direction, 0 at held vertices."""
        gradient = self.volume.gradient(points)
        direction = np.zeros_like(gradient)
        direction[self.free] = self.factor.solve(gradient[self.free])
        return direction


class Method(NamedTuple):
    """One method: its shape and its number of sweeps per solve.

    With a ``tolerance`` above 0 sweeps go on until none moves a vertex by more than this share of
    the muscle's size.
    """

    shape: type[Shape]
    sweeps: int  # the authors' three for PBD; sub-steps of one sweep for XPBD
    tolerance: float = 0.0


METHODS = {
    "pbd": Method(PBDShape, 3),
    "xpbd": Method(XPBDShape, 10),
    "arap-pbd": Method(ARAPShape, 10),
    "arap-volume": Method(GlobalARAPShape, 6),
}


@loop
def _scale_loop(direction, length):
    """Give each row the length asked for."""
    for i in range(len(direction)):
        size = np.sqrt(direction[i, 0] ** 2 + direction[i, 1] ** 2 + direction[i, 2] ** 2)
        factor = length[i] / size if size > 0.0 else 0.0
        for k in range(3):
            direction[i, k] *= factor
