"""Bringing solids to equilibrium under elasticity, pressures and contacts.

An iteration finds rotations and stretches (the local step, `kernels.py`), then the nodes for these
with a matrix that never changes and pressures that keep the volumes (the global step), and contact
forces in the same metric (`contact.py`). Pressures are kept from iteration to iteration, so that
the fixed point of the iteration is the equilibrium; Anderson acceleration gets there sooner.

With g_r = ∂V_r/∂y the nodes are A⁻¹ (right side + Σ_r p_r g_r). What the volumes then lack is
corrected by pressures q in the metric of A: the motion for a unit pressure of region r is A⁻¹ g_r,
and the volumes that it adds are G_rs = g_r · A⁻¹ g_s. With the volumes that pressures compress,
K_rr = V_r / BULK, the correction solves (G + K) q = lacking. G + K = L Lᵀ; all of this is in the
whitened pressures Lᵀ q, for which the responses are U = L⁻¹ A⁻¹ g and the matrix is the identity.

A surface of points on a bone of flat facets has many equilibria, because each point has to be
lifted over each edge. A muscle on a bone has not. So the solid settles with contacts that yield a
little, on bones whose facets are rounded (`rbfmuscle/bones/rounded.py`): one shape for each pose.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.interpolation import Embedding, carry
from rbfmuscle.simulation.touching import (
    TOLERANCE,
    Contacts,
    Wanted,
    find_forces,
    meet,
)
from rbfmuscle.solid.contact import Mobility, Obstacles, fill_mobilities
from rbfmuscle.solid.kernels import (
    ACTIVE,
    DETERMINANT,
    FIBRE,
    LOWER,
    PASSIVE,
    POINTS,
    ROTATION,
    ROWS,
    STRETCH,
    UPPER,
    WEIGHT,
    add_rows,
    carry_steps,
    local_step,
    pull_apart,
    region_volumes,
)
from rbfmuscle.solid.material import Material, ask_material
from rbfmuscle.solid.model import SolidModel, Stiffness
from rbfmuscle.solid.state import Metric, SolidState, rest_state, tension

# All lengths are relative to the muscle's size.
# A solve ends where its estimated error is below this: the distance of material from where further
# iterations would take it.
ERROR = 2e-5
LONGEST = 0.2  # a longer step is shortened to it
GROWTH = 2.0  # a motion beyond this multiple of the least so far restarts the acceleration
MEMORY = 20  # steps that Anderson acceleration combines
# Iterations in which the motion has not halved, after which steps are plain until it has: where a
# muscle slips over an edge of a bone, accelerated ones go round in circles.
STALLED = 12
# Of the estimated error: the last steps hide a slow mode that they hardly move. Measured without
# it: up to 1.07 times the estimate from the equilibrium, on the phantom.
SAFETY = 1.4
NEAR = 0.015  # contact points nearer to an obstacle take part in a solve
STALE = 0.4  # share of NEAR by which a node moves before they are chosen again
MARGIN = 0.003  # obstacles are looked for beyond where a point goes by this
YIELDING = 1e-4  # how far a contact yields under a pressure of 2 μ
LIFTS = 3  # linear steps, at most, that lift what is left in a bone out of it
# Bulk modulus and greatest pressure of a region, over 2 μ: a muscle that bones squeeze yields in
# volume, by a share of pressure / bulk modulus. With 50, Poisson's ratio 0.495, muscles of the leg
# lost up to 4.5 % in a squat; with 200, 0.4988, they lose 1.8 % in as many iterations. The surface
# is drawn at the volume at rest in any case.
BULK, MOST_PRESSURE = 200.0, 3.0
# Over 2 μ: at higher pressures det F bends the energy more than the iteration's matrix does, and
# steps are shortened.
CALM_PRESSURE = 0.5
# Random motion of nodes at rest, of the size, and iterations, that tell how slowly a solid settles.
SHAKEN, SHAKES = 1e-5, 120
# The metric is found anew where the gradients of the volumes have changed by this share.
TURNED = 0.15
# Within a solve, where nodes have moved by this, of the size.
TURNED_WAY = 0.03
# A quadrature point whose volume det F falls below `LEAST` of that at rest is pulled to the nearest
# deformation that has it: the energy gains μ Σ_q w_q `STIFFNESS` min over G of |F_q - G|² with
# det G >= LEAST. Its matrix, as for the other terms, is constant, but has only the points that need
# it.
LEAST, STIFFNESS = 0.5, 100.0


ALONE = np.ones(1, dtype=np.bool_)  # a group of one body, which acts


class Report(NamedTuple):
    """How a solve ended.

    ``error`` is the estimated distance of material from the equilibrium, of the muscle's size;
    ``volume_error`` the greatest relative error of a region's volume. ``caps`` says what ended at
    its greatest number: iterations, the last contact forces, a contact at its greatest force, a
    region at its greatest pressure.
    """

    iterations: int
    error: float
    volume_error: float
    caps: tuple[str, ...]


class SolidRows(NamedTuple):
    """What unit forces at w contacts do to a solid."""

    metric: Metric
    part: float  # of a full step that is taken
    normal: Floats  # (w, 3) of the forces
    direct: Floats  # (w, N) motion of the nodes, along the force, by A⁻¹
    soft: Floats  # (w, m) share of the soft modes in it
    rho: Floats  # (w, M) taken from the whitened pressures
    delassus: Floats  # (w, w) for the share of a step that is taken

    def motion(self, force: Floats) -> Floats:
        """Motion (N, 3) of the nodes by contact forces (w,), volumes kept."""
        return self.part * (
            self.direct.T @ (force[:, None] * self.normal)
            + self.metric.soft @ (force @ self.soft)
            - self.metric.response @ (force @ self.rho)
        )


class Mixer:
    """Anderson acceleration of a fixed-point map (Walker & Ni 2011).

    Of states whose first ``measured`` components are the residual that the mixture makes least.
    """

    def __init__(self, measured: int, size: int) -> None:
        self.measured = measured
        self._changes = np.empty((MEMORY, measured))  # of the residual from step to step
        self._images = np.empty((MEMORY, size))  # of the image
        self._last: tuple[Floats, Floats] | None = None
        self.restart()

    def restart(self) -> None:
        """Forget all steps: the next one is plain."""
        self.count = 0
        self._last = None

    def history(self) -> tuple[Floats, Floats]:
        """Changes (k, measured) of the states from step to step, and of their residuals."""
        kept = min(self.count, MEMORY)
        changes = self._changes[:kept]
        return self._images[:kept, : self.measured] - changes, changes

    def mix(self, state: Floats, image: Floats) -> Floats:
        """Next state (size,): the image less the combination of past images whose residuals come
        nearest to the present one.
        """
        residual = (image - state)[: self.measured]
        if self._last is not None:
            row = self.count % MEMORY
            np.subtract(residual, self._last[0], out=self._changes[row])
            np.subtract(image, self._last[1], out=self._images[row])
            self.count += 1
        self._last = residual, image
        kept = min(self.count, MEMORY)
        if kept == 0:
            return image
        changes = self._changes[:kept]
        gram = changes @ changes.T
        gram.flat[:: kept + 1] *= 1.0 + 1e-8
        gram.flat[:: kept + 1] += 1e-300
        return np.asarray(image - np.linalg.solve(gram, changes @ residual) @ self._images[:kept])


class Settling:
    """One solid on its way to equilibrium.

    Parameters
    ----------
    model : SolidModel
    stiffness : Stiffness
        For the activation of the state.
    mobility : Mobility
        Of the contact points, for the matrix of ``stiffness``.
    state : SolidState
        As predicted.
    obstacles : Obstacles
        What its contact points meet.
    slowness : float
        Way to the equilibrium over a step at the end of a solve, at least (`find_slowness`).
    error : float, optional
        Of the muscle's size, below which the solve ends; `ERROR` where it is not given.
    material : Material, optional
        What others ask that meet it.
    """

    def __init__(
        self,
        model: SolidModel,
        stiffness: Stiffness,
        mobility: Mobility,
        state: SolidState,
        obstacles: Obstacles,
        *,
        slowness: float = 1.0,
        error: float | None = None,
        material: Material | None = None,
    ) -> None:
        self.model = model
        self.size = model.size
        self.material = material
        self.stiffness = stiffness
        self.mobility = mobility
        self.state = state
        self.obstacles = obstacles
        self.tension = tension(model, state.anchors)
        self.springs = model.springs @ state.anchors
        self.nodes = state.nodes.copy()
        self.pressure = state.pressures.copy()
        count = len(model.cells.volumes)
        self.work = start_work(model, state)
        self.squeezed = np.zeros(len(model.cells.weights), dtype=np.bool_)
        self.right = np.empty_like(self.nodes)
        self.gradient = np.empty((count, 3, len(self.nodes)))
        self.volumes = np.empty(count)
        self.iterations = 0
        self.error = np.inf
        self.residual = np.inf
        self.part = 1.0  # of a full step that is taken
        self.asleep = False
        self._free: tuple[Floats, Floats]
        self._asked: Wanted
        self.caps: set[str] = set()
        self.forces_capped = False
        self.mixer = Mixer(self.nodes.size, self.nodes.size + len(self.pressure))
        self._least = np.inf
        self._halved = (np.inf, 0)
        self.softened = True
        self.slowness = max(slowness, state.slowness)
        self._seen = 0.0
        self.wanted = ERROR if error is None else error
        self._localise()
        if state.metric is None or self._has_turned(state.metric):
            self._renew_metric()
        else:
            self.metric = state.metric
            self._metric_y = self.nodes.copy()
        sources = obstacles.count
        forces = state.forces
        self.forces = (
            forces.copy() if forces.shape[1] == sources else np.zeros((len(forces), sources))
        )
        self._choose_near()

    def _localise(self) -> bool:
        """The local step where the nodes are; whether points joined the squeezed ones."""
        cells = self.model.cells
        local_step(
            cells.nodes,
            cells.slopes,
            cells.region,
            self.nodes,
            self.tension,
            self.work,
            self.right,
            self.gradient,
            self.volumes,
        )
        det = self.work[:, DETERMINANT * POINTS :].ravel()
        joined = bool(((det < LEAST) & ~self.squeezed).any())
        self.squeezed |= det < LEAST
        if self.squeezed.any():
            squeezed = np.flatnonzero(self.squeezed)
            pull_apart(squeezed, cells.nodes, cells.slopes, LEAST, STIFFNESS, self.work, self.right)
        return joined

    def _has_turned(self, metric: Metric) -> bool:
        change = np.linalg.norm(self.gradient - metric.gradient)
        return bool(change > TURNED * np.linalg.norm(metric.gradient))

    def _choose_near(self) -> None:
        """Choose the contact points near an obstacle."""
        points = np.empty_like(self.state.points)
        carry(*self.model.embedding, self.nodes, points)
        self.near = self.obstacles.find_near(points, NEAR * self.model.size)
        self._near_y = self.nodes.copy()
        self._push = np.zeros_like(self.nodes)

    def free_step(self) -> None:
        """The global step, with the volumes corrected, as if there were no contact."""
        if self.asleep:
            self.step, self.change = self._free[0].copy(), self._free[1].copy()
            return
        model, metric = self.model, self.metric
        highest = np.abs(self.pressure).max(initial=0.0)
        self.part = 1.0 / max(1.0, highest / CALM_PRESSURE)
        flat = self.gradient.reshape(len(self.volumes), -1)
        pressed = (self.pressure @ flat).reshape(3, -1).T
        force = self.right + self.springs + pressed
        force -= metric.matrix @ self.nodes
        free = self.part * yielded(metric, force)
        rest = model.cells.volumes
        # What contacts take from the pressures is found with the metric's gradients: with others
        # here the two would not cancel, and where the iteration ends would depend on the metric.
        adds = metric.gradient.reshape(len(rest), -1) @ free.T.ravel()
        lacking = rest * (1.0 - self.pressure / BULK) - self.volumes - adds
        self.change = metric.whiten @ lacking
        self.step = free + metric.response @ self.change
        self._free = self.step.copy(), self.change.copy()

    def meet(self) -> Wanted:
        """The contacts with obstacles within reach, and what they want after the free step."""
        if self.asleep:
            return self._asked
        size = self.model.size
        count = len(self.near)
        here, motion, reach = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
        nodes = self.nodes, self.step, self._push
        carry_steps(self.near, *self.model.embedding, *nodes, MARGIN * size, here, motion, reach)
        found = self.obstacles.meet(self.near, here, reach)
        point = self.near[found.near]
        most, softness = self.contact_law(point, self.model.area)
        self._asked = Wanted(
            point,
            found.source,
            found.normal,
            -found.gap - np.einsum("ca,ca->c", found.normal, motion[found.near]),
            np.full(len(point), softness),
            most,
            self.forces[point, found.source],
        )
        return self._asked

    def contact_law(self, points: Integers, area: Floats | float) -> tuple[Floats, Floats | float]:
        """Greatest force (k,) at contact points that stand for an area each, and how far these
        yield to a unit force.
        """
        most = area / self.model.area * self.stiffness.most[points]
        return most, YIELDING * self.model.size / area

    def feet_of(self, points: Integers) -> Embedding:
        """Contact points (w,) as sums of nodes."""
        return self.model.embedding.some(points)

    def ask(self, points: Floats, place: Floats) -> tuple[Floats, Floats, Embedding]:
        """Gaps (k,) of points (k, 3) to this muscle, their normals (k, 3) and feet; the search
        begins from ``place`` (k, 3), which is brought up to date.
        """
        assert self.material is not None
        count = len(points)
        gap, normal = np.empty(count), np.empty((count, 3))
        feet = Embedding(np.zeros((count, 27), dtype=np.int64), np.zeros((count, 27)))
        ask_material(self.material, self.nodes, points, place, gap, normal, *feet)
        return gap, normal, feet

    def rows_of(
        self, points: Integers, normal: Floats, feet: Embedding | None = None
    ) -> "SolidRows":
        """What unit forces along ``normal`` (w, 3) at contact points, and behind them at other
        ``feet`` in the material, do to the solid.
        """
        slots = self.mobility.find(points)
        known = len(slots)
        columns, shares = self.model.embedding.some(points)
        if feet is not None:
            columns = np.concatenate([columns, feet.columns])
            shares = np.concatenate([shares, feet.shares])
        count, nodes = len(columns), len(self.nodes)
        motion, pairs = np.empty((count, nodes)), np.empty((count, count))
        motion[:known] = self.mobility.rows[slots]
        pairs[:known, :known] = self.mobility.pairs[np.ix_(slots, slots)]
        if count > known:
            add_rows(columns[known:], shares[known:], self.metric.inverse, motion[known:])
            fill_mobilities(columns, shares, motion, known, pairs)
        rho, soft = (
            _along(columns, shares, part.reshape(nodes, -1), normal)
            for part in (self.metric.response, self.metric.soft)
        )
        delassus = (normal @ normal.T) * pairs + soft @ soft.T - rho @ rho.T
        return SolidRows(self.metric, self.part, normal, motion, soft, rho, self.part * delassus)

    def push(self, motion: Floats | None, rows: "SolidRows", force: Floats, asked: Wanted) -> None:
        """Add the motion (N, 3) by contact forces (w,) to the step, and keep those with
        obstacles.
        """
        self._push = np.zeros_like(self.nodes) if motion is None else motion
        if motion is not None:
            self.step += motion
            self.change -= self.part * (force @ rows.rho)
        self.forces[:] = 0.0
        self.forces[asked.point, asked.source] = asked.force

    def advance(self) -> None:
        """Go on to where the next iteration starts from, and estimate the error there."""
        size = self.model.size
        moved = self._way(self.step)
        if not np.isfinite(moved):
            raise FloatingPointError("the solid does not settle")
        if self.asleep:
            if self._may_end(moved):
                return
            # Where a contact has moved it is another problem.
            self.asleep = False
            self._least, self._halved = np.inf, (np.inf, self.iterations)
            self.mixer.restart()
        self.iterations += 1
        pressure = self.pressure + self.metric.whiten.T @ self.change / self.part
        pressure = np.clip(pressure, -MOST_PRESSURE, MOST_PRESSURE)
        self.residual = moved / self.part / size
        if moved > GROWTH * self._least or moved > LONGEST * size:
            self.mixer.restart()
        self._least = moved if moved > GROWTH * self._least else min(self._least, moved)
        if moved < 0.5 * self._halved[0]:
            self._halved = (moved, self.iterations)
        here = np.concatenate([self.nodes.ravel(), self.pressure])
        plain = np.concatenate([(self.nodes + self.step).ravel(), pressure])
        stalled = self.iterations - self._halved[1] >= STALLED
        if stalled:
            self.mixer.restart()
        mixed = self.mixer.mix(here, plain)
        way = mixed - here
        far = self._way(way[: self.nodes.size].reshape(-1, 3))
        self.error = self._estimate(moved) / self.part / size
        way *= min(1.0, LONGEST * size / max(far, 1e-300))
        self.nodes = (here + way)[: self.nodes.size].reshape(-1, 3)
        self.pressure = (here + way)[self.nodes.size :]
        joined = self._localise()
        far = np.abs(self.nodes - self._metric_y).max() > TURNED_WAY * size
        if stalled and self.softened:
            # Where a solid buckles, soft modes are not what they are at rest.
            self.softened = False
            self._halved = (moved, self.iterations)
            joined = True
        if joined or far:
            self._renew_metric()
        if np.abs(self.nodes - self._near_y).max() > STALE * NEAR * size:
            self._choose_near()
        if self.iterations >= self.model.iterations and self.error >= self.wanted:
            self.caps.add("iterations")
        self.asleep = self.error < self.wanted or self.iterations >= self.model.iterations

    def _way(self, motion: Floats) -> float:
        """How far material goes, about, when nodes move (N, 3): nodes that hold none settle slowly,
        and move nothing.
        """
        square = (motion**2).sum(axis=1) * self.model.reach**2
        return float(np.sqrt(square.max()))

    def _may_end(self, moved: float) -> bool:
        """Whether a step ends the iteration by the slowness known so far, or is the last one."""
        near = SAFETY * moved * self.slowness < self.wanted * self.part * self.model.size
        return near or self.iterations >= self.model.iterations

    def _estimate(self, moved: float) -> float:
        """Distance of material from the fixed point, about: a step times the greatest ratio of way
        to step that the steps so far have shown.

        A mode that contracts slowly makes small steps on a long way; where iterations have moved by
        ΔX and their steps changed by ΔR, its way is at most max |ΔX c| / |ΔR c| times its step.
        """
        if self.iterations < 3:
            return np.inf
        # Where this is not the end in any case it need not be known.
        if self._may_end(moved) and self.mixer.count > 1:
            ways, changes = self.mixer.history()
            weight = np.repeat(self.model.reach, 3)
            ways, changes = ways * weight, changes * weight
            gram = changes @ changes.T
            gram.flat[:: len(gram) + 1] *= 1.0 + 1e-6
            ratios = np.linalg.eigvals(np.linalg.solve(gram, ways @ ways.T))
            self._seen = max(self._seen, float(np.sqrt(np.abs(ratios).max())))
            self.slowness = max(self.slowness, self._seen)
        return SAFETY * moved * self.slowness

    def _renew_metric(self) -> None:
        matrix, inverse = self.stiffness.matrix, self.stiffness.inverse
        if self.squeezed.any():
            matrix, inverse = stiffened(self.model, matrix, inverse, np.flatnonzero(self.squeezed))
            self.mobility = Mobility(*self.model.embedding, inverse)
        modes = self.stiffness.soft if self.softened else self.stiffness.soft[:, :, :0]
        modes = turned_modes(self.model, modes, self.work)
        self.metric = find_metric(self.model, self.gradient, matrix, inverse, modes)
        self._metric_y = self.nodes.copy()
        self.mixer.restart()

    def report(self) -> Report:
        """How the solve ended."""
        caps = set(self.caps)
        if self.forces_capped:
            caps.add("forces")
        if (self.forces.max(axis=1, initial=0.0) >= self.stiffness.most).any():
            caps.add("contact pressure")
        if (np.abs(self.pressure) >= MOST_PRESSURE).any():
            caps.add("pressure")
        error = float(np.abs(self.volumes / self.model.cells.volumes - 1.0).max())
        return Report(self.iterations, self.error, error, tuple(sorted(caps)))

    def finish(self) -> SolidState:
        """The state where the iteration is."""
        rows = self.work.reshape(len(self.work), ROWS, POINTS)
        nodes, left = lifted(self)
        if left:
            self.caps.add("lifts")
        return self.state._replace(
            nodes=self.nodes,
            lifted_nodes=nodes,
            points=self.model.embedding.of(nodes),
            rotations=rows[:, ROTATION : ROTATION + 4].swapaxes(1, 2).reshape(-1, 4).copy(),
            stretches=rows[:, STRETCH].ravel().copy(),
            pressures=self.pressure,
            forces=self.forces,
            slowness=self._seen,
            metric=None if self.squeezed.any() or not self.softened else self.metric,
        )


def find_slowness(model: SolidModel, stiffness: Stiffness, mobility: Mobility) -> float:
    """How many times as far as an iteration goes the equilibrium is, at most, near the rest shape:
    for the mode of the solid that contracts most slowly, which is one of bending.

    By an accelerated solve from nodes moved at random, which meets that mode last.
    """
    rest = rest_state(model)
    shaken = np.random.default_rng(0).normal(size=rest.nodes.shape) @ model.axes
    state = rest._replace(nodes=rest.nodes + SHAKEN * model.size * shaken)
    free = np.zeros(len(rest.points), dtype=np.bool_)
    nothing = Obstacles(
        [], np.zeros((0, 2, 3)), [], np.zeros((0, 4, 4)), free, np.zeros((0, len(free)))
    )
    solid = Settling(model, stiffness, mobility, state, nothing)
    for _ in range(SHAKES):
        solid.free_step()
        meet([solid], ALONE)
        solid.advance()
    return solid.slowness


def lifted(solid: Settling) -> tuple[Floats, bool]:
    """Nodes (N, 3) moved so far that no contact point is left in a bone as it is, volumes kept; and
    whether some may be left all the same.
    """
    model, size = solid.model, solid.model.size
    y, metric = solid.nodes, solid.metric
    solid.part = 1.0  # a lift is a whole step
    settled = np.empty(len(model.cells.volumes))
    volumes = np.empty_like(settled)
    cells = model.cells
    region_volumes(cells.nodes, cells.slopes, cells.weights, cells.region, y, settled)
    columns, shares = (part[solid.near] for part in model.embedding)
    for _ in range(LIFTS):
        here = np.empty((len(solid.near), 3))
        carry(columns, shares, y, here)
        touch = solid.obstacles.meet_exactly(solid.near, here, MARGIN * size)
        if touch.gap.min(initial=0.0) >= -TOLERANCE * size:
            return y, False
        point = solid.near[touch.near]
        zero = np.zeros(len(point))
        wanted = Wanted(point, touch.source, touch.normal, -touch.gap, zero, zero + np.inf, zero)
        rows = solid.rows_of(point, touch.normal)
        every = np.arange(len(point))
        met = Contacts(wanted, solid.feet_of(point))
        force, _ = find_forces(
            {0: met}, {0: every}, None, every[:0], {0: rows}, 0.1 * TOLERANCE * size
        )
        y = y + rows.motion(force[0])
        # A push keeps the volumes to first order.
        region_volumes(cells.nodes, cells.slopes, cells.weights, cells.region, y, volumes)
        y = y + metric.response @ (metric.whiten @ (settled - volumes))
    return y, True


def _along(columns: Integers, shares: Floats, matrix: Floats, normal: Floats) -> Floats:
    """Rows (w, k) of a matrix (N, 3 k) at points, taken along the normals (w, 3)."""
    width = matrix.shape[1] // 3
    out = np.empty((len(columns), 3 * width))
    add_rows(columns, shares, matrix, out)
    return np.asarray(np.einsum("wak,wa->wk", out.reshape(len(out), 3, width), normal))


def start_work(model: SolidModel, state: SolidState) -> Floats:
    """What `local_step` knows at the quadrature points of each cell (C, ROWS * P)."""
    cells, fibres = model.cells, model.fibres
    count = len(cells.nodes)
    rows = np.zeros((count, ROWS, POINTS))

    def by_cell(values: Floats) -> Floats:
        return values.reshape(count, POINTS, -1).swapaxes(1, 2)

    rows[:, ROTATION : ROTATION + 4] = by_cell(state.rotations)
    rows[:, FIBRE : FIBRE + 3] = by_cell(fibres.direction)
    for row, values in (
        (STRETCH, state.stretches),
        (LOWER, fibres.lower),
        (UPPER, fibres.upper),
        (PASSIVE, fibres.passive),
        (ACTIVE, state.activation * fibres.active * fibres.content),
        (WEIGHT, cells.weights),
    ):
        rows[:, row] = values.reshape(count, POINTS)
    return rows.reshape(count, -1)


def yielded(metric: Metric, forces: Floats) -> Floats:
    """Motion (N, 3) of nodes under forces (N, 3): A⁻¹ + W Wᵀ times these."""
    soft = metric.soft.reshape(forces.size, metric.soft.shape[2])
    turning = soft @ (soft.T @ forces.ravel())
    return np.asarray(metric.inverse @ forces + turning.reshape(-1, 3))


def turned_modes(model: SolidModel, modes: Floats, work: Floats) -> Floats:
    """Modes (N, 3, m) at rest turned as the material at the nodes is, by the rotations in ``work``
    (C, ROWS * P).
    """
    cells = model.cells
    rows = work.reshape(len(work), ROWS, POINTS)[:, ROTATION : ROTATION + 4]
    turns = Rotation.from_quat(rows[:, [1, 2, 3, 0]].swapaxes(1, 2).reshape(-1, 4)).as_matrix()
    by_cell = turns.reshape(len(work), POINTS, 3, 3).mean(axis=1)
    mean, count = np.zeros((len(modes), 3, 3)), np.zeros((len(modes), 1, 1))
    np.add.at(mean, cells.nodes, by_cell[:, None])
    np.add.at(count, cells.nodes, 1.0)
    return np.ascontiguousarray((mean / count) @ modes)


def find_metric(
    model: SolidModel, gradient: Floats, matrix: Floats, inverse: Floats, soft: Floats
) -> Metric:
    """The metric for gradients (M, 3, N) of the regions' volumes, the matrix (N, N), its inverse
    and soft modes (N, 3, m).

    LinAlgError where the gradients are not independent.
    """
    count, _, nodes = gradient.shape
    by_axis = soft.transpose(1, 0, 2).reshape(3 * nodes, -1)
    flat = gradient.reshape(count, -1)
    answer = (gradient.reshape(-1, nodes) @ inverse).reshape(count, -1)
    answer += (flat @ by_axis) @ by_axis.T
    compliance = answer @ flat.T
    compliance[np.diag_indices(count)] *= 1.0 + 1e-9
    compliance[np.diag_indices(count)] += model.cells.volumes / BULK
    whiten = solve_triangular(np.linalg.cholesky(compliance), np.eye(count), lower=True)
    response = (whiten @ answer).reshape(count, 3, nodes).transpose(2, 1, 0)
    return Metric(gradient.copy(), matrix, inverse, soft, np.ascontiguousarray(response), whiten)


def stiffened(
    model: SolidModel, matrix: Floats, inverse: Floats, squeezed: Integers
) -> tuple[Floats, Floats]:
    """The matrix (N, N) and its inverse with `STIFFNESS` w |F|² of squeezed points added.

    With B the rows sqrt(STIFFNESS w) ∇N of these points the sum is A + BᵀB, and by Woodbury's
    identity its inverse is A⁻¹ - (L⁻¹ B A⁻¹)ᵀ (L⁻¹ B A⁻¹), where L Lᵀ = I + B A⁻¹ Bᵀ.
    """
    cells = model.cells
    c, p = np.divmod(squeezed, POINTS)
    slopes = cells.slopes.reshape(*cells.nodes.shape, 3, POINTS)[c, :, :, p]
    added = np.zeros((len(squeezed), 3, len(inverse)))
    root = np.sqrt(STIFFNESS * cells.weights[squeezed])
    spots = cells.nodes[c][:, None, :]
    np.put_along_axis(
        added, np.repeat(spots, 3, axis=1), root[:, None, None] * slopes.swapaxes(1, 2), axis=2
    )
    rows = added.reshape(-1, len(inverse))
    answer = rows @ inverse
    small = np.linalg.cholesky(np.eye(len(rows)) + answer @ rows.T)
    answer = solve_triangular(small, answer, lower=True)
    return matrix + rows.T @ rows, np.ascontiguousarray(inverse - answer.T @ answer)
