"""A mesh muscle on its way to rest, among those that it touches: a sweep in each iteration.

A contact with a neighbour is a constraint as others of PBD are: it moves a vertex by its inverse
mass, and the corners of the triangle that it meets by theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pbd_baseline.moving_surface import MovingSurface
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.geometry.surfaces import farthest_move
from rbfmuscle.simulation.touching import NOTHING, Wanted


class Sweeps(NamedTuple):
    """Which sweeps a mesh muscle makes."""

    sweep: Callable[[int], None]  # does one, of this number, on the points in place
    most: int
    still: float  # a motion of vertices that ends them; 0 for none [scene unit]


class MeshRows(NamedTuple):
    """What unit forces at w contacts do to n vertices."""

    places: Embedding
    normal: Floats  # (w, 3)
    inverse_mass: Floats  # (n,)
    delassus: Floats  # (w, w)

    def motion(self, force: Floats) -> Floats:
        """Motion (n, 3) of the vertices by contact forces (w,)."""
        out = np.zeros((len(self.inverse_mass), 3))
        columns, shares = self.places
        along = shares[:, :, None] * (force[:, None] * self.normal)[:, None]
        np.add.at(out, columns, along)
        return out * self.inverse_mass[:, None]


class MeshSettling:
    """One mesh muscle on its way to rest; implements ``rbfmuscle.simulation.touching.Moving``.

    ``points`` (n, 3) are moved in place; ``surface`` is what others meet, None where none do.
    """

    def __init__(
        self,
        points: Floats,
        inverse_mass: Floats,
        size: float,
        sweeps: Sweeps,
        surface: MovingSurface | None,
    ) -> None:
        self.size = size
        self.nodes = points
        self.step = np.zeros_like(points)
        self.asleep = False
        self.forces_capped = False
        self.iterations = 0
        self.moved = np.inf
        self.inverse_mass = inverse_mass
        self.sweeps = sweeps
        self.surface = surface

    def free_step(self) -> None:
        """One sweep, with bones and the volume; none where it sleeps."""
        if self.asleep:
            self.step[:] = 0.0
            return
        before = self.nodes.copy()
        self.sweeps.sweep(self.iterations)
        self.step = self.nodes - before
        self.nodes[:] = before

    def meet(self) -> Wanted:
        """Nothing: a sweep meets bones itself."""
        return NOTHING

    def feet_of(self, points: Integers) -> Embedding:
        """Vertices (w,), each alone."""
        return Embedding(
            points[:, None].repeat(3, axis=1), np.tile([1.0, 0.0, 0.0], (len(points), 1))
        )

    def rows_of(self, points: Integers, normal: Floats, feet: Embedding | None) -> MeshRows:
        """What unit forces along ``normal`` (w, 3) at vertices, and behind them at ``feet``, do."""
        columns, shares = self.feet_of(points)
        if feet is not None:
            columns = np.concatenate([columns, feet.columns])
            shares = np.concatenate([shares, feet.shares])
        # Only the vertices that are met matter.
        met, place = np.unique(columns, return_inverse=True)
        dense = np.zeros((len(columns), len(met)))
        np.add.at(dense, (np.arange(len(columns))[:, None], place.reshape(columns.shape)), shares)
        delassus = (normal @ normal.T) * (dense * self.inverse_mass[met] @ dense.T)
        return MeshRows(Embedding(columns, shares), normal, self.inverse_mass, delassus)

    def push(self, motion: Floats | None, rows: MeshRows, force: Floats, asked: Wanted) -> None:
        """Add the motion (n, 3) by contact forces to the step."""
        if motion is not None:
            self.step += motion

    def advance(self) -> None:
        """Take the step; asleep after the last sweep, or one that moved nothing any more."""
        if self.asleep:
            return
        before = self.nodes.copy()
        self.nodes += self.step
        self.iterations += 1
        self.moved = farthest_move(before, self.nodes)
        if self.surface is not None:
            self.surface.move(self.nodes)
        self.asleep = self.moved < self.sweeps.still or self.iterations >= self.sweeps.most

    def ask(self, points: Floats, place: Integers) -> tuple[Floats, Floats, Embedding]:
        """Gaps (k,) of points (k, 3) to this muscle, their normals (k, 3) and feet; the search
        begins at vertices ``place`` (k,), which are brought up to date.
        """
        assert self.surface is not None
        count = len(points)
        normal = np.empty((count, 3))
        feet = Embedding(np.empty((count, 3), dtype=np.int64), np.empty((count, 3)))
        gap = self.surface.ask(points, place, *feet, normal)
        return gap, normal, feet

    def contact_law(self, points: Integers, area: Floats | float) -> tuple[Floats, float]:
        """No greatest force, and hard contacts."""
        return np.full(len(points), np.inf), 0.0
