"""Collision response of a mesh to the half-spaces of its contacts."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled
from rbfmuscle.simulation.contact import BoneContacts

# A half-space counts as violated below this share of the search reach.
TOUCHING = 1e-9


class ContactConstraint:
    """Keeps vertices out of bones: C = gap + n . (x - x_0) >= 0, linearised where the contacts were
    asked.

    They are looked for within ``reach`` [scene unit].
    """

    def __init__(self, *, reach: float) -> None:
        self.reach = float(reach)
        self.index, self.gap = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.normal = self.anchor = np.zeros((0, 3))

    def find(self, contacts: BoneContacts, points: Floats, *, reach: float | None = None) -> float:
        """Ask the contacts where the vertices (n, 3) are now; return the greatest depth."""
        found = contacts.half_spaces(points, self.reach if reach is None else reach)
        self.index, self.gap, self.normal, _ = found
        self.anchor = points[self.index]
        return max(0.0, -float(self.gap.min(initial=0.0)))

    def depth(self, points: Floats) -> float:
        """Greatest depth of the vertices in the half-spaces found last."""
        return float(self.depths(points).max(initial=0.0))

    def project(self, points: Floats) -> None:
        """Push vertices out of the half-spaces, in place."""
        if len(self.index):
            planes = self.index, self.gap, self.normal, self.anchor
            _push_loop(points, *planes, TOUCHING * self.reach)

    def clear_way(self, points: Floats, direction: Floats, step: float) -> bool:
        """Take out of ``step * direction``, in place, what would lead into a half-space; say if
        anything.
        """
        if len(self.index) == 0 or step == 0.0:
            return False
        return _clear_loop(points, self.index, self.gap, self.normal, self.anchor, direction, step)

    def depths(self, points: Floats) -> Floats:
        """Depth (c,) of the points (n, 3) in each half-space found last, 0 outside."""
        found = np.empty(len(self.index))
        _depth_loop(points, self.index, self.gap, self.normal, self.anchor, found)
        return found


@compiled(error_model="numpy")
def _depth_loop(points, index, gap, normal, anchor, depth):
    """Depth of each point in its half-space, 0 outside."""
    for c in range(len(index)):
        value = gap[c]
        for a in range(3):
            value += normal[c, a] * (points[index[c], a] - anchor[c, a])
        depth[c] = max(0.0, -value)


@compiled(error_model="numpy")
def _push_loop(points, index, gap, normal, anchor, least):
    """Push points out of their half-spaces, all by where they are now, if one is deeper than
    ``least``.
    """
    depth = np.empty(len(index))
    _depth_loop(points, index, gap, normal, anchor, depth)
    if depth.max() <= least:
        return
    for c in range(len(index)):
        for a in range(3):
            points[index[c], a] += depth[c] * normal[c, a]


@compiled
def _clear_loop(points, index, gap, normal, anchor, direction, step):
    """Take out of a direction what leads into half-spaces within twice a step along it; whether
    anything did.
    """
    cleared = False
    for c in range(len(index)):
        i = index[c]
        value, along = gap[c], 0.0
        for a in range(3):
            value += normal[c, a] * (points[i, a] - anchor[c, a])
            along += normal[c, a] * direction[i, a]
        if step * along < 0.0 and value + 2.0 * step * along < 0.0:
            for a in range(3):
                direction[i, a] -= along * normal[c, a]
            cleared = True
    return cleared
