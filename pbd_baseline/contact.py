"""Collision response of a mesh to the half-spaces of its contacts."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.loops import loop
from rbfmuscle.simulation.contact import BoneContacts

# A half-space counts as violated below this share of the search reach.
TOUCHING = 1e-9


class ContactPlanes(NamedTuple):
    """Half-spaces that c vertices are kept in, linearised where the contacts were asked."""

    point: np.ndarray  # (c,) vertex
    gap: np.ndarray  # (c,) distance there [scene unit]
    normal: np.ndarray  # (c, 3)
    anchor: np.ndarray  # (c, 3)


NO_PLANES = ContactPlanes(
    np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
)


class ContactConstraint:
    """Keeps vertices out of bones: C = gap + n . (x - x_0) >= 0, linearised where the contacts were
    asked.

    They are looked for within ``reach`` [scene unit].
    """

    def __init__(self, *, reach: float) -> None:
        self.reach = float(reach)
        self.planes = NO_PLANES

    def find(self, contacts: BoneContacts, points: Floats, *, reach: float | None = None) -> float:
        """Ask the contacts where the vertices (n, 3) are now; return the greatest depth."""
        found = contacts.half_spaces(points, self.reach if reach is None else reach)
        self.planes = ContactPlanes(*found[:3], points[found.point])
        return self.depth(points)

    def depth(self, points: Floats) -> float:
        """Greatest depth of the vertices in the half-spaces found last, 0 outside."""
        return _greatest_depth(points, self.planes)

    def project(self, points: Floats) -> None:
        """Push vertices out of the half-spaces, in place."""
        _push_loop(points, self.planes, TOUCHING * self.reach)


@loop
def plane_depths(points, planes):
    """Depth (c,) of each point in its half-space, 0 outside."""
    depth = np.empty(len(planes.point))
    for c in range(len(depth)):
        value = planes.gap[c]
        for a in range(3):
            value += planes.normal[c, a] * (points[planes.point[c], a] - planes.anchor[c, a])
        depth[c] = max(0.0, -value)
    return depth


@loop
def _greatest_depth(points, planes):
    """Greatest depth of a point in its half-space, 0 where all are outside."""
    depth = plane_depths(points, planes)
    return depth.max() if len(depth) > 0 else 0.0


@loop
def _push_loop(points, planes, least):
    """Push points out of their half-spaces, all by where they are now, if one is deeper than
    ``least``.
    """
    depth = plane_depths(points, planes)
    if len(depth) == 0 or depth.max() <= least:
        return
    for c in range(len(depth)):
        for a in range(3):
            points[planes.point[c], a] += depth[c] * planes.normal[c, a]


@loop
def clear_way(points, planes, direction, step):
    """Take out of a direction what leads into half-spaces within twice a step along it; whether
    anything did.
    """
    cleared = False
    for c in range(len(planes.point) if step != 0.0 else 0):
        i = planes.point[c]
        value, along = planes.gap[c], 0.0
        for a in range(3):
            value += planes.normal[c, a] * (points[i, a] - planes.anchor[c, a])
            along += planes.normal[c, a] * direction[i, a]
        if step * along < 0.0 and value + 2.0 * step * along < 0.0:
            for a in range(3):
                direction[i, a] -= along * planes.normal[c, a]
            cleared = True
    return cleared
