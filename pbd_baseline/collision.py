"""Collision response of mesh vertices: half-spaces from the contacts, the sum of their ways out."""

import numba
import numpy as np

# A half-space counts as violated below this share of the search reach.
TOUCHING = 1e-9


class CollisionConstraint:
    """Keeps vertices out of bones: C = gap + n . (x - x_0) >= 0, linearised where the contacts were asked.

    Parameters
    ----------
    reach : float
        Distance within which contacts are looked for [scene unit].
    response : {"sum", "nearest"}
        A vertex in several bones moves by the sum of its ways out, or by the longest alone: the response of
        the authors' earlier papers.
    """

    def __init__(self, *, reach, response="sum"):
        self.reach = float(reach)
        self.nearest_only = response == "nearest"
        self.index, self.gap = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.normal = self.anchor = np.zeros((0, 3))

    def __len__(self):
        return len(self.index)

    def find(self, contacts, points, *, reach=None):
        """Ask the contacts of all vertices (n, 3) where they are now; return the greatest depth."""
        found = contacts.half_spaces(points, self.reach if reach is None else reach)
        self.index, self.gap = np.ascontiguousarray(found.index), np.ascontiguousarray(found.gap)
        self.normal = np.ascontiguousarray(found.normal)
        self.anchor = points[self.index]
        return max(0.0, -float(self.gap.min(initial=0.0)))

    def depth(self, points):
        """Greatest depth of the points in the half-spaces found last."""
        if len(self.index) == 0:
            return 0.0
        return _depth_loop(points, self.index, self.gap, self.normal, self.anchor, np.empty(len(self.index)))

    def project(self, points):
        """Push vertices out of the half-spaces, in place; return the greatest violation before."""
        if len(self.index) == 0:
            return 0.0
        depth = np.empty(len(self.index))
        worst = _depth_loop(points, self.index, self.gap, self.normal, self.anchor, depth)
        if worst > TOUCHING * self.reach:
            if self.nearest_only:
                _keep_deepest(self.index, depth, len(points))
            _push_loop(points, self.index, self.normal, depth)
        return worst

    def clear_way(self, points, direction, step):
        """Take out of ``step * direction``, in place, what would lead into a half-space; say if anything."""
        if len(self.index) == 0 or step == 0.0:
            return False
        return _clear_loop(points, self.index, self.gap, self.normal, self.anchor, direction, step)


def _keep_deepest(index, depth, count):
    deepest = np.zeros(count)
    np.maximum.at(deepest, index, depth)
    depth[depth < deepest[index]] = 0.0


@numba.njit(cache=True, nogil=True)
def _depth_loop(points, index, gap, normal, anchor, depth):
    worst = 0.0
    for c in range(len(index)):
        i = index[c]
        value = gap[c]
        for k in range(3):
            value += normal[c, k] * (points[i, k] - anchor[c, k])
        depth[c] = max(0.0, -value)
        worst = max(worst, depth[c])
    return worst


@numba.njit(cache=True, nogil=True)
def _push_loop(points, index, normal, depth):
    for c in range(len(index)):
        if depth[c] > 0.0:
            for k in range(3):
                points[index[c], k] += depth[c] * normal[c, k]


@numba.njit(cache=True, nogil=True)
def _clear_loop(points, index, gap, normal, anchor, direction, step):
    cleared = False
    for c in range(len(index)):
        i = index[c]
        value, along = gap[c], 0.0
        for k in range(3):
            value += normal[c, k] * (points[i, k] - anchor[c, k])
            along += normal[c, k] * direction[i, k]
        if step * along < 0.0 and value + 2.0 * step * along < 0.0:
            for k in range(3):
                direction[i, k] -= along * normal[c, k]
            cleared = True
    return cleared
