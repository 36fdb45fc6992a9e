"""The inside of an RBF muscle: an elastic, incompressible solid that carries the centres.

With y the nodes of a `Lattice` and F = Σ y_k ∇N_k the deformation gradient at its quadrature points q,

    E(y) = μ Σ_q w_q (|F_q - T_q|² + c (|F_q a| - t)²),    V_r(y) = Σ_{q in r} w_q det F_q = V_r at rest,

with T the rotation of F, a the fibre, t the stretch that its spring is content at (1: passive), r the regions of
the lattice, one pressure each, and c = 3/2 (fibre_ratio - 1). For small strains and more and more nodes this is the
incompressible solid of shear modulus μ, Young's modulus 3 μ across and 3 μ · fibre_ratio along the fibres.

Each iteration solves with the matrix of E at fixed T, which never changes, and corrects the regions' volumes and the
contacts in its metric. The pressures are kept, so that where the iteration stands still the forces balance exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.geometry.rest_frame import diameter
from rbfmuscle.geometry.rotations import turned_quaternions
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.model.elasticity import Anderson
from rbfmuscle.model.inside.loops import (
    Fibres,
    carry_loop,
    mobility_loop,
    press_loop,
    respond_loop,
    stress_loop,
    swell_loop,
    turn_loop,
)
from rbfmuscle.model.inside.obstacles import Near, Obstacles

# Times the iterations of a muscle without an inside: they end by the residual, mostly sooner.
LEAST_ROUNDS = 3
HOLD = 25.0  # stiffness of the spring at a held point, in that of a cell
GHOST = 1e-3  # of a cell's stiffness: what carries nodes that hold hardly any material
MOST_TREND = 1.5  # of the last sub-step's correction that the next one starts with
MOBILE = 0.02  # points that move by less than this share of the median for a unit force are attached
SETTLED = 2e-5


class Interior:
    """An elastic solid on a lattice, with volume and contact inside the iteration.

    Parameters
    ----------
    lattice : Lattice
        In the units of ``frame``.
    frame : RestFrame
    points : (n, 3) ndarray
        Contact points at rest [scene unit].
    owner : (n,) ndarray of int
        Bone that each is attached to, -1 where free.
    held : (h,) ndarray of int
        Contact points by which the bones hold the muscle.
    count : int
        The first contact points so many are centres.
    free : (f,) ndarray of int
        Centres that are free to move.
    regions, iterations, contacts, memory : int
    area : float
        Of the surface that a contact point stands for [scene unit squared].
    """

    def __init__(
        self,
        lattice: Lattice,
        frame: Any,
        points: Floats,
        owner: Any,
        held: Any,
        *,
        count: int,
        free: Any,
        regions: Any,
        iterations: Any,
        contacts: Any,
        memory: int,
        area: float,
    ) -> None:
        self.rest = frame.points(lattice.rest)
        self.points, self.owner, self.held = points, owner, held
        self.count, self.free, self._carried, self._followed = count, free, None, None
        self.lattice, self.frame = lattice, frame
        self.iterations, self.batch, self.memory = LEAST_ROUNDS * iterations, contacts, memory
        self.scale, self.side = diameter(points), float(np.prod(lattice.spacing)) ** (1 / 3) * frame.size
        found = lattice.embed((points - frame.origin) @ frame.axes.T / frame.size)
        self.columns, self.shares = found.columns, found.shares
        self.slopes_at = found.slopes @ frame.axes / frame.size
        self.quad_columns = lattice.quadrature.columns
        self.slopes = np.ascontiguousarray(lattice.quadrature.slopes @ frame.axes / frame.size)
        self.weights = lattice.weights * frame.size**3
        self.quad_points = frame.points(lattice.points)
        count = len(self.weights)
        one = np.ones(count)
        self.fibres = Fibres(np.tile([1.0, 0.0, 0.0], (count, 1)), 0.0 * one, 0.0 * one, one, one, one)
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self.f, self.target = np.empty((2, count, 3, 3))
        self._number_regions(lattice.regions(regions))
        self._assemble(lattice)
        self.obstacles = Obstacles(self, area)
        self.y, self.pressure = self.rest.copy(), np.zeros(len(self.rest_volumes))
        self.shown = self.y
        self.forces = np.zeros((len(points), 1))
        self.anchor, self.history = points[held], [0.0]
        self.trend, self.begun = None, None

    def _assemble(self, lattice: Lattice) -> None:
        """Matrix of the energy with frozen targets, springs and all, its inverse, and the bones' weights."""
        size, rows = len(self.rest), np.arange(len(self.weights))[:, None]
        matrix = GHOST * self.side * lattice.second_differences()
        for axis in range(3):
            full = np.zeros((len(self.weights), size))
            np.add.at(full, (rows, self.quad_columns), self.slopes[:, :, axis])
            matrix += (full * self.weights[:, None]).T @ full
        hangs = np.zeros((size, len(self.held)))
        np.add.at(hangs, (self.columns[self.held].T, np.arange(len(self.held))), self.shares[self.held].T)
        self.spring = HOLD * self.side * hangs
        self.without_springs, self.without_fibres = matrix, matrix + self.spring @ hangs.T
        self.matrix = self.without_fibres
        self._invert()
        own = self.owner[self.held]
        self.bones = sorted(set(own.tolist()))
        weights = np.stack([self.inverse @ self.spring[:, own == bone].sum(axis=1) for bone in self.bones], 1)
        self.motion_weights = weights / weights.sum(axis=1, keepdims=True)

    def _invert(self) -> None:
        inverse = np.linalg.inv(self.matrix)
        self.inverse = np.ascontiguousarray(0.5 * (inverse + inverse.T))

    def rise(self) -> Any:
        """Directions at the quadrature points in which the muscle runs from its first bone to its last, (Q, 3)."""
        height = self.motion_weights @ np.arange(len(self.bones))
        slope = np.einsum("qk,qka->qa", height[self.quad_columns], self.slopes)
        return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)

    def flux(self) -> Floats:
        """Gradient (Q, 3) of what flows, a unit in all, from the first bone's held points to the others'."""
        first = self.owner[self.held] == self.bones[0]
        source = np.where(first, -1.0 / max(first.sum(), 1), 1.0 / max((~first).sum(), 1))
        height = np.linalg.lstsq(self.without_springs, self.spring @ source / (HOLD * self.side), rcond=None)[
            0
        ]
        return np.einsum("qk,qka->qa", height[self.quad_columns], self.slopes)

    def reinforce(self, fibre: Floats, ratio: float) -> None:
        """Make the solid stiffer along unit directions (Q, 3), by a ratio of Young's moduli."""
        passive = np.full(len(self.weights), 1.5 * (ratio - 1.0))
        self.take_fibres(self.fibres._replace(direction=np.ascontiguousarray(fibre), passive=passive))

    def take_fibres(self, fibres: Fibres) -> None:
        """Take springs along the fibres; their stiffness becomes part of the matrix."""
        self.fibres, stiff = fibres, fibres.passive + fibres.active
        along = np.zeros((len(self.weights), len(self.rest)))
        slopes = np.einsum("qka,qa->qk", self.slopes, fibres.direction)
        np.add.at(along, (np.arange(len(self.weights))[:, None], self.quad_columns), slopes)
        self.matrix = self.without_fibres + (along * (stiff * self.weights)[:, None]).T @ along
        self._invert()

    def hardly_move(self) -> Any:
        """Contact points that a force hardly moves, as what holds them is held."""
        mobility = np.empty(len(self.points))
        mobility_loop(self.columns, self.shares, self.inverse, mobility)
        return mobility < MOBILE * np.median(mobility[self.owner < 0])

    def _number_regions(self, region: Integers) -> None:
        self.region = region
        count = int(region.max()) + 1
        size = len(self.rest)
        pair = region[:, None] * size + self.quad_columns
        known, slot = np.unique(pair, return_inverse=True)
        self.slot = slot.reshape(pair.shape).astype(np.int64)
        self.touched = (known % size).astype(np.int64)
        self.start = np.searchsorted(known // size, np.arange(count + 1)).astype(np.int64)
        self.gradient = np.empty((len(known), 3))
        self.volumes = np.empty(count)
        self.rest_volumes = np.bincount(region, self.weights, minlength=count)

    # --- what the muscle asks -------------------------------------------------------------------------------

    def carry(self, centres: Floats | None = None) -> Any:
        """Contact points now, (n, 3); they go with the nodes, whatever the centres are."""
        if self._carried is None or self._carried[0] is not self.shown:
            self._carried = self.shown, self.carry_from(self.shown)
        return self._carried[1].copy()

    def carry_from(self, y: Floats) -> Floats:
        """Contact points (n, 3) that nodes at y (N, 3) carry."""
        out = np.empty_like(self.points)
        carry_loop(y, self.columns, self.shares, out)
        return out

    def follow(self, points: Floats) -> Floats:
        """Where the nodes carry points (n, 3) of the muscle at rest; asked for the same ones again and again."""
        if self._followed is None or self._followed[0] is not points:
            found = self.lattice.embed((points - self.frame.origin) @ self.frame.axes.T / self.frame.size)
            self._followed = points, found.columns, found.shares
        out = np.empty_like(points)
        carry_loop(self.shown, *self._followed[1:], out)
        return out

    def centres(self, before: Floats) -> Floats:
        """Centres (K, 3) where the nodes carry the free ones; the held ones stay as they are."""
        out, free = before.copy(), np.empty((len(self.free), 3))
        carry_loop(self.shown, self.columns[self.free], self.shares[self.free], free)
        out[self.free] = free
        return out

    def deformation(self) -> Any:
        """Deformation gradient (n, 3, 3) at the contact points that are centres."""
        at = slice(0, self.count)
        return np.einsum("nka,nkb->nab", self.shown[self.columns[at]], self.slopes_at[at])

    def move(self, motions: Any, poses: Any) -> None:
        """Nodes take their share of the bones' motions (b, 4, 4); held points go with the poses (by bone)."""
        self.y = blended_motion(self.y, self.motion_weights, motions)
        anchor = self._ends(poses)
        step = (anchor - self.anchor).ravel()
        self.anchor, self.begun = anchor, (step, self.y, self.pressure.copy())
        if self.trend is not None:
            # Where the motion goes on as before, so does what the muscle made of it.
            last, correction, pressed = self.trend
            share = float(step @ last) / max(float(last @ last), 1e-30)
            share = float(np.clip(share, -MOST_TREND, MOST_TREND))
            self.y = self.y + share * correction
            self.pressure = self.pressure + share * pressed
        self.shown = self.y

    def _ends(self, poses: Any) -> Floats:
        """Held points (h, 3) where the bones' poses take them."""
        own, ends = self.owner[self.held], np.empty_like(self.anchor)
        for bone in self.bones:
            here, pose = own == bone, poses[bone]
            ends[here] = self.points[self.held[here]] @ pose[:3, :3].T + pose[:3, 3]
        return ends

    def turn(self, which: Any, transform: Floats) -> None:
        """Nodes go along with a rigid transform as far as they carry free points of the mask ``which``."""
        hit, every = np.zeros((2, len(self.y)))
        marked = np.asarray(which) & (self.owner < 0)
        np.add.at(hit, self.columns[marked], self.shares[marked])
        np.add.at(every, self.columns, self.shares)
        share = (hit / np.maximum(every, 1e-12))[:, None]
        self.y = self.y + share * (self.y @ transform[:3, :3].T + transform[:3, 3] - self.y)
        self.shown = self.y

    def transform(self, motion: Floats, centres: Floats | None = None) -> None:
        """Go along with a rigid motion (4, 4)."""
        turn = motion[:3, :3].T
        self.y, self.shown, self.anchor = (
            at @ turn + motion[:3, 3] for at in (self.y, self.shown, self.anchor)
        )
        self.quaternion[:] = turned_quaternions(self.quaternion, motion[:3, :3])
        self.begun = None
        if self.trend is not None:
            last, correction, pressed = self.trend
            self.trend = (last.reshape(-1, 3) @ turn).ravel(), correction @ turn, pressed

    def snapshot(self) -> Any:
        """State that ``restore`` brings back."""
        return (
            self.y.copy(),
            self.shown.copy(),
            self.quaternion.copy(),
            self.pressure.copy(),
            self.forces.copy(),
            self.anchor.copy(),
            self.trend,
        )

    def restore(self, state: Any) -> None:
        """Return to an earlier ``snapshot``."""
        self.y, self.shown, self.quaternion, self.pressure, self.forces, self.anchor = (
            part.copy() for part in state[:6]
        )
        self.trend, self.begun = state[6], None

    def solve(self, centres: Any, contacts: Any) -> Any:
        """Return the settled centres, (K, 3)."""
        self.settle(contacts)
        return self.centres(centres)

    def settle(self, contacts: Any) -> None:
        """Bring the nodes to balance under pressures and contacts."""
        state = np.concatenate([self.y.ravel(), self.pressure])
        size = self.y.size
        mixer = Anderson(self.memory, size)
        self.history = []
        self.localise()
        self._respond()
        near, self.pull = None, self.spring @ self.anchor
        for step in range(self.iterations):
            if step:
                self.localise()
            if near is None or np.abs(self.y - near.y).max() > 0.4 * near.reach:
                near = self.obstacles.near(contacts, near)
            new, pressure = self._iterate(near)
            moved = float(np.sqrt(((new - self.y) ** 2).sum(axis=1).max()))
            self.history.append(moved)
            image = np.concatenate([new.ravel(), pressure])
            last = step + 1 == self.iterations or moved < SETTLED * self.scale
            state = image if last else mixer.mix(state, image)
            self.y, self.pressure = state[:size].reshape(-1, 3).copy(), state[size:].copy()
            if last:
                break
        self.forces[:] = 0.0
        self.forces[near.which] = near.forces
        self.shown = self.obstacles.lifted(near)
        if self.begun is not None:
            motion, start, pressure = self.begun
            if np.abs(motion).max() > SETTLED * self.scale:
                self.trend = motion, self.y - start, self.pressure - pressure
            self.begun = None

    def energy(self) -> float:
        """Elastic energy over 2 μ at the present nodes."""
        self.localise()
        gap = self.f - self.target
        total = 0.5 * float(self.weights @ (gap**2).sum(axis=(1, 2)))
        given = self.fibres
        along = np.linalg.norm(np.einsum("qab,qb->qa", self.f, given.direction), axis=1)
        slack = along - np.clip(along, given.lower, given.upper)
        springs = given.passive * slack**2 + given.active * (along - given.content) ** 2
        total += 0.5 * float(self.weights @ springs)
        return total

    def localise(self) -> None:
        """Deformation gradients, targets, volumes and forces of the present nodes."""
        turn_loop(self.y, self.quad_columns, self.slopes, self.quaternion, self.f, self.target)
        self.right = np.empty_like(self.y)
        stress_loop(
            self.f, self.target, self.fibres, self.weights, self.quad_columns, self.slopes, self.region,
            self.slot, self.right, self.gradient, self.volumes,
        )  # fmt: skip

    def _respond(self) -> None:
        """How the nodes answer to pressures, at the present shape: the metric of this solve's corrections."""
        count = len(self.pressure)
        response, gram = np.empty((count, 3, len(self.y))), np.empty((count, count))
        respond_loop(self.start, self.touched, self.gradient, self.inverse, response, gram)
        gram[np.diag_indices(count)] *= 1.0 + 1e-9
        self.factor = np.linalg.cholesky(gram)
        white = solve_triangular(self.factor, response.reshape(count, -1), lower=True, check_finite=False)
        self.response = np.ascontiguousarray(white.reshape(response.shape))

    def _iterate(self, near: Near) -> tuple[Floats, Floats]:
        right = self.right
        press_loop(self.pressure, self.start, self.touched, self.gradient, right)
        free = self.inverse @ (right + self.pull)
        swollen = np.empty(len(self.pressure))
        swell_loop(free - self.y, self.start, self.touched, self.gradient, swollen)
        excess = self.volumes - self.rest_volumes + swollen
        change = -solve_triangular(self.factor, excess, lower=True, check_finite=False)
        step = free + np.tensordot(change, self.response, 1).T
        push, taken = self.obstacles.push(near, self.y, step)
        change -= taken
        pressure = self.pressure + solve_triangular(
            self.factor, change, lower=True, trans=1, check_finite=False
        )
        return step + push, pressure
