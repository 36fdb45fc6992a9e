"""Local and global steps of an RBF muscle, with volume and contact projected inside the iteration."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.rest_frame import diameter
from rbfmuscle.geometry.rotations import turned_quaternions
from rbfmuscle.jit import compiled
from rbfmuscle.model.constraints import ShapeConstraint, VolumeConstraint
from rbfmuscle.model.contact import ContactConstraint
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import Rest
from rbfmuscle.sim.contraction.law import FibreLaw
from rbfmuscle.sim.loop.contact import BoneContacts

CONTACT_TOLERANCE = 2e-5  # of the muscle's size: some micrometres
REACH_MARGIN = 0.003  # of the muscle's size
SETTLED = 1e-4  # of the muscle's size: an iteration that moves no centre farther was the last one
SETTLED_STILL = 2e-6  # the same where no bone moves, so that only activation leads anywhere


@compiled(error_model="numpy", nogil=False)
def _move_loop(first, second, columns, shares, moved, also):
    """Motions of each contact point for two motions of the centres: Σ_k share_k dx_k."""
    for s in range(len(columns)):
        ax, ay, az, bx, by, bz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(columns.shape[1]):
            j, share = columns[s, k], shares[s, k]
            ax += share * first[j, 0]
            ay += share * first[j, 1]
            az += share * first[j, 2]
            bx += share * second[j, 0]
            by += share * second[j, 1]
            bz += share * second[j, 2]
        moved[s, 0], moved[s, 1], moved[s, 2] = ax, ay, az
        also[s, 0], also[s, 1], also[s, 2] = bx, by, bz


@compiled(error_model="numpy", nogil=False)
def _gather_loop(gradient, columns, shares, out):
    """Transpose of `_move_loop`: out_k = Σ_s share_sk gradient_s."""
    out[:] = 0.0
    for s in range(len(columns)):
        for k in range(columns.shape[1]):
            for a in range(3):
                out[columns[s, k], a] += shares[s, k] * gradient[s, a]


@compiled(error_model="numpy")
def _carry_all_loop(x, target, rest, points, columns, shares, out):
    """Positions of the contact points: Σ_k share_k (x_k + T_k (X_s - X_k))."""
    for s in range(len(points)):
        for a in range(3):
            out[s, a] = 0.0
        for k in range(columns.shape[1]):
            if shares[s, k] == 0.0:
                continue
            j = columns[s, k]
            dx, dy, dz = points[s, 0] - rest[j, 0], points[s, 1] - rest[j, 1], points[s, 2] - rest[j, 2]
            t = target[j]
            for a in range(3):
                out[s, a] += shares[s, k] * (x[j, a] + t[a, 0] * dx + t[a, 1] * dy + t[a, 2] * dz)


def carry_points(x: Floats, shape: Any, points: Floats, columns: Integers, shares: Floats) -> Floats:
    """Where centres carry points that hang on them.

    Parameters
    ----------
    x : (K, 3) ndarray
        Centres now.
    shape : ShapeConstraint
        With its present targets.
    points : (n, 3) ndarray
        At rest.
    columns, shares : (n, k) ndarray
        Centres of each point, and their shares.

    Returns
    -------
    (n, 3) ndarray
    """
    out = np.empty_like(points)
    _carry_all_loop(x, shape.target, shape.rest, points, columns, shares, out)
    return out


class ElasticSolver:
    """Alternates local targets with one dense global solve, accelerated (Anderson), contacts inside.

    Parameters
    ----------
    rest : Rest
    options : RBFOptions
    law : FibreLaw, optional
        Of a muscle that contracts.
    """

    def __init__(self, rest: Rest, options: RBFOptions, law: FibreLaw | None = None) -> None:
        self.settled = SETTLED
        self.iterations, self.memory = options.iterations, options.acceleration
        self.shape = ShapeConstraint(
            rest.centres, rest.start, rest.other, rest.weight, rest.fibres,
            limits=(options.stretch_low, options.stretch_high), hold=options.stretch_hold,
            law=law,
        )  # fmt: skip
        self.volume = VolumeConstraint(rest.samples, rest.sample_faces)
        self.points = rest.contact_points()
        self.columns, self.shares = rest.columns, rest.shares
        self.free, self.held = rest.free, rest.held
        self.centres, self.scale = len(rest.centres), diameter(rest.centres)
        laplacian = self.shape.laplacian
        self.inverse = np.linalg.inv(laplacian[np.ix_(self.free, self.free)])
        self.inverse = 0.5 * (self.inverse + self.inverse.T)
        self.coupling = laplacian[np.ix_(self.free, self.held)]
        self.contact = ContactConstraint(
            self.columns, self.shares, inverse=self.inverse, free=self.free, count=self.centres,
            batch=options.contacts, tolerance=CONTACT_TOLERANCE * self.scale,
        )  # fmt: skip

    def deformation(self) -> np.ndarray:
        """Deformation gradient (K, 3, 3) at each centre."""
        return self.shape.deformation

    def snapshot(self) -> tuple[np.ndarray, ...]:
        """State that ``restore`` brings back."""
        shape = self.shape
        forces = self.contact.forces
        pushing = np.flatnonzero(forces)
        parts = shape.quaternion.copy(), shape.target.copy(), shape.deformation.copy()
        return *parts, np.array(forces.shape), pushing, forces.ravel()[pushing]

    def restore(self, state: tuple[np.ndarray, ...]) -> None:
        """Return to an earlier ``snapshot``."""
        shape = self.shape
        shape.quaternion[:], shape.target[:], shape.deformation[:], size, pushing, strength = state
        self.contact.forces = np.zeros(size)
        self.contact.forces.ravel()[pushing] = strength

    def transform(self, motion: np.ndarray, x: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4) that brought the centres to x (K, 3)."""
        self.shape.quaternion[:] = turned_quaternions(self.shape.quaternion, motion[:3, :3])
        self.shape.localise(x)

    def carry(self, x: np.ndarray) -> np.ndarray:
        """Contact points at centres x with the present targets, (K + S, 3)."""
        return carry_points(x, self.shape, self.points, self.columns, self.shares)

    def solve(self, x: np.ndarray, contacts: BoneContacts) -> np.ndarray:
        """Return the settled centres, (K, 3)."""
        x = x.copy()
        mixer = Anderson(self.memory)
        for step in range(self.iterations):
            new = self._iterate(x, contacts)
            moved = float(np.sqrt(((new - x) ** 2).sum(axis=1).max()))
            if step + 1 == self.iterations or moved < self.settled * self.scale:
                x = new
                break
            x[self.free] = mixer.mix(x[self.free], new[self.free])
        self.shape.localise(x)
        return x

    def _iterate(self, x: Floats, contacts: BoneContacts) -> Floats:
        """One local step, one global step, and on top of it pressure and contact together."""
        right = self.shape.localise(x)
        new = x.copy()
        new[self.free] = self.inverse @ (right[self.free] - self.coupling @ x[self.held])
        here, motion, moved = self.carry(x), np.empty_like(self.points), np.empty_like(self.points)
        excess, gradient = self.volume.evaluate(here[self.centres :])
        pull, response = np.empty_like(x), np.zeros_like(x)
        _gather_loop(gradient, self.columns[self.centres :], self.shares[self.centres :], pull)
        response[self.free] = self.inverse @ pull[self.free]
        _move_loop(new - x, response, self.columns, self.shares, motion, moved)
        stiffness = float(np.vdot(pull, response))
        pressure = -(excess + np.vdot(gradient, motion[self.centres :])) / stiffness
        motion += pressure * moved
        spaces = contacts.half_spaces(
            here, 1.5 * np.sqrt((motion**2).sum(axis=1)) + REACH_MARGIN * self.scale
        )
        sources = max(1, len(contacts.names) + len(contacts.neighbours))
        push, lost = self.contact.correction(spaces, sources, motion, moved, stiffness)
        return new + push + response * (pressure - lost / stiffness)


class Anderson:
    """Anderson acceleration of a fixed-point map (Walker & Ni 2011), with plain steps until it has memory.

    Parameters
    ----------
    memory : int
        Steps that are remembered; with 0 every step is plain.
    measured : int, optional
        The first so many numbers of a state tell how near it is; all by default.
    """

    def __init__(self, memory: int, measured: int | None = None) -> None:
        self.memory, self.measured = memory, measured
        self.residuals: list[Floats] = []  # how they and the images changed from step to step
        self.images: list[Floats] = []
        self.last: tuple[Floats, Floats] | None = None

    def mix(self, state: Floats, image: Floats) -> Floats:
        """Next state from one and its image."""
        if self.memory == 0:
            return image
        flat = image.ravel()
        residual = (flat - state.ravel())[: self.measured]
        if self.last is not None:
            self.residuals.append(residual - self.last[0])
            self.images.append(flat - self.last[1])
            del self.residuals[: -self.memory], self.images[: -self.memory]
        self.last = residual, flat.copy()
        if not self.residuals:
            return image
        df, dg = np.array(self.residuals), np.array(self.images)
        gram = df @ df.T
        gram[np.diag_indices_from(gram)] *= 1.0 + 1e-8
        gram[np.diag_indices_from(gram)] += 1e-300
        return (flat - np.linalg.solve(gram, df @ residual) @ dg).reshape(image.shape)
