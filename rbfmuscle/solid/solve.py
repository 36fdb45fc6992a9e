"""Bringing solids to equilibrium under elasticity, pressures and contacts.

An iteration finds rotations and stretches (the local step, `kernels.py`), then the nodes by a step
of Newton's method with pressures that keep the volumes (the global step, `metric.py`), and contact
forces in the same metric (`contact.py`). Pressures are kept from iteration to iteration, so that
the fixed point of the iteration is the equilibrium; Anderson acceleration gets there sooner.

With g_r = ∂V_r/∂y the nodes move by H⁻¹ (force + Σ_r p_r g_r). What the volumes then lack is
corrected by pressures q in the same metric: the motion for a unit pressure of region r is H⁻¹ g_r,
and the volumes that it adds are G_rs = g_r · H⁻¹ g_s. With the volumes that pressures compress,
K_rr = V_r / BULK, the correction solves (G + K) q = lacking. G + K = L Lᵀ; all of this is in the
whitened pressures Lᵀ q, for which the responses are U = L⁻¹ H⁻¹ g and the matrix is the identity.

A surface of points on a bone of flat facets has many equilibria, because each point has to be
lifted over each edge. A muscle on a bone has not. So the solid settles with contacts that yield a
little, on bones whose facets are rounded (`rbfmuscle/bones/rounded.py`): one shape for each pose.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, Singles
from rbfmuscle.geometry.interpolation import Embedding, carry
from rbfmuscle.simulation.touching import (
    TOLERANCE,
    Wanted,
    find_forces,
)
from rbfmuscle.solid.contact import Obstacles, fill_delassus
from rbfmuscle.solid.kernels import (
    ACTIVE,
    CONTENT,
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
    at_points,
    carry_steps,
    local_step,
    pull_apart,
    region_volumes,
)
from rbfmuscle.solid.material import Material, ask_material
from rbfmuscle.solid.metric import BULK, FLOOR, LEAST, STIFFNESS, Metric, find_metric
from rbfmuscle.solid.model import SolidModel
from rbfmuscle.solid.state import SolidState, tension

# All lengths are relative to the muscle's size.
# A solve ends where its estimated error is below this: the distance of material from where further
# iterations would take it.
ERROR = 2e-5
# A longer step is shortened to it: where fibres are slack, long ones go astray. With 0.2 a bar
# whose ends approach takes ten times the iterations.
LONGEST = 0.02
GROWTH = 2.0  # a motion beyond this multiple of the least so far restarts the acceleration
MEMORY = 5  # steps that Anderson acceleration combines
# Of the estimated error: the last steps hide a slow mode that they hardly move. Measured without
# it: up to 1.07 times the estimate from the equilibrium, on the phantom.
SAFETY = 1.4
NEAR = 0.015  # contact points nearer to an obstacle take part in a solve
STALE = 0.4  # share of NEAR by which a node moves before they are chosen again
MARGIN = 0.003  # obstacles are looked for beyond where a point goes by this
# How far a contact with a bone yields under a pressure of 2 μ. Three points carry a gluteus maximus
# over an edge of the pelvis, and its fibres' lengths jump by 0.3 mm as one point takes the place of
# another; with 4e-4 they do not, but with 2e-4 a corner of a bone stays 1.3 mm deep in its surface.
YIELDING = 1e-4
SOFT = 4e-4  # the same of one with a muscle
LIFTS = 3  # linear steps, at most, that lift what is left in a bone out of it
MOST_LIFT = 0.1  # motion of a node in one: those of a muscle that is crushed may go anywhere
MOST_PRESSURE = 3.0  # of a region, over 2 μ
# Iterations after which the metric is found anew, also as a solve starts, where the last one took
# three times as many. With 15, muscles that slide on each other may not get to their end.
RENEWED = 10
# Of the error wanted: nearer to it the metric stays for as many iterations again. A new one takes
# as long as twenty iterations.
NEARLY = 10.0
# Steps that stay longer than `LONGEST` go back and forth over what resists them: the least
# stiffness in the metric is raised by this factor, up to `FIRMEST`, and lowered again by it at a
# renewal.
FIRMER, FIRMEST = 10.0, 2.0
KNOWN = 3  # iterations with a metric before the error is estimated by it
# Where the accelerated motion is against the step, it goes to a saddle of the energy: so many times
# the step is taken instead.
FORWARD = 3.0


class Report(NamedTuple):
    """How a solve ended.

    ``error`` is the estimated distance of material from the equilibrium, of the muscle's size, and
    1 where it is more or not known; ``volume_error`` the greatest relative error of a region's
    volume. ``caps`` says what ended at its greatest number: iterations, the last contact forces, a
    contact at its greatest force, a region at its greatest pressure.
    """

    iterations: int
    error: float
    volume_error: float
    caps: tuple[str, ...]


class SolidRows(NamedTuple):
    """What unit forces at w contacts do to a solid."""

    metric: Metric
    direct: Singles  # (w, 3 N) motion of the nodes by H⁻¹
    rho: Floats  # (w, M) taken from the whitened pressures
    delassus: Floats  # (w, w)

    def motion(self, force: Floats) -> Floats:
        """Motion (N, 3) of the nodes by contact forces (w,), volumes kept."""
        free = (force.astype(np.float32) @ self.direct).reshape(-1, 3)
        return np.asarray(free - self.metric.pressed(force @ self.rho), dtype=np.float64)


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
    most : (n,) ndarray
        Greatest contact forces over 2 μ.
    state : SolidState
        As predicted.
    obstacles : Obstacles
        What its contact points meet.
    error : float, optional
        Of the muscle's size, below which the solve ends; `ERROR` where it is not given.
    material : Material, optional
        What others ask that meet it.
    """

    def __init__(
        self,
        model: SolidModel,
        most: Floats,
        state: SolidState,
        obstacles: Obstacles,
        *,
        error: float | None = None,
        material: Material | None = None,
    ) -> None:
        self.model = model
        self.size = model.size
        self.material = material
        self.most = most
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
        self.asleep = False
        self._free: tuple[Floats, Floats]
        self._renewed = 0
        self._floor = FLOOR
        self._asked: Wanted
        self.caps: set[str] = set()
        self.forces_capped = False
        self.mixer = Mixer(self.nodes.size, self.nodes.size + len(self.pressure))
        self._least = np.inf
        self.slowness = max(1.0, state.slowness)
        self._seen = 0.0
        self.wanted = ERROR if error is None else error
        self._localise()
        if state.metric is None or state.settled_in > 3 * RENEWED:
            self._renew_metric()
        else:
            self.metric = state.metric
            if not np.array_equal(state.turn, np.eye(3)):
                self.metric = state.metric.turned(state.turn)
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
        flat = self.gradient.reshape(len(self.volumes), -1)
        pressed = (self.pressure @ flat).reshape(3, -1).T
        force = self.right + self.springs + pressed - model.links @ self.nodes
        free = metric.yielded(force)
        rest = model.cells.volumes
        # What contacts take from the pressures is found with the metric's gradients: with others
        # here the two would not cancel, and where the iteration ends would depend on the metric.
        adds = metric.gradient.reshape(len(rest), -1) @ free.T.ravel()
        lacking = rest * (1.0 - self.pressure / BULK) - self.volumes - adds
        self.change = metric.whiten @ lacking
        self.step = np.asarray(free + metric.pressed(self.change), dtype=np.float64)
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
        point = self.near[found.point]
        area = np.full(len(point), self.model.area)
        most, softness = self._law(point, area, YIELDING)
        self._asked = Wanted(
            point,
            found.source,
            found.normal,
            -found.gap - np.einsum("ca,ca->c", found.normal, motion[found.point]),
            softness,
            most,
            self.forces[point, found.source],
        )
        return self._asked

    def contact_law(self, points: Integers, area: Floats) -> tuple[Floats, Floats]:
        """Greatest forces (k,) at contact points that stand for areas (k,), and how far (k,) these
        yield to a unit force.
        """
        return self._law(points, area, SOFT)

    def _law(self, points: Integers, area: Floats, yielding: float) -> tuple[Floats, Floats]:
        """`contact_law`, with how far contacts yield under a pressure of 2 μ, of the size."""
        most = area / self.model.area * self.most[points]
        return most, yielding * self.model.size / area

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
        columns, shares = self.model.embedding.some(points)
        motion = self.metric.reaction.along(points, normal[: len(points)])
        if feet is not None:
            behind = self.metric.reaction.at(feet, normal[len(points) :])
            motion = np.concatenate([motion, behind])
            columns = np.concatenate([columns, feet.columns])
            shares = np.concatenate([shares, feet.shares])
        count = len(columns)
        rho = _along(columns, shares, self.metric.response.reshape(len(self.nodes), -1), normal)
        delassus = np.empty((count, count))
        fill_delassus(columns, shares, normal, motion, delassus)
        delassus -= rho @ rho.T
        return SolidRows(self.metric, motion, rho, delassus)

    def push(self, motion: Floats | None, rows: "SolidRows", force: Floats, asked: Wanted) -> None:
        """Add the motion (N, 3) by contact forces (w,) to the step, and keep those with
        obstacles.
        """
        self._push = np.zeros_like(self.nodes) if motion is None else motion
        if motion is not None:
            self.step += motion
            self.change -= force @ rows.rho
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
            self._least = np.inf
            self.mixer.restart()
        self.iterations += 1
        pressure = self.pressure + self.metric.whiten.T @ self.change
        pressure = np.clip(pressure, -MOST_PRESSURE, MOST_PRESSURE)
        if moved > GROWTH * self._least or moved > LONGEST * size:
            self.mixer.restart()
        self._least = moved if moved > GROWTH * self._least else min(self._least, moved)
        here = np.concatenate([self.nodes.ravel(), self.pressure])
        plain = np.concatenate([(self.nodes + self.step).ravel(), pressure])
        step = plain - here
        way = self.mixer.mix(here, plain) - here
        if way[: self.nodes.size] @ step[: self.nodes.size] < 0.0:
            way = FORWARD * step
        far = self._way(way[: self.nodes.size].reshape(-1, 3))
        self.error = self._estimate(moved) / size
        way *= min(1.0, LONGEST * size / max(far, 1e-300))
        self.nodes = (here + way)[: self.nodes.size].reshape(-1, 3)
        self.pressure = (here + way)[self.nodes.size :]
        joined = self._localise()
        if np.abs(self.nodes - self._near_y).max() > STALE * NEAR * size:
            self._choose_near()
        last = self.iterations >= self.model.iterations
        if last and self.error >= self.wanted:
            self.caps.add("iterations")
        self.asleep = last or self.error < self.wanted
        # A body that sleeps keeps its metric, as it keeps the step that was found by it. Just
        # before the last iteration a new one would leave the error unknown.
        late = self.iterations + KNOWN > self.model.iterations
        since = self.iterations - self._renewed
        astray = moved > LONGEST * size and since >= KNOWN
        near_end = self.error < NEARLY * self.wanted and since < 2 * RENEWED
        stale = since >= RENEWED and not near_end
        if astray:
            self._floor = min(self._floor * FIRMER, FIRMEST)
        elif stale:
            self._floor = max(self._floor / FIRMER, FLOOR)
        if (joined or astray or stale) and not late and not self.asleep:
            self._renew_metric()

    def _way(self, motion: Floats) -> float:
        """How far material goes, about, when nodes move (N, 3): nodes that hold none settle slowly,
        and move nothing.
        """
        square = (motion**2).sum(axis=1) * self.model.reach**2
        return float(np.sqrt(square.max()))

    def _may_end(self, moved: float) -> bool:
        """Whether a step ends the iteration by the slowness known so far, or is the last one."""
        near = SAFETY * moved * self.slowness < self.wanted * self.model.size
        return near or self.iterations >= self.model.iterations

    def _estimate(self, moved: float) -> float:
        """Distance of material from the fixed point, about: a step times the greatest ratio of way
        to step that the steps so far have shown.

        A mode that contracts slowly makes small steps on a long way; where iterations have moved by
        ΔX and their steps changed by ΔR, its way is at most max |ΔX c| / |ΔR c| times its step.
        """
        if self.iterations - self._renewed < KNOWN:
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
        self.metric = find_metric(
            self.model,
            self.gradient,
            self.work,
            self.squeezed,
            self.pressure,
            floor=self._floor,
        )
        self._renewed = self.iterations
        self.mixer.restart()

    def report(self) -> Report:
        """How the solve ended."""
        caps = set(self.caps)
        if self.forces_capped:
            caps.add("forces")
        if (self.forces.max(axis=1, initial=0.0) >= self.most).any():
            caps.add("contact pressure")
        if (np.abs(self.pressure) >= MOST_PRESSURE).any():
            caps.add("pressure")
        error = float(np.abs(self.volumes / self.model.cells.volumes - 1.0).max())
        return Report(self.iterations, min(self.error, 1.0), error, tuple(sorted(caps)))

    def finish(self) -> SolidState:
        """The state where the iteration is."""
        nodes, left = lifted(self)
        if left:
            self.caps.add("lifts")
        return self.state._replace(
            nodes=self.nodes,
            lifted_nodes=nodes,
            points=self.model.embedding.of(nodes),
            rotations=at_points(self.work, ROTATION, 4),
            stretches=at_points(self.work, STRETCH),
            pressures=self.pressure,
            forces=self.forces,
            slowness=self._seen,
            metric=self.metric,
            turn=np.eye(3),
            settled_in=self.iterations,
        )


def lifted(solid: Settling) -> tuple[Floats, bool]:
    """Nodes (N, 3) moved so far that no contact point is left in a bone as it is, volumes kept; and
    whether some may be left all the same.
    """
    model, size = solid.model, solid.model.size
    y, metric = solid.nodes, solid.metric
    settled = np.empty(len(model.cells.volumes))
    volumes = np.empty_like(settled)
    cells = model.cells
    region_volumes(cells.nodes, cells.slopes, cells.weights, cells.region, y, settled)
    columns, shares = (part[solid.near] for part in model.embedding)
    for _ in range(LIFTS):
        here = np.empty((len(solid.near), 3))
        carry(columns, shares, y, here)
        found = solid.obstacles.meet_exactly(solid.near, here, MARGIN * size)
        if found.gap.min(initial=0.0) >= -TOLERANCE * size:
            return y, False
        point = solid.near[found.point]
        zero = np.zeros(len(point))
        wanted = Wanted(point, found.source, found.normal, -found.gap, zero, zero + np.inf, zero)
        rows = solid.rows_of(point, found.normal)
        every = np.arange(len(point))
        force, _ = find_forces(
            {0: wanted}, {0: every}, None, every[:0], {0: rows}, 0.1 * TOLERANCE * size
        )
        way = rows.motion(force[0])
        if np.abs(way).max() > MOST_LIFT * size:
            break
        y = y + way
        # A push keeps the volumes to first order.
        region_volumes(cells.nodes, cells.slopes, cells.weights, cells.region, y, volumes)
        y = y + metric.pressed(metric.whiten @ (settled - volumes))
    return y, True


def _along(columns: Integers, shares: Floats, matrix: Singles, normal: Floats) -> Floats:
    """Rows (w, k) of a matrix (N, 3 k) at points, taken along the normals (w, 3)."""
    width = matrix.shape[1] // 3
    out = np.empty((len(columns), 3 * width), np.float32)
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
        (ACTIVE, state.activation * fibres.active),
        (CONTENT, fibres.content),
        (WEIGHT, cells.weights),
    ):
        rows[:, row] = values.reshape(count, POINTS)
    return rows.reshape(count, -1)
