"""Collision response of a mesh: half-spaces from the contacts, the sum of their ways out."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.jit import compiled

# A half-space counts as violated below this share of the search reach.
TOUCHING = 1e-9


class ContactConstraint:
    """Keeps points of the mesh out of bones: C = gap + n . (x - x_0) >= 0, linearised where the contacts were asked.

    A point is x = sum_k share_k x_k over up to three vertices, and moves them by share_k / sum share^2.

    Parameters
    ----------
    columns, shares : (p, 3) ndarrays
        Vertices and shares of each contact point; a vertex alone is (i, i, i) and (1, 0, 0).
    reach : float
        Distance within which contacts are looked for [scene unit].
    nearest_only : bool
        A vertex in several bones moves by the longest of its ways out alone, as in the authors' papers, not by
        their sum.
    """

    def __init__(
        self, columns: Integers, shares: Floats, *, reach: float, nearest_only: bool = False
    ) -> None:
        self.columns, self.shares = columns, shares
        self.reach = float(reach)
        self.nearest_only = nearest_only
        self.index, self.gap = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.normal = self.anchor = np.zeros((0, 3))
        self.source = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.index)

    def place(self, points: Floats) -> Any:
        """Contact points (p, 3) of vertices (n, 3)."""
        out = np.empty((len(self.columns), 3))
        _place_loop(points, self.columns, self.shares, out)
        return out

    def find(self, contacts: Any, points: Floats, *, reach: Any = None) -> Any:
        """Ask the contacts where the vertices (n, 3) are now; return the greatest depth."""
        placed = self.place(points)
        found = contacts.half_spaces(placed, self.reach if reach is None else reach)
        self.index, self.gap = np.ascontiguousarray(found.index), np.ascontiguousarray(found.gap)
        self.normal, self.source = np.ascontiguousarray(found.normal), found.source
        self.anchor = placed[self.index]
        return max(0.0, -float(self.gap.min(initial=0.0)))

    def depth(self, points: Floats) -> Any:
        """Greatest depth of the points in the half-spaces found last."""
        if len(self.index) == 0:
            return 0.0
        return self._depths(points, np.empty(len(self.index)))

    def project(self, points: Floats) -> Any:
        """Push vertices out of the half-spaces, in place; return the greatest violation before."""
        if len(self.index) == 0:
            return 0.0
        depth = np.empty(len(self.index))
        worst = self._depths(points, depth)
        if worst > TOUCHING * self.reach:
            if self.nearest_only:
                _keep_deepest(self.index, depth, len(self.columns))
            _push_loop(points, self.columns, self.shares, self.index, self.normal, depth)
        return worst

    def clear_way(self, points: Floats, direction: Any, step: Any) -> Any:
        """Take out of ``step * direction``, in place, what would lead into a half-space; say if anything."""
        if len(self.index) == 0 or step == 0.0:
            return False
        planes = self.index, self.gap, self.normal, self.anchor
        return clear_loop(points, self.columns, self.shares, planes, direction, step)

    def _depths(self, points, depth):
        return depth_loop(
            points, self.columns, self.shares, self.index, self.gap, self.normal, self.anchor, depth
        )


def _keep_deepest(index, depth, count):
    deepest = np.zeros(count)
    np.maximum.at(deepest, index, depth)
    depth[depth < deepest[index]] = 0.0


@compiled
def _place_loop(points, columns, shares, out):
    for p in range(len(columns)):
        for a in range(3):
            out[p, a] = 0.0
            for k in range(3):
                out[p, a] += shares[p, k] * points[columns[p, k], a]


@compiled
def _along(vectors, columns, shares, p, anchor, normal):
    """n . (sum_k share_k v_k - anchor)."""
    value = 0.0
    for a in range(3):
        at = -anchor[a]
        for k in range(3):
            at += shares[p, k] * vectors[columns[p, k], a]
        value += normal[a] * at
    return value


@compiled
def depth_loop(points, columns, shares, index, gap, normal, anchor, depth):
    """How deep each point is in its half-space, filled in; the greatest is returned."""
    worst = 0.0
    for c in range(len(index)):
        depth[c] = max(0.0, -gap[c] - _along(points, columns, shares, index[c], anchor[c], normal[c]))
        worst = max(worst, depth[c])
    return worst


@compiled
def _move(vectors, columns, shares, p, normal, amount):
    """Move what carries point p so that it moves by ``amount`` along the normal."""
    square = shares[p, 0] ** 2 + shares[p, 1] ** 2 + shares[p, 2] ** 2
    for k in range(3):
        if shares[p, k] > 0.0:
            for a in range(3):
                vectors[columns[p, k], a] += amount * shares[p, k] / square * normal[a]


@compiled
def _push_loop(points, columns, shares, index, normal, depth):
    for c in range(len(index)):
        if depth[c] > 0.0:
            _move(points, columns, shares, index[c], normal[c], depth[c])


@compiled
def push_in_turn(points, columns, shares, normal, anchor):
    """Push points out one after another, each from where the last push left it: several may move the same vertices."""
    for c in range(len(columns)):
        depth = -_along(points, columns, shares, c, anchor[c], normal[c])
        if depth > 0.0:
            _move(points, columns, shares, c, normal[c], depth)


@compiled
def clear_loop(points, columns, shares, planes, direction, step):
    """Take out of a direction what leads into half-spaces within twice a step along it; whether anything did."""
    index, gap, normal, anchor = planes
    cleared = False
    nothing = np.zeros(3)
    for c in range(len(index)):
        value = gap[c] + _along(points, columns, shares, index[c], anchor[c], normal[c])
        along = _along(direction, columns, shares, index[c], nothing, normal[c])
        if step * along < 0.0 and value + 2.0 * step * along < 0.0:
            _move(direction, columns, shares, index[c], normal[c], -along)
            cleared = True
    return cleared
