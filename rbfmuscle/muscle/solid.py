"""The elastic solid that carries the centres of an RBF muscle.

With y the nodes of a `Lattice` and F = Σ y_k ∇N_k the deformation gradient at its quadrature points
q, the nodes minimise

    E(y) = μ Σ_q w_q min over R, t of (|F_q - R D(t)|² + c (|F_q a| - t)² - 2 τ (1 - t)), D(t) = t
    aaᵀ + t^(-1/2) (I - aaᵀ),    1 / slack <= t <= 1,    τ = min(TONE (1 - d / d₀), MOST_TONE) >= 0,

subject to the volumes of the regions r of the lattice, V_r(y) = Σ_{q in r} w_q det F_q, and to the
contacts. R is a rotation, a the fibre direction. Between 1 / slack and 1 a fibre shortens without
resistance while the section thickens, and bears a small tension, 2 μ τ, which keeps a slack muscle
straight. It grows as the muscle's ends approach, from their distance d₀ at rest to d, and depends
on the bones alone: a tension that grew with the fibres' shortening would be a negative stiffness. c
= 3/2 (fibre_ratio - 1) stiffens fibres that are longer or shorter than the band. For small
stretches beyond the slack band and more and more nodes this is the incompressible solid of shear
modulus μ, Young's modulus 3 μ across and 3 μ · fibre_ratio along the fibres.

Each iteration minimises over R and t at each point, then over y with the matrix of E for these,
which never changes (Bouaziz et al. 2014, "Projective dynamics"), and corrects the regions' volumes
and the contacts in its metric. The pressures are kept from iteration to iteration, so that the
fixed point of the iteration is the equilibrium.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.geometry.rest_frame import RestFrame, diameter
from rbfmuscle.geometry.rotations import turned_quaternions
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.muscle.carrier import Carrier
from rbfmuscle.muscle.inversion import STIFFNESS
from rbfmuscle.muscle.solid_contact import NearPoints, SolidContact
from rbfmuscle.muscle.solid_loops import Fibres, mobility_loop, normals_loop, respond_loop
from rbfmuscle.muscle.solid_step import Anderson, global_loop, local_loop, pressure_loop
from rbfmuscle.simulation.contact import BoneContacts

MEMORY = 5  # steps that Anderson acceleration combines
# Tension of slack fibres over 2 μ: for a muscle whose ends are at 0.82 of their distance at rest,
# and for shorter ones, it is 0.03 of that at full activation.
TONE, MOST_TONE = 2.5, 0.45
HOLD = 25.0  # stiffness of the spring at a held point, relative to that of a cell
# stiffness of second differences, relative to a cell: for nodes that hold hardly any material
GHOST = 1e-3
# Bulk modulus and greatest pressure of a region, over 2 μ: a muscle that bones squeeze yields in
# volume. The surface is drawn at the volume at rest in any case.
BULK, MOST_PRESSURE = 50.0, 3.0
MOST_TREND = (
    1.5  # greatest multiple of the last sub-step's correction that the next one starts with
)
# points that move by less than this fraction of the median for a unit force count as attached
MOBILE = 0.02
SETTLED = 2e-5  # of the size: an iteration that moves no node farther was the last one
SETTLED_BESIDE = 1e-4  # the same beside neighbours, whose planes are not known better
# The same where the bones stand still and only the activation changes, and how many times the
# iterations it may take.
SETTLED_STILL, ROUNDS_STILL = 1e-7, 10
LONGEST = 0.2  # of the size: a longer step is shortened to it
# Over 2 μ: at higher pressures det F bends the energy more than the iteration's matrix does, and
# steps are shortened.
CALM_PRESSURE = 0.5
GROWTH = 2.0  # a motion beyond this multiple of the least so far restarts the acceleration
NODES_PER_REGION = 8


class SolidState(NamedTuple):
    """What an `EmbeddedSolid` carries from one sub-step to the next."""

    nodes: Floats
    shown: Floats
    quaternion: Floats
    stretch: Floats
    pressure: Floats
    forces: Floats
    anchor: Floats
    trend: tuple[Floats, Floats, Floats] | None


class EmbeddedSolid:
    """An elastic solid on a lattice, with volume and contact solved inside the iteration.

    Contact points (n, 3) at rest [scene unit] are ``count`` centres, then samples of the surface,
    each of which stands for an ``area``; ``owner`` (n,) is the bone that each is attached to, -1
    where it is free. The bones hold the muscle by the points ``held``; ``free`` centres move. Nodes
    ``y`` (N, 3) are in equilibrium with contacts that yield a little, ``shown`` are the same nodes
    with what is left in a bone moved out. ``history`` holds the greatest motion of a node in each
    iteration of the last solve.
    """

    def __init__(
        self,
        lattice: Lattice,
        frame: RestFrame,
        points: Floats,
        owner: Integers,
        held: Integers,
        *,
        free: Integers,
        count: int,
        area: float,
        iterations: int,
        bones: Mapping[str, tuple[Floats, Integers]],
    ) -> None:
        self.lattice = lattice
        self.frame = frame
        self.iterations = iterations
        self.points = points
        self.owner = owner
        self.held = held
        self.free = free
        self.count = count
        self.scale, self.side = (
            diameter(points),
            float(np.prod(lattice.spacing)) ** (1 / 3) * frame.size,
        )
        self.rest = frame.points(lattice.rest)
        self.columns, self.shares, self.slopes_at = self._embed(points)
        self.carrier = Carrier(self.columns, self.shares)
        self._free_carrier = Carrier(self.columns[free], self.shares[free])
        self.quad_columns = lattice.quadrature.indices
        self.slopes = np.ascontiguousarray(lattice.quadrature.slopes @ frame.axes / frame.size)
        self.weights = lattice.weights * frame.size**3
        self.quad_points = frame.points(lattice.points)
        one = np.ones(len(self.weights))
        axis = np.tile([1.0, 0.0, 0.0], (len(one), 1))
        self.fibres = Fibres(axis, 0.0 * one, 0.0 * one, one, one, one)
        self.quaternion, self.stretch = np.tile([1.0, 0.0, 0.0, 0.0], (len(one), 1)), one.copy()
        self.f, self.target = np.empty((2, len(one), 3, 3))
        self.stiffened = np.zeros(len(one), dtype=bool)
        self._number_regions(lattice.regions(max(1, len(lattice.rest) // NODES_PER_REGION)))
        self._assemble(lattice)
        self.contact = SolidContact(self, area, bones)
        self.y, self.pressure = self.rest.copy(), np.zeros(len(self.rest_volumes))
        self.right, self.squeezed = np.empty_like(self.y), 0.0
        self.shown, self.forces = self.y, np.zeros((len(points), 1))
        self._ends, self._end_distance = self._farthest_ends()
        self._take_anchor(points[held])
        self.history, self.still = [0.0], False
        self.trend: tuple[Floats, Floats, Floats] | None = None
        self.begun: tuple[Floats, Floats, Floats] | None = None
        self._followed: tuple[Floats, Carrier] | None = None

    def _embed(self, points: Floats) -> tuple[Integers, Floats, Floats]:
        """Nodes (n, 27), shape functions (n, 27) and their slopes (n, 27, 3) at points of the
        muscle at rest.
        """
        frame = self.frame
        found = self.lattice.embed((points - frame.origin) @ frame.axes.T / frame.size)
        return found.indices, found.weights, found.slopes @ frame.axes / frame.size

    def _assemble(self, lattice: Lattice) -> None:
        """Matrix of the energy for frozen targets, with its springs; its inverse; the weights of
        the bones.
        """
        size = len(self.rest)
        matrix = GHOST * self.side * lattice.second_differences() + self._stiffness(
            np.arange(len(self.weights))
        )
        hangs = np.zeros((size, len(self.held)))
        np.add.at(
            hangs, (self.columns[self.held].T, np.arange(len(self.held))), self.shares[self.held].T
        )
        self.spring = HOLD * self.side * hangs
        self.without_springs, self.without_fibres = matrix, matrix + self.spring @ hangs.T
        self.matrix = self.without_fibres
        self._invert()
        own = self.owner[self.held]
        self.bones = sorted(set(own.tolist()))
        weights = np.stack(
            [self.inverse @ self.spring[:, own == bone].sum(axis=1) for bone in self.bones], 1
        )
        self.motion_weights = weights / weights.sum(axis=1, keepdims=True)

    def _stiffness(self, which: Integers) -> Floats:
        """Matrix (N, N) of Σ w |F|² over some quadrature points."""
        found, rows = np.zeros((len(self.rest), len(self.rest))), np.arange(len(which))[:, None]
        for axis in range(3):
            full = np.zeros((len(which), len(self.rest)))
            np.add.at(full, (rows, self.quad_columns[which]), self.slopes[which, :, axis])
            found += (full * self.weights[which, None]).T @ full
        return found

    def _invert(self) -> None:
        matrix, stiff = self.matrix, np.flatnonzero(self.stiffened)
        inverse = np.linalg.inv(
            matrix + STIFFNESS * self._stiffness(stiff) if len(stiff) else matrix
        )
        self.inverse = np.ascontiguousarray(0.5 * (inverse + inverse.T))

    def _number_regions(self, region: Integers) -> None:
        self.region, size = region, len(self.rest)
        count = int(region.max()) + 1
        pair = region[:, None] * size + self.quad_columns
        known, slot = np.unique(pair, return_inverse=True)
        self.slot = slot.reshape(pair.shape).astype(np.int64)
        self.touched = (known % size).astype(np.int64)
        self.start = np.searchsorted(known // size, np.arange(count + 1)).astype(np.int64)
        self.gradient = np.empty((len(known), 3))
        self.volumes = np.empty(count)
        self.rest_volumes = np.bincount(region, self.weights, minlength=count)

    # --- fibres

    def take_fibres(self, fibres: Fibres) -> None:
        """Take springs along the fibres; their stiffness becomes part of the matrix."""
        self.fibres, stiff = fibres, fibres.passive + fibres.active
        self.matrix = self.without_fibres
        if stiff.any():
            along = np.zeros((len(self.weights), len(self.rest)))
            slopes = np.einsum("qka,qa->qk", self.slopes, fibres.direction)
            np.add.at(along, (np.arange(len(self.weights))[:, None], self.quad_columns), slopes)
            self.matrix = self.without_fibres + (along * (stiff * self.weights)[:, None]).T @ along
        self._invert()

    def _farthest_ends(self) -> tuple[tuple[Integers, Integers] | None, float]:
        """Held points of the two bones that hold the muscle farthest apart, and their distance at
        rest.
        """
        held, own = self.points[self.held], self.owner[self.held]
        ends, most = None, 0.0
        for first, second in combinations([np.flatnonzero(own == bone) for bone in self.bones], 2):
            away = float(np.linalg.norm(held[first].mean(axis=0) - held[second].mean(axis=0)))
            if away > most:
                ends, most = (first, second), away
        return ends, most

    def _take_anchor(self, anchor: Floats) -> None:
        """Take positions (h, 3) of the held points, and the tension of slack fibres that goes with
        them.
        """
        self.anchor, self.tension = anchor, 0.0
        if self._ends is not None:
            first, second = (anchor[end].mean(axis=0) for end in self._ends)
            approach = 1.0 - float(np.linalg.norm(first - second)) / self._end_distance
            self.tension = min(max(0.0, TONE * approach), MOST_TONE)

    def mobility(self) -> Floats:
        """Motion (n,) of each contact point for a unit force at it."""
        out = np.empty(len(self.points))
        mobility_loop(self.columns, self.shares, self.inverse, out)
        return out

    def attach_immobile(self) -> None:
        """Count free contact points that a force hardly moves to the bone of the nearest attached
        one.
        """
        mobility = self.mobility()
        free, fixed = self.owner < 0, np.flatnonzero(self.owner >= 0)
        stuck = np.flatnonzero(free & (mobility < MOBILE * np.median(mobility[free])))
        for point in stuck:
            away = ((self.points[fixed] - self.points[point]) ** 2).sum(axis=1)
            self.owner[point] = self.owner[fixed[np.argmin(away)]]

    # --- what the nodes carry
    # ---------------------------------------------------------------------------------

    def carry(self) -> Floats:
        """Contact points now, (n, 3)."""
        return self.carrier.carry(self.shown)

    def follow(self, points: Floats) -> Floats:
        """Present positions of points (n, 3) of the muscle at rest; the embedding of the last array
        is kept.
        """
        if self._followed is None or self._followed[0] is not points:
            self._followed = points, Carrier(*self._embed(points)[:2])
        return self._followed[1].carry(self.shown)

    def centres(self, before: Floats) -> Floats:
        """Centres (K, 3): the free ones where the nodes carry them, the held ones as in
        ``before``.
        """
        out = before.copy()
        out[self.free] = self._free_carrier.carry(self.shown)
        return out

    def turned_normals(self, normals: Floats) -> Floats:
        """Unit normals (K, 3) of the surface at the centres, from those at rest."""
        out = np.empty_like(normals)
        normals_loop(self.shown, self.columns, self.slopes_at, normals, out)
        return out

    # --- motion

    def move(self, motions: Floats, poses: Sequence[Floats]) -> None:
        """Predict the nodes.

        They take a weighted mean of the motions of the bones (b, 4, 4); held points follow the
        ``poses`` (4, 4) from rest, a list by bone. Where the motion goes on as before, so does the
        last correction. What is shown has no part in that: neighbours add a mean of several
        corrections (`NeighbourSurface`).
        """
        self.y = blended_motion(self.y, self.motion_weights, motions)
        anchor, own = np.empty_like(self.anchor), self.owner[self.held]
        for bone in self.bones:
            here, pose = own == bone, poses[bone]
            anchor[here] = self.points[self.held[here]] @ pose[:3, :3].T + pose[:3, 3]
        step = (anchor - self.anchor).ravel()
        self.still = bool(np.abs(step).max() <= SETTLED_STILL * self.scale)
        self._take_anchor(anchor)
        self.begun = step, self.y, self.pressure.copy()
        self.shown = self.y
        if self.trend is not None:
            last, correction, pressed = self.trend
            share = float(step @ last) / max(float(last @ last), 1e-30)
            share = float(np.clip(share, -MOST_TREND, MOST_TREND))
            self.y = self.y + share * correction
            self.pressure = self.pressure + share * pressed

    def turn(self, which: Integers, transform: Floats) -> None:
        """Move the nodes by a rigid transform as far as they carry free contact points of the mask
        ``which``.
        """
        hit, every = np.zeros((2, len(self.y)))
        marked = np.asarray(which) & (self.owner < 0)
        np.add.at(hit, self.columns[marked], self.shares[marked])
        np.add.at(every, self.columns, self.shares)
        share = (hit / np.maximum(every, 1e-12))[:, None]
        self.y = self.y + share * (self.y @ transform[:3, :3].T + transform[:3, 3] - self.y)
        self.shown = self.y

    def transform(self, motion: Floats) -> None:
        """Apply a rigid motion (4, 4) to the whole solid."""
        turn, shift = motion[:3, :3].T, motion[:3, 3]
        self.y, self.shown, self.anchor = (
            at @ turn + shift for at in (self.y, self.shown, self.anchor)
        )
        self.quaternion = turned_quaternions(self.quaternion, motion[:3, :3])
        self.begun = None
        if self.trend is not None:
            last, correction, pressed = self.trend
            self.trend = (last.reshape(-1, 3) @ turn).ravel(), correction @ turn, pressed

    def snapshot(self) -> SolidState:
        """State that ``restore`` brings back."""
        return SolidState(
            self.y.copy(),
            self.shown.copy(),
            self.quaternion.copy(),
            self.stretch.copy(),
            self.pressure.copy(),
            self.forces.copy(),
            self.anchor.copy(),
            self.trend,
        )

    def restore(self, state: SolidState) -> None:
        """Return to an earlier ``snapshot``."""
        self.y, self.shown, self.quaternion, self.stretch, self.pressure, self.forces = (
            part.copy() for part in state[:6]
        )
        self._take_anchor(state.anchor.copy())
        self.trend, self.begun = state.trend, None

    # --- equilibrium
    # ------------------------------------------------------------------------------------------

    def settle(self, contacts: BoneContacts) -> None:
        """Bring the nodes to equilibrium under pressures and contacts; FloatingPointError if it
        diverges.
        """
        self.history, self._pull = [], self.spring @ self.anchor
        self._begin()
        near = self.contact.near(contacts, None)
        rounds, settled = 1, SETTLED_BESIDE if contacts.neighbours else SETTLED
        if self.still:
            rounds, settled = ROUNDS_STILL, SETTLED_STILL
        size = self.y.size
        mixer, least = Anderson(MEMORY, size + len(self.pressure), size), np.inf
        while True:
            new, pressure, moved = self._iterate(near)
            if not np.isfinite(moved):
                raise FloatingPointError("the solid does not settle")
            self.history.append(moved)
            if moved > GROWTH * least:
                mixer.restart()
                least = np.inf
            least = min(least, moved)
            if moved > LONGEST * self.scale:
                part = LONGEST * self.scale / moved
                new = self.y + part * (new - self.y)
                pressure = self.pressure + part * (pressure - self.pressure)
                mixer.restart()
            if moved < settled * self.scale or len(self.history) == self.iterations * rounds:
                break
            state, image = (
                np.concatenate((y.ravel(), p))
                for y, p in ((self.y, self.pressure), (new, pressure))
            )
            mixed = mixer.mix(state, image)
            self.y, self.pressure = mixed[:size].reshape(-1, 3), mixed[size:]
            if self.localise():
                self._invert()
                self._find_responses()
                mixer.restart()
            if np.abs(self.y - near.y).max() > 0.4 * near.reach:
                near = self.contact.near(contacts, near)
        self.y, self.pressure = new, pressure
        self.forces[:] = 0.0
        self.forces[near.which] = near.forces
        self.shown = self.contact.lifted(near, self.y)
        self._note_trend()

    def make_room(self, contacts: BoneContacts) -> None:
        """Show the settled nodes moved out of neighbours as well, by their planes."""
        self.shown = self.contact.parted(contacts)

    def _begin(self) -> None:
        """Forces and responses for the nodes that a solve starts from, with the points that are
        squeezed there.
        """
        before = bool(self.stiffened.any())
        self.stiffened[:] = False
        if self.localise() or before:
            self._invert()
        self._find_responses()

    def _note_trend(self) -> None:
        if self.begun is not None:
            motion, start, pressure = self.begun
            if np.abs(motion).max() > SETTLED * self.scale:
                self.trend = motion, self.y - start, self.pressure - pressure
            self.begun = None

    def energy(self) -> float:
        """Elastic energy over 2 μ at the present nodes, springs at held points apart."""
        self.localise()
        given, gap = self.fibres, self.f - self.target
        along = np.linalg.norm(np.einsum("qab,qb->qa", self.f, given.direction), axis=1)
        beyond = along - np.clip(along, given.lower, given.upper)
        springs = given.passive * beyond**2 + given.active * (along - given.content) ** 2
        tone = 2.0 * self.tension * (1.0 - self.stretch)
        return (
            0.5 * float(self.weights @ ((gap**2).sum(axis=(1, 2)) + springs - tone)) + self.squeezed
        )

    def localise(self) -> bool:
        """Find deformation gradients, targets, volumes and forces for the present nodes.

        Returns whether points are squeezed that the matrix does not know of yet.
        """
        cells = self.quad_columns, self.slopes, self.weights, self.region, self.slot
        state = self.quaternion, self.stretch
        joined, self.squeezed = local_loop(
            self.y,
            cells,
            self.fibres,
            self.tension,
            self.stiffened,
            state,
            self.f,
            self.target,
            self.right,
            self.gradient,
            self.volumes,
        )
        return bool(joined)

    def _find_responses(self) -> None:
        """Motion of the nodes for a unit pressure of each region: the metric of this solve's
        corrections.
        """
        count = len(self.pressure)
        self.response, self.factor = np.empty((count, 3, len(self.y))), np.zeros((count, count))
        regions = self.start, self.touched, self.gradient
        if not respond_loop(
            regions, self.inverse, self.rest_volumes / BULK, self.response, self.factor
        ):
            raise np.linalg.LinAlgError("the volumes of the solid's regions depend on each other")

    def _iterate(self, near: NearPoints) -> tuple[Floats, Floats, float]:
        """One global step with volumes and contacts: nodes (N, 3), pressures (M,), greatest motion
        of a node.
        """
        step = np.empty_like(self.y)
        change = np.empty(len(self.pressure))
        pressure = self.pressure.copy()
        regions = self.start, self.touched, self.gradient, self.volumes, self.rest_volumes
        part = global_loop(
            self.y,
            self.right + self._pull,
            self.inverse,
            regions,
            pressure,
            (BULK, CALM_PRESSURE),
            self.response,
            self.factor,
            step,
            change,
        )
        push, taken = self.contact.push(near, self.y, step, part)
        moved = pressure_loop(
            self.y, step, push, change, taken, self.factor, part, MOST_PRESSURE, pressure
        )
        return step, pressure, float(moved)
