"""As-rigid-as-possible energy on a surface mesh: local rotations, the global solve, the PBD
constraint.

E(x) = 1/4 sum over edges of w_ij (|e_ij - R_i E_ij|^2 + |e_ij - R_j E_ij|^2), with e = x_i - x_j, E
the same at rest, each R_i the rotation that makes E least (Sorkine and Alexa 2007). With the
rotations optimal the gradient of E is its partial derivative with R frozen: grad_i E = sum_j w_ij
(e_ij - (R_i + R_j) E_ij / 2).
"""

import numpy as np

from pbd_baseline.topology import Topology, colour, members_in_order
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.frames import quaternion_matrix, rotate
from rbfmuscle.geometry.harmonic import cotangent_laplacian, graph_laplacian
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


class ARAPConstraint:
    """The ARAP energy as PBD constraints, a vector one an edge: the paper's section 6.2, first
    option.

    C = (x_i - x_j) - (R_i + R_j) (X_i - X_j) / 2, grad_i C = 1 = -grad_j C in each component,
    compliance 1 / w_ij: at convergence the gradient of the sum is that of the ARAP energy.
    """

    def __init__(self, arap: ARAP, inverse_mass: Floats) -> None:
        self.arap, self.inverse_mass = arap, inverse_mass
        edges = arap.topology.edges
        order, self.colours = colour(edges, inverse_mass)
        self.order = order
        self.edges = members_in_order(edges, order)
        self.rest = np.ascontiguousarray(arap.rest[order])
        # a mesh whose median cotangent is 0 has weights of 0
        self.compliance = 1.0 / np.maximum(arap.weights[order], LEAST_WEIGHT)

    def project(self, points: Floats, *, time: float = 1.0) -> None:
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place, with the arap's rotations."""
        _constraint_loop(
            points,
            self.inverse_mass,
            self.edges,
            self.rest,
            self.arap.quaternions,
            self.compliance,
            time,
        )


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
        for _ in range(ROTATION_STEPS):
            if _turn_towards(moment, quaternions[i]) < ROTATION_ERROR:
                break


@loop
def _turn_towards(moment, q):
    """One Newton step of maximising tr(R^T A) over rotations R; return its squared angle.

    With B = R^T A and S its symmetric part, the step solves (tr(S) 1 - S) omega = axial(B).
    One-rings are nearly flat, so A has rank two and a polar decomposition is not defined; this
    maximum is.
    """
    r = quaternion_matrix(q)
    b = np.empty((3, 3))
    for m in range(3):
        for n in range(3):
            b[m, n] = r[0][m] * moment[0, n] + r[1][m] * moment[1, n] + r[2][m] * moment[2, n]
    trace = b[0, 0] + b[1, 1] + b[2, 2]
    vx = b[2, 1] - b[1, 2]
    vy = b[0, 2] - b[2, 0]
    vz = b[1, 0] - b[0, 1]
    size = abs(trace) + abs(vx) + abs(vy) + abs(vz)
    if size <= 0.0:
        return 0.0
    xx = trace - b[0, 0]
    yy = trace - b[1, 1]
    zz = trace - b[2, 2]
    xy = -0.5 * (b[0, 1] + b[1, 0])
    xz = -0.5 * (b[0, 2] + b[2, 0])
    yz = -0.5 * (b[1, 2] + b[2, 1])
    first, second = xx * yy - xy * xy, yy * zz - yz * yz
    third, fourth = xy * yz - xz * yy, xy * xz - xx * yz
    det = zz * first + xz * third + yz * fourth
    if xx > 1e-6 * size and first > 1e-12 * size * size and det > 1e-18 * size * size * size:
        ox = (second * vx + (xz * yz - xy * zz) * vy + third * vz) / det
        oy = ((xz * yz - xy * zz) * vx + (xx * zz - xz * xz) * vy + fourth * vz) / det
        oz = (third * vx + fourth * vy + first * vz) / det
    else:
        ox = vx / size
        oy = vy / size
        oz = vz / size
    square = ox * ox + oy * oy + oz * oz
    if square > 1.0:
        ox = ox / np.sqrt(square)
        oy = oy / np.sqrt(square)
        oz = oz / np.sqrt(square)
    _turn_quaternion(q, 0.5 * ox, 0.5 * oy, 0.5 * oz)
    return square


@loop
def _turn_quaternion(q, x, y, z):
    """q <- q (1, x, y, z), normalised: right to third order, and the fixed point is unchanged."""
    a = q[0]
    b = q[1]
    c = q[2]
    d = q[3]
    q[0] = a - b * x - c * y - d * z
    q[1] = b + a * x + c * z - d * y
    q[2] = c + a * y + d * x - b * z
    q[3] = d + a * z + b * y - c * x
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for k in range(4):
        q[k] /= size


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
def _constraint_loop(points, inverse_mass, edges, rest, quaternions, compliance, time):
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        wi, wj = inverse_mass[i], inverse_mass[j]
        soft = compliance[c] / time
        total = wi + wj + soft
        one, two = rotate(quaternions[i], rest[c]), rotate(quaternions[j], rest[c])
        for k in range(3):
            value = points[i, k] - points[j, k] - 0.5 * (one[k] + two[k])
            change = -value / total
            points[i, k] += wi * change
            points[j, k] -= wj * change
