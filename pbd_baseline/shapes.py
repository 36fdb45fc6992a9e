"""What gives a mesh muscle its shape: one class for each method of the paper."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from pbd_baseline.arap import ARAP, ARAPConstraint
from pbd_baseline.bending import BendingConstraint
from pbd_baseline.constraints import EdgeConstraint
from pbd_baseline.contact import ContactConstraint
from pbd_baseline.contraction import TENDON_WEIGHT, MeshFibres
from pbd_baseline.fibres import edge_stiffness
from pbd_baseline.options import PBDOptions
from pbd_baseline.rest import RestState
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import turned_quaternions
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.loops import loop

# How far one global step of ARAP carries, as a share of the muscle's diagonal.
STEP_REACH = 0.03
# Edges shorter or longer than these multiples of their rest length are hard in any case.
LIMITS = 0.6, 2.2


class Shape:
    """What all methods have in common: how the volume is restored, and what a snapshot holds.

    ``stiffer`` is a factor of the edges' weights (e,), of use to the ARAP models.
    """

    volume_in_sweeps = True

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
        """Go along with a rigid motion (4, 4)."""

    def snapshot(self) -> np.ndarray | None:
        """What the shape remembers from sweep to sweep; None where that is nothing."""
        return None

    def restore(self, state: Floats | None) -> None:
        """Go back to a snapshot."""

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


class RotatingShape(Shape):
    """A shape whose neighbourhoods have rotations (`ARAP`), which it remembers from sweep to
    sweep.
    """

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        self.arap = ARAP(rest.vertices, rest.topology, stiffer=stiffer)

    def transform(self, motion: np.ndarray) -> None:
        """The rotations go along with a rigid motion (4, 4)."""
        self.arap.quaternions[:] = turned_quaternions(self.arap.quaternions, motion[:3, :3])

    def snapshot(self) -> np.ndarray:
        """The rotations."""
        return self.arap.quaternions.copy()

    def restore(self, state: Floats | None) -> None:
        """Go back to the rotations of a snapshot."""
        self.arap.quaternions[:] = state


class ARAPShape(RotatingShape):
    """The ARAP energy as PBD constraints: the paper's section 6.2, first option."""

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        self.constraint = ARAPConstraint(self.arap, rest.inverse_mass)

    def contract(self, fibres: MeshFibres, points: np.ndarray) -> None:
        """Take rest vectors from the fibres."""
        self.arap.rest = fibres.targets(points)
        self.constraint.rest = np.ascontiguousarray(self.arap.rest[self.constraint.order])

    def sweep(self, points: Floats, time: float) -> None:
        """Rotations, then one small step of the constraints."""
        self.arap.fit_rotations(points)
        self.constraint.project(points, time=time)


class GlobalARAPShape(RotatingShape):
    """Local rotations and one prefactored global solve: the ARAP of the paper's second option.

    The global step makes E(x) + |x - z|^2 / (2 l^2) least in the surface's own measure, z where
    contact and volume have left the vertices: without it (l infinite) every step forgets the
    contacts, and a stretched muscle is pulled through the bone that it wraps. A free fixed point is
    the same for any l.
    """

    def __init__(self, rest: RestState, options: PBDOptions, stiffer: Floats | float = 1.0) -> None:
        super().__init__(rest, options, stiffer)
        self.free = np.flatnonzero(rest.inverse_mass > 0.0)
        self.held = np.flatnonzero(rest.inverse_mass == 0.0)
        reach = STEP_REACH * float(np.linalg.norm(np.ptp(rest.vertices, axis=0)))
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
