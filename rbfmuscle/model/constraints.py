"""What holds an RBF muscle together: shape with free fibre stretch, and volume.

Both act on the K centres. The shape energy is quadratic once its local targets are known; volume and contact are
projected in the metric of that energy (through the inverse of its matrix), so a correction spreads smoothly over
the muscle instead of dinting one point.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.rotations import quaternion_matrix
from rbfmuscle.geometry.surfaces import volume_and_gradient
from rbfmuscle.jit import compiled
from rbfmuscle.sim.contraction.law import FibreLaw


@compiled(error_model="numpy")
def _rotation_loop(m, q):
    """Turn the unit quaternion q in place towards the rotational part of the 3x3 matrix m (Müller 2016)."""
    for _ in range(20):
        w, x, y, z = q[0], q[1], q[2], q[3]
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = quaternion_matrix(q)
        # Sum of cross products of the columns of R and of m: the torque that aligns them.
        ox = r10 * m[2, 0] - r20 * m[1, 0] + r11 * m[2, 1] - r21 * m[1, 1] + r12 * m[2, 2] - r22 * m[1, 2]
        oy = r20 * m[0, 0] - r00 * m[2, 0] + r21 * m[0, 1] - r01 * m[2, 1] + r22 * m[0, 2] - r02 * m[2, 2]
        oz = r00 * m[1, 0] - r10 * m[0, 0] + r01 * m[1, 1] - r11 * m[0, 1] + r02 * m[1, 2] - r12 * m[0, 2]
        trace = (
            r00 * m[0, 0] + r10 * m[1, 0] + r20 * m[2, 0] + r01 * m[0, 1] + r11 * m[1, 1] + r21 * m[2, 1]
        ) + (r02 * m[0, 2] + r12 * m[1, 2] + r22 * m[2, 2])
        scale = 1.0 / (abs(trace) + 1e-12)
        ox, oy, oz = ox * scale, oy * scale, oz * scale
        angle = np.sqrt(ox * ox + oy * oy + oz * oz)
        if angle < 1e-8:
            break
        half = 0.125 * angle * angle
        if angle < 1e-2:
            # Series that are exact to rounding: the angles are small but for the first of them.
            s, c = 0.5 - half * (1.0 - 0.1 * half) / 6.0, 1.0 - half * (1.0 - half / 6.0)
        else:
            s, c = np.sin(0.5 * angle) / angle, np.cos(0.5 * angle)
        dx, dy, dz = ox * s, oy * s, oz * s
        q[0] = c * w - dx * x - dy * y - dz * z
        q[1] = c * x + dx * w + dy * z - dz * y
        q[2] = c * y - dx * z + dy * w + dz * x
        q[3] = c * z + dx * y - dy * x + dz * w
        norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        for k in range(4):
            q[k] *= norm


@compiled(error_model="numpy")
def _local_loop(x, clusters, law, q, target, deformation):
    """Deformation gradient F and target T of each cluster, T = R (t aaᵀ + s (I - aaᵀ))."""
    arm, start, other, inverse, fibre = clusters
    low, high, lower, upper, share, across = law
    f = np.empty((3, 3))
    for i in range(len(start) - 1):
        f[:] = 0.0
        for e in range(start[i], start[i + 1]):
            j = other[e]
            for a in range(3):
                d = x[j, a] - x[i, a]
                for b in range(3):
                    f[a, b] += d * arm[e, b]
        for a in range(3):
            for b in range(3):
                deformation[i, a, b] = (
                    f[a, 0] * inverse[i, 0, b] + f[a, 1] * inverse[i, 1, b] + f[a, 2] * inverse[i, 2, b]
                )
        _rotation_loop(deformation[i], q[i])
        r = target[i]
        first, second, third = quaternion_matrix(q[i])
        for b in range(3):
            r[0, b], r[1, b], r[2, b] = first[b], second[b], third[b]
        stretch = 0.0
        for a in range(3):
            stretch += (
                deformation[i, a, 0] * fibre[i, 0]
                + deformation[i, a, 1] * fibre[i, 1]
                + deformation[i, a, 2] * fibre[i, 2]
            ) ** 2
        stretch = min(max(np.sqrt(stretch), low), high)
        goal = min(max(stretch, lower[i]), upper[i])
        t = goal + (1.0 - share[i]) * (stretch - goal)
        s = 1.0 / np.sqrt(goal + (1.0 - across[i]) * (stretch - goal))
        for a in range(3):
            along = r[a, 0] * fibre[i, 0] + r[a, 1] * fibre[i, 1] + r[a, 2] * fibre[i, 2]
            for b in range(3):
                r[a, b] = s * r[a, b] + (t - s) * along * fibre[i, b]


@compiled(error_model="numpy", nogil=False)
def _right_side_loop(arm, start, other, target, out):
    """b = Σ over edges (i, j) of w T_i (X_j - X_i), added at j and taken from i."""
    out[:] = 0.0
    for i in range(len(start) - 1):
        t = target[i]
        for e in range(start[i], start[i + 1]):
            j = other[e]
            for a in range(3):
                v = t[a, 0] * arm[e, 0] + t[a, 1] * arm[e, 1] + t[a, 2] * arm[e, 2]
                out[j, a] += v
                out[i, a] -= v


class ShapeConstraint:
    """Keeps each cluster of centres near a rotated copy of itself, stretched along the fibre.

    E(x) = Σ_i Σ_j w_ij |(x_j - x_i) - T_i (X_j - X_i)|²,  T_i = R_i (t aaᵀ + t^(-1/2) (I - aaᵀ)),
    with R_i the rotation of the cluster's deformation gradient F_i, a its fibre direction at rest and t its
    fibre stretch |F_i a|, free within ``limits`` but for the share that ``law`` pulls it back by. Thickness
    follows the stretch at constant volume. With T frozen E is quadratic with the matrix ``laplacian`` (as in ARAP,
    Sorkine & Alexa 2007, or projective dynamics, Bouaziz 2014).

    Parameters
    ----------
    rest : (K, 3) ndarray
        Centres at rest.
    start, other : CSR neighbour lists of the clusters.
    weight : (len(other),) ndarray
        Weight of each directed edge.
    fibre : (K, 3) ndarray
        Unit fibre direction at rest.
    hold : float
        Share that pulls the stretch back to one, where there is no ``law``.
    law : rbfmuscle.sim.contraction.law.FibreLaw, optional
        Of the clusters of a muscle that contracts.
    """

    def __init__(
        self,
        rest: Floats,
        start: Integers,
        other: Integers,
        weight: Floats,
        fibre: Floats,
        *,
        limits: tuple[float, float] = (0.5, 2.0),
        hold: float = 0.1,
        law: Any = None,
    ) -> None:
        self.rest, self.start, self.other, self.weight, self.fibre = rest, start, other, weight, fibre
        self.limits = limits
        self.law = law or FibreLaw(np.zeros(len(rest), dtype=bool), None, hold=hold)
        count = len(rest)
        head = np.repeat(np.arange(count), np.diff(start))
        edge = rest[other] - rest[head]
        self.arm = weight[:, None] * edge
        moment = np.zeros((count, 3, 3))
        np.add.at(moment, head, weight[:, None, None] * edge[:, :, None] * edge[:, None, :])
        # A nearly flat cluster says nothing across itself: the small multiple keeps F regular there.
        moment += 1e-6 * np.trace(moment, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        self.inverse = np.linalg.inv(moment)
        self.laplacian = np.zeros((count, count))
        np.add.at(self.laplacian, (head, head), weight)
        np.add.at(self.laplacian, (other, other), weight)
        np.add.at(self.laplacian, (head, other), -weight)
        np.add.at(self.laplacian, (other, head), -weight)
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self.target = np.tile(np.eye(3), (count, 1, 1))
        self.deformation = np.tile(np.eye(3), (count, 1, 1))
        self.right_side = np.zeros_like(rest)

    def localise(self, x: Floats) -> Floats:
        """Update F_i and T_i from the centres and return the right side b of laplacian · x = b, (K, 3)."""
        low, high = self.limits
        clusters = self.arm, self.start, self.other, self.inverse, self.fibre
        law = low, high, self.law.lower, self.law.upper, self.law.share, self.law.across
        _local_loop(x, clusters, law, self.quaternion, self.target, self.deformation)
        _right_side_loop(self.arm, self.start, self.other, self.target, self.right_side)
        return self.right_side

    def energy(self, x: Floats) -> float:
        """E(x) with the targets of the last ``localise``."""
        head = np.repeat(np.arange(len(self.rest)), np.diff(self.start))
        wanted = np.einsum("eab,eb->ea", self.target[head], self.rest[self.other] - self.rest[head])
        return float(self.weight @ ((x[self.other] - x[head] - wanted) ** 2).sum(axis=1))


class VolumeConstraint:
    """C(p) = V(p) - V0 with V = (1/6) Σ a · (b × c) and ∂V/∂a = (1/6) Σ b × c over the faces at a.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Rest positions, which enclose V0.
    faces : (m, 3) ndarray of int
        Closed, outward.

    Attributes
    ----------
    rest : float
        V0 [unit^3].
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.faces = faces
        self.rest = self.volume(vertices)

    def volume(self, points: np.ndarray) -> float:
        """Signed enclosed volume [unit^3]."""
        return volume_and_gradient(points, self.faces, np.empty_like(points))

    def evaluate(self, points: np.ndarray) -> tuple[float, np.ndarray]:
        """C and its gradient (n, 3)."""
        gradient = np.empty_like(points)
        return volume_and_gradient(points, self.faces, gradient) - self.rest, gradient
