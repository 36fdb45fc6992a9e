"""A bone as a body among the muscles that it holds: it goes where the motion takes it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.simulation.touching import NOTHING, Body, Wanted

NO_POINTS = Body(np.zeros(0, dtype=np.int64), np.zeros(1), np.zeros(0))


class StillRows:
    """What unit forces at w contacts do to a bone: nothing."""

    def __init__(self, count: int) -> None:
        self.delassus = np.zeros((count, count))

    def motion(self, force: Floats) -> Floats:
        """No motion (1, 3)."""
        return np.zeros((1, 3))


class HeldBone:
    """A bone that muscles are held to; implements ``rbfmuscle.simulation.touching.Moving``.

    Parameters
    ----------
    field : BoneSDF
    pose : (4, 4) ndarray
        Changed in place by whoever moves the bone.
    """

    size = np.inf
    asleep = True
    forces_capped = False
    iterations = 0

    def __init__(self, field: BoneSDF, pose: Floats) -> None:
        self.field, self.pose = field, pose
        self.nodes = np.zeros((1, 3))
        self.step = np.zeros((1, 3))

    def free_step(self) -> None:
        """None: the motion moves it."""

    def meet(self) -> Wanted:
        """Nothing."""
        return NOTHING

    def feet_of(self, points: Integers) -> Embedding:
        """Places that no force moves."""
        return Embedding(np.zeros((len(points), 1), dtype=np.int64), np.zeros((len(points), 1)))

    def rows_of(self, points: Integers, normal: Floats, feet: Embedding | None) -> StillRows:
        """What forces along ``normal`` (w, 3) do: nothing."""
        return StillRows(len(normal))

    def push(self, motion: Floats | None, rows: StillRows, force: Floats, asked: Wanted) -> None:
        """Bear the forces."""

    def advance(self) -> None:
        """Stay."""

    def ask(self, points: Floats, place: NDArray[np.float64]) -> tuple[Floats, Floats, Embedding]:
        """Gaps (k,) of points (k, 3) to the bone, their normals (k, 3) and feet."""
        gap, normal = self.field.distance_and_gradient(points, self.pose)
        return gap, normal, self.feet_of(np.arange(len(points)))

    def contact_law(self, points: Integers, area: Floats) -> tuple[Floats, Floats]:
        """None: it has no contact points."""
        return np.zeros(len(points)), np.zeros(len(points))
