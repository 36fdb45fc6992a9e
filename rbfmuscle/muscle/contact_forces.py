"""Contact forces of a muscle's solid: a linear complementarity problem in the metric of a solve.

A unit force at near point i along n_i moves near point j along n_j, with the volumes of the regions
kept, by

    G_ij = (n_i · n_j) w_i A⁻¹ w_j - ρ_i · ρ_j,    ρ_i = Σ_k w_ik n_i · (L⁻¹ A⁻¹ g)_k,

the Schur complement of the volumes (`global_step.py`), w_i the shape functions of point i. Contact
forces λ, 0 <= λ_i <= λ_max, give every contact the motion that it needs, G λ >= rhs, where they
are not at λ_max, and none where there is more room than that. A contact that yields adds to G_ii.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.jit import compiled
from rbfmuscle.muscle.global_step import add_responses, add_rows

# Contacts that join the working set in one round, rounds, sweeps in each.
BATCH = 24
ROUNDS = 10
SWEEPS = 400


class Answers(NamedTuple):
    """What is kept through a solve of the points that have had a force; they have numbers in
    order.
    """

    number: np.ndarray  # (m,) of each near point, -1 for none yet
    used: np.ndarray  # (1,) how many have one
    motion: np.ndarray  # (room, N) w_i A⁻¹
    pairs: np.ndarray  # (room, room) w_i A⁻¹ w_j
    response: np.ndarray  # (room, M, 3) Σ_k w_ik (L⁻¹ A⁻¹ g)_k


class Law(NamedTuple):
    """How contacts yield, for each contact."""

    yielding: np.ndarray  # (c,) motion for a unit force
    most: np.ndarray  # (c,) greatest force


class Push(NamedTuple):
    """What contact forces do."""

    nodes: np.ndarray  # (N, 3) motion of the nodes
    taken: np.ndarray  # (M,) what it takes from the whitened pressures
    capped: bool  # whether rounds or sweeps ended before the forces were found


@compiled
def no_answers(near, metric):
    """Room for the answers of all near points."""
    count = len(near.which)
    return Answers(
        np.full(count, -1, np.int64),
        np.zeros(1, np.int64),
        np.empty((count, len(metric.inverse))),
        np.empty((count, count)),
        np.empty((count, len(metric.factor), 3)),
    )


@compiled
def _answer(i, near, metric, answers):
    """Number of near point i; its answers are found when it is first asked for."""
    if answers.number[i] >= 0:
        return answers.number[i]
    number = answers.used[0]
    answers.number[i] = number
    answers.used[0] += 1
    motion = answers.motion[number]
    motion[:] = 0.0
    answers.response[number] = 0.0
    for k in range(near.columns.shape[1]):
        j, share = near.columns[i, k], near.shares[i, k]
        row = metric.inverse[j]
        for n in range(len(row)):
            motion[n] += share * row[n]
        for r in range(len(metric.factor)):
            for a in range(3):
                answers.response[number, r, a] += share * metric.response[r, a, j]
    for other in range(len(near.which)):
        d = answers.number[other]
        if d < 0:
            continue
        value = 0.0
        for k in range(near.columns.shape[1]):
            value += near.shares[other, k] * motion[near.columns[other, k]]
        answers.pairs[number, d] = value
        answers.pairs[d, number] = value
    return number


@compiled
def _schur(start, numbers, normal, answers, rows, delassus, own):
    """Rows ρ and entries of G of the contacts from ``start`` on; ``own`` is its diagonal."""
    for c in range(start, len(numbers)):
        n = normal[c]
        for r in range(rows.shape[1]):
            some = answers.response[numbers[c], r]
            rows[c, r] = n[0] * some[0] + n[1] * some[1] + n[2] * some[2]
        for d in range(c + 1):
            value = answers.pairs[numbers[c], numbers[d]]
            value *= n[0] * normal[d, 0] + n[1] * normal[d, 1] + n[2] * normal[d, 2]
            for r in range(rows.shape[1]):
                value -= rows[c, r] * rows[d, r]
            delassus[c, d] = value
            delassus[d, c] = value
        own[c] = delassus[c, c]


@compiled
def solve_forces(delassus, rhs, force, sweeps, tolerance, most):
    """Contact forces with 0 <= force <= most and delassus · force >= rhs where force < most.

    By projected Gauss-Seidel from a first guess, in place, until no gap moves by more than the
    tolerance; returns whether it came to that. ``delassus`` (c, c) is the motion at contact i for a
    unit force at contact j, ``rhs`` (c,) the motion that each asks for.
    """
    residual = rhs.copy()
    for c in range(len(rhs)):
        if force[c] != 0.0:
            for d in range(len(rhs)):
                residual[d] -= delassus[c, d] * force[c]
    for _ in range(sweeps):
        largest = 0.0
        for c in range(len(rhs)):
            change = min(max(0.0, force[c] + residual[c] / delassus[c, c]), most[c]) - force[c]
            if change != 0.0:
                force[c] += change
                largest = max(largest, abs(change) * delassus[c, c])
                for d in range(len(rhs)):
                    residual[d] -= delassus[c, d] * change
        if largest < tolerance:
            return True
    return False


@compiled
def deepest(residual, is_chosen, tolerance, most):
    """Contacts, not yet chosen, that lack the most motion, deepest first; of equals the first."""
    found = np.empty(most, np.int64)
    count = 0
    for c in range(len(residual)):
        if not residual[c] > tolerance or is_chosen[c]:
            continue
        if count == most and residual[c] <= residual[found[count - 1]]:
            continue
        count = min(count + 1, most)
        place = count - 1
        while place > 0 and residual[found[place - 1]] < residual[c]:
            found[place] = found[place - 1]
            place -= 1
        found[place] = c
    return found[:count]


@compiled
def _push_nodes(normal, strength, numbers, rows, answers, metric, push, taken):
    """Motion of the nodes by contact forces, and what these take from the whitened pressures."""
    taken[:] = 0.0
    some, forces = np.empty_like(numbers), np.empty_like(normal)
    count = 0
    for c in range(len(strength)):
        if strength[c] == 0.0:
            continue
        some[count] = numbers[c]
        for a in range(3):
            forces[count, a] = strength[c] * normal[c, a]
        count += 1
        for r in range(len(taken)):
            taken[r] += strength[c] * rows[c, r]
    moved = np.zeros((3, len(push)))
    add_rows(answers.motion, some[:count], forces[:count], moved)
    add_responses(metric.response, -taken, moved)
    push[:] = moved.T


@compiled
def _find_residual(touch, rhs, near, push, residual):
    """Motion that each contact still needs after a push of the nodes."""
    for c in range(len(rhs)):
        i = touch.point[c]
        value = rhs[c]
        normal = touch.normal[c]
        for k in range(near.columns.shape[1]):
            j = near.columns[i, k]
            value -= near.shares[i, k] * (
                normal[0] * push[j, 0] + normal[1] * push[j, 1] + normal[2] * push[j, 2]
            )
        residual[c] = value


class _Contacts(NamedTuple):
    """What is asked of c contacts."""

    rhs: np.ndarray  # (c,) motion that each needs
    force: np.ndarray  # (c,) first guess
    residual: np.ndarray  # (c,) motion that is still needed
    is_chosen: np.ndarray  # (c,) whether it is in the working set


class _WorkingSet(NamedTuple):
    """Contacts whose forces are solved for together, the first of these arrays' rows."""

    chosen: np.ndarray  # (w,) which contact
    numbers: np.ndarray  # (w,) of its point among the answers
    normal: np.ndarray  # (w, 3)
    wants: np.ndarray  # (w,) motion that it needs
    strength: np.ndarray  # (w,) force
    most: np.ndarray  # (w,) greatest force
    rows: np.ndarray  # (w, M) ρ
    delassus: np.ndarray  # (w, w) G, on the diagonal what it yields more
    own: np.ndarray  # (w,) diagonal of G


@compiled
def _find_contacts(touch, motion, forces):
    """What is asked of the contacts when the near points move by ``motion`` (m, 3)."""
    count = len(touch.point)
    found = _Contacts(np.empty(count), np.empty(count), np.empty(count), np.empty(count, np.bool_))
    for c in range(count):
        i = touch.point[c]
        found.rhs[c] = -touch.gap[c]
        for a in range(3):
            found.rhs[c] -= touch.normal[c, a] * motion[i, a]
        found.residual[c] = found.rhs[c]
        found.force[c] = forces[i, touch.source[c]]
        found.is_chosen[c] = found.force[c] > 0.0
    return found


@compiled
def _first_set(first, room, regions):
    """Room for a working set, which starts with the ``first`` contacts."""
    work = _WorkingSet(
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty((room, 3)),
        np.empty(room),
        np.empty(room),
        np.empty(room),
        np.empty((room, regions)),
        np.empty((room, room)),
        np.empty(room),
    )
    work.chosen[: len(first)] = first
    return work


@compiled
def _yield(work, total, law):
    """Put what contacts yield on the diagonal."""
    least = 0.0
    for k in range(total):
        least = max(least, 1e-7 * abs(work.own[k]))
    for k in range(total):
        work.delassus[k, k] = work.own[k] + least + law.yielding[work.chosen[k]]


@compiled
def contact_push(touch, motion, near, metric, answers, law, forces, tolerance):
    """What contact forces do when the near points move by ``motion`` (m, 3); fills ``forces`` (m,
    obstacles), which hold the first guess.

    The working set starts from the contacts that pushed before and takes in the deepest violations
    until none is left; forces solve the complementarity problem on it.
    """
    asked = _find_contacts(touch, motion, forces)
    forces[:] = 0.0
    push, taken = np.zeros((len(metric.inverse), 3)), np.zeros(len(metric.factor))
    first = np.flatnonzero(asked.is_chosen)
    total = len(first)
    work = _first_set(first, min(len(touch.point), total + ROUNDS * BATCH), len(taken))
    done = 0
    capped = False
    for turn in range(ROUNDS):
        added = deepest(asked.residual, asked.is_chosen, tolerance, BATCH)
        for c in added:
            asked.is_chosen[c] = True
            work.chosen[total] = c
            total += 1
        if total == 0:
            break
        for k in range(done, total):
            c = work.chosen[k]
            work.numbers[k] = _answer(touch.point[c], near, metric, answers)
            work.normal[k] = touch.normal[c]
            work.wants[k] = asked.rhs[c]
            work.strength[k] = asked.force[c]
            work.most[k] = law.most[c]
        some, ways = work.numbers[:total], work.normal[:total]
        found = work.strength[:total]
        _schur(done, some, ways, answers, work.rows, work.delassus, work.own)
        done = total
        _yield(work, total, law)
        wants = work.wants[:total]
        settled = solve_forces(work.delassus, wants, found, SWEEPS, 0.1 * tolerance, work.most)
        _push_nodes(ways, found, some, work.rows, answers, metric, push, taken)
        capped = not settled
        if len(added) == 0:
            break
        _find_residual(touch, asked.rhs, near, push, asked.residual)
        capped |= turn == ROUNDS - 1 and asked.residual.max() > tolerance
    for k in range(total):
        c = work.chosen[k]
        forces[touch.point[c], touch.source[c]] = work.strength[k]
    return Push(push, taken, capped)
