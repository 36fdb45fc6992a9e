"""Contact of an RBF muscle: forces of a linear complementarity problem, through the inverse of the elastic matrix."""

import numpy as np

from rbfmuscle.jit import compiled
from rbfmuscle.sim.loop.contact import HalfSpaces

# Rounds in which contacts join the working set, and sweeps over it in each.
ROUNDS = 6
SWEEPS = 60


@compiled(error_model="numpy")
def solve_contact_forces(gram, need, force, sweeps, tolerance):
    """Contact forces of the linear complementarity problem force >= 0, gram · force >= need.

    By projected Gauss-Seidel.

    Parameters
    ----------
    gram : (c, c) ndarray
        Motion at contact i for a unit force at contact j; symmetric, positive diagonal.
    need : (c,) ndarray
        Motion each contact asks for.
    force : (c,) ndarray
        First guess, changed in place to the solution.
    sweeps : int
    tolerance : float
        Stop when no gap moves by more.
    """
    for _ in range(sweeps):
        largest = 0.0
        for c in range(len(need)):
            residual = need[c]
            for d in range(len(need)):
                residual -= gram[c, d] * force[d]
            new = max(0.0, force[c] + residual / gram[c, c])
            largest = max(largest, abs(new - force[c]) * gram[c, c])
            force[c] = new
        if largest < tolerance:
            break


@compiled(error_model="numpy")
def _deepest(lacking, is_chosen, tolerance, most):
    """Contacts, not yet chosen, that lack the most motion, deepest first; of equals the first."""
    found = np.empty(most, np.int64)
    count = 0
    for c in range(len(lacking)):
        if not lacking[c] > tolerance or is_chosen[c]:
            continue
        if count == most and lacking[c] <= lacking[found[count - 1]]:
            continue
        count = min(count + 1, most)
        place = count - 1
        while place > 0 and lacking[found[place - 1]] < lacking[c]:
            found[place] = found[place - 1]
            place -= 1
        found[place] = c
    return found[:count]


@compiled(error_model="numpy")
def _influence_loop(index, inverse, slot, columns, shares, rows):
    """W A⁻¹ for some contact points: term by term, so that a row is the same whoever else is asked for."""
    rows[:] = 0.0
    for c in range(len(index)):
        for k in range(columns.shape[1]):
            free = slot[columns[index[c], k]]
            share = shares[index[c], k]
            if free < 0 or share == 0.0:
                continue
            for j in range(rows.shape[1]):
                if slot[j] >= 0:
                    rows[c, j] += share * inverse[free, slot[j]]


@compiled(error_model="numpy")
def _gram_loop(contacts, give, row, stiffness, influence, columns, shares):
    """(n_c · n_d) w_cᵀ A⁻¹ w_d - row_c row_d / stiffness: motion at c for a unit force at d, volume kept."""
    index, place, normal = contacts
    size = len(index)
    gram = np.empty((size, size))
    for c in range(size):
        for d in range(c + 1):
            value = 0.0
            for k in range(columns.shape[1]):
                value += shares[index[c], k] * influence[place[d], columns[index[c], k]]
            value *= normal[c, 0] * normal[d, 0] + normal[c, 1] * normal[d, 1] + normal[c, 2] * normal[d, 2]
            if c == d:
                value *= 1.0 + give[c]
            value -= row[c] * row[d] / stiffness
            gram[c, d] = value
            gram[d, c] = value
    # A contact on held centres alone cannot be moved: its row is zero.
    most = 0.0
    for c in range(size):
        most = max(most, abs(gram[c, c]))
    for c in range(size):
        gram[c, c] += 1e-9 * most
    return gram


@compiled(error_model="numpy")
def _push_loop(place, normal, strength, influence, push):
    """push = A⁻¹ Wᵀ of the forces: motion of all centres."""
    push[:] = 0.0
    for c in range(len(place)):
        if strength[c] == 0.0:
            continue
        for k in range(len(push)):
            for a in range(3):
                push[k, a] += influence[place[c], k] * strength[c] * normal[c, a]


@compiled(error_model="numpy")
def _lacking_loop(contacts, need, share, push, hanging, lacking):
    """Motion that each contact still asks for after ``push`` and ``share`` of the volume's response."""
    index, normal, row = contacts
    columns, shares = hanging
    for c in range(len(index)):
        value = need[c] + row[c] * share
        for k in range(columns.shape[1]):
            j = columns[index[c], k]
            value -= shares[index[c], k] * (
                normal[c, 0] * push[j, 0] + normal[c, 1] * push[j, 1] + normal[c, 2] * push[j, 2]
            )
        lacking[c] = value


@compiled(error_model="numpy", nogil=False)
def _contact_loop(spaces, motion, volume, influence, hanging, table, effort, push):
    """Fill ``push`` and the forces in ``table``; returns the volume's share that the push takes back."""
    index, place, gap, normal, source, give = spaces
    response, stiffness = volume
    columns, shares = hanging
    batch, rounds, sweeps, tolerance = effort
    count = len(index)
    row, need, force = np.empty(count), np.empty(count), np.empty(count)
    for c in range(count):
        i = index[c]
        row[c], need[c] = 0.0, -gap[c]
        for a in range(3):
            row[c] += normal[c, a] * response[i, a]
            need[c] -= normal[c, a] * motion[i, a]
        force[c] = table[i, source[c]]
    table[:] = 0.0
    push[:] = 0.0
    lost = 0.0
    is_chosen = force > 0.0
    chosen = np.flatnonzero(is_chosen)
    lacking = need.copy()
    for _ in range(rounds):
        added = _deepest(lacking, is_chosen, tolerance, batch)
        if len(added) == 0 and len(chosen) == 0:
            break
        for c in added:
            is_chosen[c] = True
        chosen = np.concatenate((chosen, added))
        contacts = index[chosen], place[chosen], normal[chosen]
        gram = _gram_loop(contacts, give[chosen], row[chosen], stiffness, influence, columns, shares)
        strength = force[chosen]
        solve_contact_forces(gram, need[chosen], strength, sweeps, 0.1 * tolerance)
        for k in range(len(chosen)):
            force[chosen[k]] = strength[k]
        _push_loop(place[chosen], normal[chosen], strength, influence, push)
        lost = 0.0
        for c in chosen:
            lost += row[c] * force[c]
        if len(added) == 0:
            break
        _lacking_loop((index, normal, row), need, lost / stiffness, push, hanging, lacking)
    for c in chosen:
        table[index[c], source[c]] = force[c]
    return lost


class ContactConstraint:
    """C(x) = gap + n · Δp >= 0 at each contact point, projected through the inverse of the elastic matrix.

    Forces solve a linear complementarity problem on a working set: it starts from the contacts that pushed
    before and takes in the deepest violations round by round until none is left. Few contacts push at a time,
    but leaving one out would let the muscle jump between poses.

    Parameters
    ----------
    columns, shares : (n, k) ndarray
        Sparse rows of W: how the contact points hang on the centres.
    inverse : (F, F) ndarray
        A⁻¹ of the centres that are free.
    free : (F,) ndarray of int
        These, among the K centres.
    count : int
        K.
    batch : int
        Contacts that join the working set in one round.
    tolerance : float
        Violation that is left alone [scene unit].
    """

    def __init__(
        self,
        columns: np.ndarray,
        shares: np.ndarray,
        *,
        inverse: np.ndarray,
        free: np.ndarray,
        count: int,
        batch: int,
        tolerance: float,
    ) -> None:
        self.inverse, self.columns, self.shares = inverse, columns, shares
        self._slot = np.full(count, -1)
        self._slot[free] = np.arange(len(free))
        # W A⁻¹, motion of the centres for a unit force at a point, of the points that ever came near an obstacle.
        self._influence, self._place = np.empty((0, count)), np.full(len(columns), -1)
        self.batch, self.tolerance = batch, tolerance
        self.forces = np.zeros((len(columns), 1))

    def _places(self, index: np.ndarray) -> np.ndarray:
        """Row of ``_influence`` of each contact point; of a few hundredths of them it is ever asked for."""
        new = np.unique(index[self._place[index] < 0])
        if len(new):
            rows = np.empty((len(new), len(self._slot)))
            _influence_loop(new, self.inverse, self._slot, self.columns, self.shares, rows)
            self._place[new] = len(self._influence) + np.arange(len(new))
            self._influence = np.concatenate([self._influence, rows])
        return self._place[index]

    def correction(
        self,
        spaces: HalfSpaces,
        sources: int,
        motion: np.ndarray,
        response: np.ndarray,
        stiffness: float,
    ) -> tuple[np.ndarray, float]:
        """Contact correction of the centres (K, 3), and the volume that it adds by itself.

        Parameters
        ----------
        spaces : HalfSpaces
        sources : int
            Number of obstacles that ``spaces.source`` may name, neighbours counted from the end.
        motion : (n, 3) ndarray
            Motion of the contact points without contact.
        response : (n, 3) ndarray
            Their motion for a unit pressure.
        stiffness : float
            Volume that a unit pressure adds.
        """
        if self.forces.shape[1] != sources:
            self.forces = np.zeros((len(self.columns), sources))
        push = np.empty((len(self._slot), 3))
        give = np.zeros(len(spaces)) if spaces.give is None else spaces.give
        place = self._places(spaces.index)
        contacts = spaces.index, place, spaces.gap, spaces.normal, spaces.source % sources, give
        effort = self.batch, ROUNDS, SWEEPS, self.tolerance
        lost = _contact_loop(
            contacts, motion, (response, stiffness), self._influence, (self.columns, self.shares),
            self.forces, effort, push,
        )  # fmt: skip
        return push, lost
