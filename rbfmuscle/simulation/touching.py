"""Bodies that settle together: contact forces, equal and opposite, in one system.

A unit force at contact i along n_i moves contact j along n_j, with the volumes of the regions kept,
by

    G_ij = (s_i n_i) · H⁻¹ (s_j n_j) - ρ_i · ρ_j,    ρ_i = Σ_k s_ik n_i · U_k,

the Delassus matrix of a solid's contacts after the Schur complement of the volumes; s_i are the
shape functions of the point, U the whitened responses to the regions' pressures (`solve.py`). In a
mesh of particles s_i are the shares of its vertices, H is their mass, and ρ is nothing. Forces λ
give every contact the motion z that it needs,

    0 <= λ_i <= λ_max,    (G λ)_i + ε λ_i >= z_i where λ_i < λ_max,    λ_i = 0 where it is greater,

and ε is what a contact yields for a unit force. A contact between two bodies has a row in the
matrix of each: that of its point, along the normal, and that of the foot in the neighbour, against
it. One that holds bodies together pulls too: -λ_max <= λ_i, and (G λ)_i + ε λ_i = z_i between the
bounds.

All bodies of a group iterate together: each makes a free step, then the forces of all contacts are
found, with bones and between bodies, then each goes on. A body whose error is below what is wanted
sleeps until a contact moves it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.loops import loop

SWEEPS = 2000  # of the Gauss-Seidel method, at most
TOLERANCE = 2e-5  # violation of a contact, of the body's size, that is left
LEFT = 1e-6  # violation of a contact, of the size, for which another one joins in an iteration
PRECISE = 1e-7  # error of the gaps, of the size, for which contact forces are found
# Contacts that join those with a force at a time, the deepest first: a tenth of those that a free
# step brings into contact will bear a force, and each costs a row of the matrix.
BATCH = 8
ROUNDS = 20  # in which contacts join those that bear a force, in an iteration, at most


class Wanted(NamedTuple):
    """What is asked of the forces of c contacts."""

    point: Integers  # (c,) contact point of the body
    source: Integers  # (c,) what it meets, where that is no other body
    normal: Floats  # (c, 3)
    motion: Floats  # (c,) along the normal that it needs
    yields: Floats  # (c,) motion for a unit force
    most: Floats  # (c,) greatest force
    force: Floats  # (c,) first guess


NOTHING = Wanted(
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 3)),
    *(np.zeros(0) for _ in range(4)),
)


class Rows(Protocol):
    """What unit forces at w contacts do to a body."""

    @property
    def delassus(self) -> Floats:
        """Motions (w, w) along the contacts."""

    def motion(self, force: Floats) -> Floats:
        """Motion (N, 3) of the nodes by forces (w,)."""


class Body(NamedTuple):
    """What never changes of a muscle that meets others."""

    points: Integers  # (k,) contact points that meet neighbours
    places: NDArray[Any]  # (k, ...) of these in the muscle, as `Moving.ask` takes them
    area: Floats  # (k,) that each stands for [scene unit squared]


class Moving(Protocol):
    """A body on its way to equilibrium.

    ``size`` is that of the muscle [scene unit]; ``nodes`` (N, 3) are its nodes or vertices, and
    ``step`` (N, 3) is their motion in this iteration. One that is ``asleep`` goes on only where
    contacts move it. ``forces_capped`` says whether the last forces ended at a greatest number of
    rounds.
    """

    size: float
    nodes: Floats
    step: Floats
    asleep: bool
    forces_capped: bool
    iterations: int

    def free_step(self) -> None:
        """Find the step as if there were no contact with obstacles."""

    def meet(self) -> Wanted:
        """The contacts with obstacles within reach, and what they want after the free step."""

    def feet_of(self, points: Integers) -> Embedding:
        """Contact points (w,) as sums of nodes."""

    def rows_of(self, points: Integers, normal: Floats, feet: Embedding | None) -> Rows:
        """What unit forces along ``normal`` (w, 3) at contact points, and behind them at ``feet``,
        do.
        """

    def push(self, motion: Floats | None, rows: Any, force: Floats, asked: Wanted) -> None:
        """Add the motion (N, 3) by contact forces (w,) to the step, None where there are none, and
        keep those with obstacles.
        """

    def advance(self) -> None:
        """Take the step, and fall asleep where that is near enough to the equilibrium, or all
        iterations are done; wake up where contacts have moved it from there.
        """

    def ask(self, points: Floats, place: NDArray[Any]) -> tuple[Floats, Floats, Embedding]:
        """Gaps (k,) of points (k, 3) to this body, infinite where they are not known, their
        normals (k, 3) and feet; the search begins from ``place`` (k, ...), which is brought up to
        date.
        """

    def contact_law(self, points: Integers, area: Floats) -> tuple[Floats, Floats]:
        """Greatest forces (k,) at contact points that stand for areas (k,), and how far (k,) these
        yield to a unit force.
        """


class Meeting:
    """Points of the bodies of a group that may meet other bodies in a sub-step, ordered by body.

    Parameters
    ----------
    one, other : (K,) ndarray
        Numbers of the body of each point and of the body that it may meet.
    point : (K,) ndarray
        The contact point.
    own : sequence of Embedding
        Of the points of each body.
    place : sequence of ndarray
        For each body, where the search begins for the feet in it of those that may meet it, in
        their order.
    law : tuple of two (K,) ndarray
        The greatest force at each point, and how far it yields to a unit force.
    holds : (K,) ndarray of bool
        Which hold together, and so pull as far as they push.
    allowed : (K,) ndarray
        Overlap at rest [scene unit]; a gap, below zero, where a point holds.
    reach : (K,) ndarray
        Gap up to which each takes part.
    force : (K,) ndarray
        First guess; kept up to date.
    """

    def __init__(
        self,
        one: Integers,
        other: Integers,
        point: Integers,
        own: Sequence[Embedding],
        place: Sequence[NDArray[Any]],
        law: tuple[Floats, Floats],
        holds: Booleans,
        allowed: Floats,
        reach: Floats,
        force: Floats,
    ) -> None:
        self.one = one
        self.other = other
        self.point = point
        self.own = own
        self.place = place
        self.most, self.yields = law
        self.holds = holds
        self.allowed = allowed
        self.reach = reach
        self.force = force
        bodies = range(len(own))
        self.mine = [slice(*np.searchsorted(one, [m, m + 1])) for m in bodies]
        self.behind = [np.flatnonzero(other == m) for m in bodies]
        self.gap = np.full(len(one), np.inf)
        self.normal = np.zeros((len(one), 3))
        self.feet: list[Embedding | None] = [None] * len(own)
        self.wants = np.full(len(one), -np.inf)
        self._here = np.zeros((len(one), 3))
        # Nodes when the bodies were last looked at, how far these have gone in all, and how far
        # those of a pair had when a point was asked about.
        self._nodes: list[Floats | None] = [None] * len(own)
        self._path = np.zeros(len(own))
        self._asked = np.zeros(len(one))

    def ask(self, solids: Sequence["Moving"]) -> None:
        """Bring gaps, normals and feet up to date where a body of a pair is awake and the gap may
        be one that takes part.
        """
        awake = np.array([not solid.asleep for solid in solids])
        for m in np.flatnonzero(awake).tolist():
            nodes = solids[m].nodes
            self._here[self.mine[m]] = self.own[m].of(nodes)
            last = self._nodes[m]
            if last is not None:
                self._path[m] += np.linalg.norm(nodes - last, axis=1).max()
            self._nodes[m] = nodes.copy()
        path = self._path[self.one] + self._path[self.other]
        # What both bodies have moved since brings no point from beyond the reach into it.
        far = np.isfinite(self.gap) & (self.gap - (path - self._asked) > self.reach)
        moved = (awake[self.one] | awake[self.other]) & ~far
        self._asked[moved] = path[moved]
        for m, behind in enumerate(self.behind):
            some = np.flatnonzero(moved[behind])
            if len(some) == 0:
                continue
            which, place = behind[some], self.place[m][some]
            gap, normal, feet = solids[m].ask(np.ascontiguousarray(self._here[which]), place)
            self.gap[which], self.normal[which], self.place[m][some] = gap, normal, place
            known = self.feet[m]
            if known is None:
                self.feet[m] = feet
            else:
                known.columns[some], known.shares[some] = feet

    def apart(self, motions: Sequence[Floats | None]) -> Floats:
        """How far (K,) motions (N, 3) of the bodies, None for no motion, bring points and what they
        meet apart.
        """
        away = np.zeros((len(self.one), 3))
        for m, motion in enumerate(motions):
            if motion is None:
                continue
            away[self.mine[m]] += self.own[m].of(motion)
            feet = self.feet[m]
            if feet is not None:
                away[self.behind[m]] -= feet.of(motion)
        return np.asarray(np.einsum("ka,ka->k", self.normal, away))

    def joined(self, awake: Booleans) -> Booleans:
        """Which bodies are awake or press on one that is."""
        acting = awake.copy()
        pressed = (self.force != 0.0) & (awake[self.one] | awake[self.other])
        acting[self.one[pressed]] = acting[self.other[pressed]] = True
        return acting

    def prepare(self, solids: Sequence["Moving"], acting: Booleans) -> None:
        """Ask what the contacts want after the free steps of the bodies that act; the others rest
        where they are.
        """
        self.ask(solids)
        steps = [solid.step if acts else None for solid, acts in zip(solids, acting, strict=True)]
        self.wants = -self.gap - self.allowed - self.apart(steps)
        # Also where the gap is not known, and so infinite.
        apart = self.gap > self.reach
        idle = ~(acting[self.one] | acting[self.other])
        self.wants[apart | idle] = -np.inf
        self.force[apart] = 0.0

    def without(self, far: Booleans) -> "Meeting":
        """The same without some of the points (K,)."""
        left = ~far
        own = [part.some(np.flatnonzero(left[mine])) for part, mine in zip(self.own, self.mine)]
        place = [part[left[behind]] for part, behind in zip(self.place, self.behind)]
        law = self.most[left], self.yields[left]
        numbers = self.one[left], self.other[left], self.point[left]
        lengths = self.allowed[left], self.reach[left]
        return Meeting(*numbers, own, place, law, self.holds[left], *lengths, self.force[left])

    def lacking(self, motion: Floats) -> Floats:
        """How much is lacking (K,) of a motion (K,) that points want: also of one back, where they
        hold.
        """
        back = self.holds & np.isfinite(motion)
        return np.where(back, np.abs(motion), motion)


def settle(solids: Sequence[Moving], meeting: Meeting | None = None) -> None:
    """Iterate bodies that may touch each other until each has ended.

    ``meeting`` holds the points that may meet another body, and keeps their forces. In an iteration
    act those that are awake, and those that press on these. Raises FloatingPointError where a body
    diverges.
    """
    while True:
        acting = np.array([not solid.asleep for solid in solids])
        if not acting.any():
            return
        if meeting is not None:
            acting = meeting.joined(acting)
        bodies = np.flatnonzero(acting).tolist()
        for m in bodies:
            solids[m].free_step()
        meet(solids, acting, meeting)
        for m in bodies:
            solids[m].advance()


def meet(solids: Sequence[Moving], acting: Booleans, meeting: Meeting | None = None) -> None:
    """Find the contact forces of bodies that act and have made a free step, and push them.

    The working set starts from the contacts that bore a force and takes in the deepest violations
    until none is left.
    """
    size = min(solid.size for solid in solids)
    bodies = np.flatnonzero(acting).tolist()
    asked, own, chosen = {}, {}, {}
    for m in bodies:
        wanted = asked[m] = solids[m].meet()
        own[m] = solids[m].feet_of(wanted.point)
        bear = np.flatnonzero(wanted.force)
        chosen[m] = np.union1d(bear, deepest(wanted.motion, bear, PRECISE * size, BATCH))
    touching = np.zeros(0, dtype=np.int64)
    batch = BATCH * len(bodies)
    if meeting is not None:
        meeting.prepare(solids, acting)
        lacks = meeting.lacking(meeting.wants)
        bear = np.flatnonzero(meeting.force)
        touching = np.union1d(bear, deepest(lacks, bear, PRECISE * size, batch))
        touching = touching[np.isfinite(meeting.wants[touching])]
    rows: dict[int, Rows] = {}
    stale = set(bodies)
    for _ in range(ROUNDS):
        for m in stale:
            rows[m] = _rows_of(m, solids[m], asked[m], chosen[m], meeting, touching)
        shares, found = find_forces(asked, chosen, meeting, touching, rows, PRECISE * size)
        motions = {m: rows[m].motion(part) for m, part in shares.items() if len(part)}
        stale = set()
        for m in bodies:
            lacks = asked[m].motion
            if m in motions:
                lacks = lacks - np.einsum("ca,ca->c", asked[m].normal, own[m].of(motions[m]))
            more = deepest(lacks, chosen[m], LEFT * size, BATCH)
            if len(more):
                chosen[m] = np.union1d(chosen[m], more)
                stale.add(m)
        if meeting is not None:
            lacks = meeting.wants - meeting.apart([motions.get(m) for m in range(len(solids))])
            more = deepest(meeting.lacking(lacks), touching, LEFT * size, batch)
            if len(more):
                touching = np.union1d(touching, more)
                stale |= {*meeting.one[more].tolist(), *meeting.other[more].tolist()} & {*bodies}
        if not stale:
            break
    for m in bodies:
        solids[m].forces_capped = not found or m in stale
        solids[m].push(motions.get(m), rows[m], shares[m], asked[m])


def deepest(lacks: Floats, chosen: Integers, least: float, batch: int) -> Integers:
    """The ``batch`` contacts, beside those chosen, that lack the most of what they want, more than
    the ``least``.
    """
    joins = lacks > least
    joins[chosen] = False
    lacking = np.flatnonzero(joins)
    if len(lacking) > batch:
        lacking = lacking[np.argsort(-lacks[lacking], kind="stable")[:batch]]
    return lacking


def _rows_of(
    m: int,
    solid: Moving,
    wanted: Wanted,
    chosen: Integers,
    meeting: Meeting | None,
    touching: Integers,
) -> Rows:
    """What unit forces at all contacts do to a body: with obstacles, at its points that meet other
    bodies, and at the feet of others' points in it.
    """
    points, normal, feet = wanted.point[chosen], wanted.normal[chosen], None
    if meeting is not None:
        own = touching[meeting.one[touching] == m]
        behind = touching[meeting.other[touching] == m]
        points = np.concatenate([points, meeting.point[own]])
        normal = np.concatenate([normal, meeting.normal[own], -meeting.normal[behind]])
        known = meeting.feet[m]
        if known is not None:
            feet = known.some(np.searchsorted(meeting.behind[m], behind))
    return solid.rows_of(points, normal, feet)


def find_forces(
    asked: Mapping[int, Wanted],
    chosen: Mapping[int, Integers],
    meeting: Meeting | None,
    touching: Integers,
    rows: Mapping[int, Rows],
    tolerance: float,
) -> tuple[dict[int, Floats], bool]:
    """Forces of the chosen contacts of each body that acts, by its number, in the order of its
    rows; and whether they were found to the tolerance. The contacts keep them.
    """
    counts = np.array([len(chosen[m]) for m in asked])
    bodies = np.arange(len(counts))
    one, other = np.repeat(bodies, counts), np.full(counts.sum(), -1)
    row = np.concatenate([np.arange(count) for count in counts])
    across, least = other, np.zeros(len(one))
    motion, yields, most, force = (
        np.concatenate([getattr(part, name)[chosen[m]] for m, part in asked.items()])
        for name in ("motion", "yields", "most", "force")
    )
    if meeting is not None:
        # By their places among those that act; -1 for bodies that rest.
        place = np.full(len(meeting.own) + 1, -1)
        place[list(asked)] = bodies
        mine, theirs = place[meeting.one[touching]], place[meeting.other[touching]]
        owned = counts + np.bincount(mine[mine >= 0], minlength=len(counts))
        one, other = np.concatenate([one, mine]), np.concatenate([other, theirs])
        row = np.concatenate([row, counts[mine] + _rank(mine, len(counts))])
        across = np.concatenate([across, owned[theirs] + _rank(theirs, len(counts))])
        pulls = np.where(meeting.holds, -meeting.most, 0.0)
        least = np.concatenate([least, pulls[touching]])
        motion, yields, most, force = (
            np.concatenate([part, more[touching]])
            for part, more in (
                (motion, meeting.wants),
                (yields, meeting.yields),
                (most, meeting.most),
                (force, meeting.force),
            )
        )
    width = np.array([len(rows[m].delassus) for m in asked])
    found = solve_forces(
        np.concatenate([rows[m].delassus.ravel() for m in asked]),
        np.concatenate([[0], np.cumsum(width**2)[:-1]]),
        width,
        one,
        row,
        other,
        across,
        motion,
        yields,
        least,
        most,
        force,
        np.empty(int(width.sum())),
        tolerance,
    )
    shares = {m: np.zeros(count) for m, count in zip(asked, width, strict=True)}
    parts = np.split(force[: counts.sum()], np.cumsum(counts)[:-1])
    for (m, wanted), part in zip(asked.items(), parts, strict=True):
        wanted.force[:] = 0.0
        wanted.force[chosen[m]] = shares[m][: len(part)] = part
    if meeting is not None:
        meeting.force[np.isfinite(meeting.wants)] = 0.0
        meeting.force[touching] = between = force[counts.sum() :]
        for k, share in enumerate(shares.values()):
            share[counts[k] : owned[k]] = between[mine == k]
            share[owned[k] :] = between[theirs == k]
    return shares, found


def _rank(of: Integers, count: int) -> Integers:
    """Number of each item among those of the same value, of so many values."""
    rank = np.empty(len(of), dtype=np.int64)
    for value in range(count):
        same = of == value
        rank[same] = np.arange(np.count_nonzero(same))
    return rank


def surface_points(points: Floats, normals: Floats, spacing: float, height: float) -> Integers:
    """Which of the points (n, 3) of a surface to take, in order, so that every other one is no
    farther from one of them than the ``spacing``, and the surface, with unit ``normals`` (n, 3),
    rises by no more than the ``height`` between both: by d |n - m| / 8 over a chord of length d.
    """
    tree = cKDTree(points)
    taken = np.zeros(len(points), dtype=np.bool_)
    chosen = []
    for i, point in enumerate(points):
        if not taken[i]:
            chosen.append(i)
            near = np.array(tree.query_ball_point(point, spacing))
            chord = np.linalg.norm(points[near] - point, axis=1)
            turned = np.linalg.norm(normals[near] - normals[i], axis=1)
            taken[near[chord * turned <= 8.0 * height]] = True
    return np.array(chosen, dtype=np.int64)


@loop
def solve_forces(
    delassus,
    start,
    width,
    one,
    row,
    other,
    across,
    wants,
    yields,
    least,
    most,
    force,
    moved,
    tolerance,
):
    """Contact forces (c,) of a group of bodies, by projected Gauss-Seidel from a first guess.

    ``delassus`` holds the matrices of the bodies behind each other: that of body m, ``width[m]``
    wide, from ``start[m]`` on. Contact c is row ``row[c]`` of body ``one[c]``, and row
    ``across[c]`` of body ``other[c]``, each where it is not -1. It ``wants`` a motion, ``yields``
    one for a unit force, and bears from ``least`` to ``most``. ``moved`` holds the motions of the
    rows behind each other, body m's from Σ width before it on. Returns whether no contact moved by
    more than the ``tolerance`` in the last sweep.
    """
    count = len(wants)
    moved[:] = 0.0
    first = np.empty(len(width), np.int64)
    total = 0
    for m in range(len(width)):
        first[m] = total
        total += width[m]
    for c in range(count):
        if force[c] != 0.0:
            m, o = one[c], other[c]
            if m >= 0:
                _move_rows(delassus, start[m], width[m], row[c], force[c], moved, first[m])
            if o >= 0:
                _move_rows(delassus, start[o], width[o], across[c], force[c], moved, first[o])
    for _ in range(SWEEPS):
        largest = 0.0
        for c in range(count):
            m, o = one[c], other[c]
            own = 0.0
            here = 0.0
            if m >= 0:
                own += delassus[start[m] + row[c] * width[m] + row[c]]
                here += moved[first[m] + row[c]]
            if o >= 0:
                own += delassus[start[o] + across[c] * width[o] + across[c]]
                here += moved[first[o] + across[c]]
            own = own * (1.0 + 1e-7) + yields[c]
            change = (wants[c] - here - yields[c] * force[c]) / own
            change = min(max(force[c] + change, least[c]), most[c]) - force[c]
            if change != 0.0:
                force[c] += change
                largest = max(largest, abs(change) * own)
                if m >= 0:
                    _move_rows(delassus, start[m], width[m], row[c], change, moved, first[m])
                if o >= 0:
                    _move_rows(delassus, start[o], width[o], across[c], change, moved, first[o])
        if largest < tolerance:
            return True
    return False


@loop
def _move_rows(delassus, start, width, row, force, moved, first):
    """Add what a force at one row does to all rows of its body."""
    at = start + row * width
    for k in range(width):
        moved[first + k] += delassus[at + k] * force
