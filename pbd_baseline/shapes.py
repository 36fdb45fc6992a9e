"""What gives a mesh muscle its shape: one class for each way of the paper, all swept in the same manner.

A shape offers ``sweep(points, time)``: one iteration, in place, that keeps held vertices where they are. The
muscle around it adds collisions and volume after each.
"""

import numpy as np
import scipy.sparse as sparse

from pbd_baseline.arap import ARAP, ARAPConstraint
from pbd_baseline.bending import BendingConstraint
from pbd_baseline.constraints import EdgeConstraint
from pbd_baseline.factor import SymmetricFactor
from pbd_baseline.fibres import edge_stiffness, vertex_areas


class PBDShape:
    """Edges, softer along the fibres, and dihedral angles, with stiffnesses (Müller 2007)."""

    def __init__(self, rest, options):
        stiffness = edge_stiffness(rest.vertices, rest.topology.edges, rest.fibres, options.fibre_exponent)
        if options.soft_length > 0.0:
            stiffness = stiffness * np.minimum(1.0, options.soft_length / rest.relative_lengths())
        self.inverse_mass = rest.inverse_mass
        self.edges = EdgeConstraint(
            rest.vertices, rest.topology.edges, stiffness=options.edge * stiffness, limits=options.limits
        )
        self.bending = BendingConstraint(
            rest.vertices, rest.topology.edges, rest.topology.wings, stiffness=options.bending
        )

    def sweep(self, points, time):
        """One Gauss-Seidel sweep; PBD knows no time."""
        self.bending.project(points, self.inverse_mass)
        self.edges.project(points, self.inverse_mass)


class XPBDShape:
    """The same constraints with compliances, one iteration in each of many small steps (Macklin 2019).

    A muscle without inertia relaxes by c dx/dt = -grad E, so the implicit step is that of XPBD with the
    compliance over the time instead of its square: more and smaller steps, or larger motions at once, end in
    the same place.
    """

    def __init__(self, rest, options):
        softness = edge_stiffness(rest.vertices, rest.topology.edges, rest.fibres, options.fibre_exponent)
        self.inverse_mass = rest.inverse_mass
        self.edges = EdgeConstraint(rest.vertices, rest.topology.edges, limits=options.limits)
        self.bending = BendingConstraint(rest.vertices, rest.topology.edges, rest.topology.wings)
        compliance = options.edge_compliance * rest.relative_lengths() / np.maximum(softness, 1e-3)
        self.edge_compliance = compliance[self.edges.order]
        # C is an angle: times a length to be comparable with the edges' C
        self.bending_compliance = options.bending_compliance / np.mean(self.edges.rest) ** 2

    def sweep(self, points, time):
        """One small step of the given time."""
        self.edges.compliance = self.edge_compliance / time
        self.bending.compliance[:] = self.bending_compliance / time
        self.edges.reset()
        self.bending.reset()
        self.bending.project(points, self.inverse_mass)
        self.edges.project(points, self.inverse_mass)


class ARAPShape:
    """The ARAP energy as PBD constraints: the paper's section 6.2, first option."""

    def __init__(self, rest, options):
        self.inverse_mass = rest.inverse_mass
        self.arap = ARAP(rest.vertices, rest.topology)
        self.constraint = ARAPConstraint(self.arap, compliance=options.arap_compliance)

    def sweep(self, points, time):
        """Rotations, then one small step of the constraints."""
        self.arap.fit_rotations(points)
        self.constraint.reset()
        self.constraint.project(points, self.inverse_mass, time=time)


class GlobalARAPShape:
    """Local rotations and one prefactored global solve: the ARAP of the paper's second option.

    The global step makes E(x) + |x - z|^2 / (2 l^2) least in the surface's own measure, z where contact and
    volume have left the vertices: without it (l infinite) every step forgets the contacts, and a stretched
    muscle is pulled through the bone that it wraps. A free fixed point is the same for any l.
    """

    def __init__(self, rest, options):
        self.arap = ARAP(rest.vertices, rest.topology)
        self.free = np.flatnonzero(rest.inverse_mass > 0.0)
        self.held = np.flatnonzero(rest.inverse_mass == 0.0)
        reach = options.arap_reach * float(np.linalg.norm(np.ptp(rest.vertices, axis=0)))
        self.mass = vertex_areas(rest.vertices, rest.topology.faces)[self.free, None] / reach**2
        rows = self.arap.laplacian[self.free]
        self.factor = SymmetricFactor(rows[:, self.free] + sparse.diags(self.mass[:, 0]))
        self.coupling = rows[:, self.held].tocsr()

    def sweep(self, points, time):
        """One local and one global step."""
        self.arap.fit_rotations(points)
        right = self.arap.targets()[self.free] + self.mass * points[self.free]
        right -= self.coupling @ points[self.held]
        points[self.free] = self.factor.solve(right)

    def smooth(self, gradient):
        """L^-1 of a gradient (n, 3): its smooth (Sobolev) direction, 0 at held vertices."""
        direction = np.zeros_like(gradient)
        direction[self.free] = self.factor.solve(np.ascontiguousarray(gradient[self.free]))
        return direction


SHAPES = {
    "pbd": PBDShape,
    "xpbd": XPBDShape,
    "arap-pbd": ARAPShape,
    "arap-volume": GlobalARAPShape,
    "arap-interleaved": GlobalARAPShape,
}
