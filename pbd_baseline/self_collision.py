"""Self-collision of a mesh muscle: the surface is smoothed where it crosses itself, until it does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pbd_baseline.rest import RestState
from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.rotations import smooth_displacement
from rbfmuscle.jit import compiled

# Rounds of smoothing, how many of them until the smoothed region grows by a ring, and sweeps in each.
ROUNDS, GROWTH, SWEEPS = 48, 4, 4
# Share of the way to the middle of its neighbours that a vertex goes in a sweep.
SHARE = 0.5
# What was smoothed swells by what it lost, at most by this share of an edge, and in the last round by this besides.
MOST, SWELL = 0.5, 0.6

# Where that leaves crossings, what the muscle does beside a rigid motion is smoothed so often, until none is left.
CALM = (30, 120, 500, 2000)


class SelfCollision:
    """Finds triangles that cross others, and smooths around them in a region that grows until none does.

    Parameters
    ----------
    rest : RestState
    """

    def __init__(self, rest: RestState) -> None:
        self.rest, self.topology, self.volume = rest.vertices, rest.topology, rest.volume
        self.edge = rest.edge()
        self.tree = FaceTree(rest.vertices, rest.topology.faces)

    def untangle(self, points: Floats, settle: Callable[[], object]) -> int:
        """Smooth what crosses itself, in place; how many triangles still do.

        Parameters
        ----------
        points : (n, 3) ndarray
        settle : callable
            Brings contact and volume back after each round.
        """
        left = self._untangle(points, settle)
        if left == 0:
            return 0
        tangled = points.copy()
        for sweeps in CALM:
            points[:] = self.smooth_displacement(tangled, sweeps)
            settle()
            left = self._untangle(points, settle)
            if left == 0:
                break
        return left

    def smooth_displacement(self, points: Floats, sweeps: int) -> Floats:
        """The shape at rest, moved as the muscle on the whole, and deformed as it is where that is smooth, (n, 3)."""
        rows = np.arange(len(points))

        def smooth(beside: Floats) -> None:
            for _ in range(sweeps):
                smooth_loop(beside, rows, self.topology.ring_start, self.topology.ring, SHARE)

        return smooth_displacement(self.rest, points, smooth)

    def _untangle(self, points, settle):
        faces, among = self.topology.faces, None
        for turn in range(ROUNDS):
            bad = self.tree.crossing(points, among)
            if not bad.any() and among is not None:
                bad = self.tree.crossing(points)
            if not bad.any():
                return 0
            marked = np.zeros(len(points), dtype=np.bool_)
            marked[faces[bad].ravel()] = True
            region = self.around(marked, 1 + turn // GROWTH)
            among = region[faces].any(axis=1)
            self._smooth(points, np.flatnonzero(region), SWELL * self.edge * turn / ROUNDS)
            settle()
        return int(self.tree.crossing(points).sum())

    def _smooth(self, points, rows, swell):
        """Smooth some vertices, and swell what was smoothed by the volume that it lost, and by a length."""
        ring = self.topology.ring_start, self.topology.ring
        before = self.volume.volume(points)
        for _ in range(SWEEPS):
            smooth_loop(points, rows, *ring, SHARE)
        normals = self.volume.gradient(points)[rows]
        area = np.linalg.norm(normals, axis=1)
        lost = max(0.0, before - self.volume.volume(points)) / max(area.sum(), 1e-300)
        points[rows] += (min(lost, MOST * self.edge) + swell) * normals / np.maximum(area, 1e-300)[:, None]

    def around(self, marked: Booleans, rings: int) -> Booleans:
        """Vertices within some rings of those marked (n,)."""
        for _ in range(rings):
            wider = marked.copy()
            edges = self.topology.edges
            wider[edges[marked[edges[:, 0]], 1]] = True
            wider[edges[marked[edges[:, 1]], 0]] = True
            marked = wider
        return marked


@compiled
def smooth_loop(points, rows, start, ring, share):
    """Move vertices by a share of the way to the middle of their neighbours, all at once."""
    moved = np.empty((len(rows), 3))
    for r in range(len(rows)):
        i = rows[r]
        for a in range(3):
            total = 0.0
            for k in range(start[i], start[i + 1]):
                total += points[ring[k], a]
            moved[r, a] = points[i, a] + share * (total / (start[i + 1] - start[i]) - points[i, a])
    for r in range(len(rows)):
        for a in range(3):
            points[rows[r], a] = moved[r, a]
