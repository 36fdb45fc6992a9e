"""How a muscle with an inside answers to a small motion of its bones: the equilibrium, linearised.

At balance K(y) = Σ_r p_r ∂V_r/∂y + Σ_c λ_c W_c n_c + springs. A motion of the bones by dq moves the held ends and the
obstacles, and the nodes answer by dy with

    K' dy - G dp - Nᵀ dλ = spring · d(ends),    Gᵀ dy = 0,    N dy + C dλ = n · d(obstacles),

K' the derivative of elastic and pressure forces, G the gradients of the regions' volumes, N the contacts that push.
So lengths have derivatives without any difference of settled shapes, which differ by where each happened to come to
rest. Two things are taken as the smooth muscle would have them, not as its points have. Obstacles count as planes: a
point that slides over a ridge hands its force on to the next one, and what touches the ridge stays. And a contact that
hardly pushes gives way more than contacts do anyway, C = C₀ + τ/λ² (the derivative of λ · gap = τ), so that points may
come and go without a step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.model.inside.loops import carry_loop

# What a contact at the median force yields more than contacts do anyway, as a share of that.
WEAK = 0.5


class _Pushing(NamedTuple):
    """The contacts that push: points, their embedding, directions, obstacles (by their number) and forces."""

    points: np.ndarray
    columns: np.ndarray
    shares: np.ndarray
    normal: np.ndarray
    source: np.ndarray
    force: np.ndarray


class Response:
    """The linearised equilibrium of a settled `Interior`.

    Parameters
    ----------
    solid : Interior
        Settled at the present poses of the contacts.
    contacts : BoneContacts
    """

    def __init__(self, solid: Any, contacts: Any) -> None:
        self.solid = solid
        self.names = contacts.names
        self.pushing = _pushing(solid, contacts)
        # The iteration starts its rotations from where they are: who only asks leaves them there.
        before = solid.quaternion.copy()
        solid.localise()
        self.size = solid.y.size
        self.factor = lu_factor(self.system(), overwrite_a=True, check_finite=False)
        solid.quaternion[:] = before

    def carried(self, ends: Floats, motions: Mapping[str, Floats]) -> Floats:
        """Where contact points go when the bones move a little.

        Parameters
        ----------
        ends : (h, 3) ndarray
            Motion of the held points [scene unit].
        motions : mapping of str to (4, 4) ndarray
            Of each bone that is an obstacle, from its present pose.

        Returns
        -------
        (n, 3) ndarray
            Motion of all contact points, to first order.
        """
        solid, found = self.solid, self.pushing
        right = np.zeros(len(self.factor[0]))
        right[: self.size] = (solid.spring @ ends).ravel()
        way = np.zeros_like(found.points)
        for b, name in enumerate(self.names):
            here = found.source == b
            if here.any():
                motion = motions[name]
                way[here] = found.points[here] @ motion[:3, :3].T + motion[:3, 3] - found.points[here]
        right[len(right) - len(way) :] = np.einsum("ca,ca->c", found.normal, way)
        step = lu_solve(self.factor, right, check_finite=False)[: self.size].reshape(-1, 3)
        out = np.empty_like(solid.points)
        carry_loop(np.ascontiguousarray(step), solid.columns, solid.shares, out)
        return out

    def system(self) -> Floats:
        """The symmetric matrix for (dy, -dp, -dλ)."""
        solid, found, size = self.solid, self.pushing, self.size
        regions, count = len(solid.pressure), len(found.points)
        system = np.zeros((size + regions + count,) * 2)
        stiffness = np.zeros((size, size))
        for axis in range(3):
            stiffness[axis::3, axis::3] = solid.matrix
        stiffness_loop(solid.quad_columns, solid.slopes, solid.weights, _softening(solid), stiffness)
        system[:size, :size] = stiffness
        gradient = np.zeros((size, regions))
        owner = np.repeat(np.arange(regions), np.diff(solid.start))
        for axis in range(3):
            np.add.at(gradient, (3 * solid.touched + axis, owner), solid.gradient[:, axis])
        normals = np.zeros((size, count))
        for axis in range(3):
            values = found.shares * found.normal[:, [axis]]
            np.add.at(normals, (3 * found.columns + axis, np.arange(count)[:, None]), values)
        for first, block in ((size, gradient), (size + regions, normals)):
            last = first + block.shape[1]
            system[:size, first:last], system[first:last, :size] = block, block.T
        if count:
            ends = np.arange(size + regions, len(system))
            system[ends, ends] = -_yielding(solid, found)
        return system


def _pushing(solid: Any, contacts: Any) -> _Pushing:
    points = solid.carry_from(solid.y)
    index, source = np.nonzero(solid.forces > 0.0)
    spaces = solid.obstacles.rounded(contacts).half_spaces(points, solid.obstacles.reach)
    width = solid.forces.shape[1]
    known = {pair: k for k, pair in enumerate(zip(spaces.index.tolist(), (spaces.source % width).tolist()))}
    found = [
        (i, s, known[i, s]) for i, s in zip(index.tolist(), source.tolist(), strict=True) if (i, s) in known
    ]
    index, source, which = np.array(found, dtype=np.int64).reshape(-1, 3).T
    return _Pushing(
        points[index], solid.columns[index], solid.shares[index], spaces.normal[which],
        spaces.source[which], solid.forces[index, source],
    )  # fmt: skip


def _yielding(solid: Any, found: _Pushing) -> Floats:
    """How far each contact gives way for a unit force."""
    usual = float(np.median(found.force))
    weak = usual / np.maximum(found.force, 1e-3 * usual)
    return solid.obstacles.yielding * (1.0 + WEAK * weak**2)


def _softening(solid: Any) -> Floats:
    """What the moving targets and the pressures take from the stiffness of the fixed matrix, (Q, 9, 9)."""
    f, turn, count = solid.f, solid.target, len(solid.f)
    basis = np.eye(9).reshape(9, 3, 3)
    inward = np.einsum("qca,qcb->qab", turn, f)
    inward = 0.5 * (inward + inward.transpose(0, 2, 1))
    spin = np.linalg.inv(np.trace(inward, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inward)
    back = np.einsum("qca,xcb->qxab", turn, basis)
    skew = back - back.transpose(0, 1, 3, 2)
    axis = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    omega = np.einsum("qij,qxj->qxi", spin, axis)
    crossed = np.zeros((count, 9, 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        crossed[..., c, b], crossed[..., b, c] = omega[..., a], -omega[..., a]
    change = np.einsum("qab,qxbc->qxac", turn, crossed)
    if (solid.fibres.passive + solid.fibres.active).any():
        change += _fibre_softening(solid, basis)
    change += solid.pressure[solid.region][:, None, None, None] * _cofactor_change(f, basis)
    return np.ascontiguousarray(change.reshape(count, 9, 9).transpose(0, 2, 1))


def _fibre_softening(solid: Any, basis: Floats) -> Floats:
    """Change of the springs' target c t d aᵀ, d the unit direction of F a, for each change of F."""
    given = solid.fibres
    along = np.einsum("qab,qb->qa", solid.f, given.direction)
    length = np.linalg.norm(along, axis=1)
    way = along / length[:, None]
    moved = np.einsum("xab,qb->qxa", basis, given.direction)
    across = moved - np.einsum("qxa,qa->qx", moved, way)[..., None] * way[:, None, :]
    slack = np.clip(length, given.lower, given.upper)
    size = (given.passive * slack + given.active * given.content) / length
    # A slack spring goes along with its length.
    loose = np.where(slack == length, given.passive, 0.0)
    change = size[:, None, None] * across + loose[:, None, None] * (moved - across)
    return np.einsum("qxa,qb->qxab", change, given.direction)


def _cofactor_change(f: Floats, basis: Floats) -> Floats:
    """Change of the cofactor of F (Q, 3, 3) for each change of it, (Q, 9, 3, 3)."""
    out = np.empty((len(f), 9, 3, 3))
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        first = np.cross(basis[None, :, :, a], f[:, None, :, b])
        out[..., c] = first + np.cross(f[:, None, :, a], basis[None, :, :, b])
    return out


@compiled(error_model="numpy")
def stiffness_loop(columns: Integers, slopes: Floats, weights: Floats, softening: Floats, out: Floats) -> Any:
    """Take Σ w Bᵀ D B from ``out`` (3N, 3N), D (Q, 9, 9) at each point, B its nodes' slopes."""
    wide = columns.shape[1]
    part = np.empty((3, 3, 3))
    for q in range(len(columns)):
        for k in range(wide):
            for a in range(3):
                for i in range(3):
                    for b in range(3):
                        value = 0.0
                        for j in range(3):
                            value += softening[q, 3 * a + i, 3 * b + j] * slopes[q, k, j]
                        part[a, i, b] = weights[q] * value
            right = 3 * columns[q, k]
            for m in range(wide):
                left = 3 * columns[q, m]
                for a in range(3):
                    for b in range(3):
                        value = 0.0
                        for i in range(3):
                            value += slopes[q, m, i] * part[a, i, b]
                        out[left + a, right + b] -= value
