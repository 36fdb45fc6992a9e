"""How the inside of a muscle meets bones and neighbours: softly while it settles, exactly in the end.

A surface of points that slides over a bone of flat facets rests in many places: each point has to be lifted over each
edge, as one cog over the other. A muscle on a bone has no such places. So what settles is a muscle whose contacts
give way a little, on bones whose facets are rounded off (`RoundedField`): one shape for each pose. What is left in a
bone after that is lifted out of it in the metric of the energy, volumes kept. The shape that settled goes on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.model.inside.loops import carry_loop, touch_loop
from rbfmuscle.model.inside.rounded import RoundedField

CONTACT_TOLERANCE = 2e-5  # of the muscle's size
REACH_MARGIN = 0.003
NEAR = 0.03  # points nearer to an obstacle than this take part in a solve
CONTACT_ROUNDS, CONTACT_SWEEPS = 10, 400
# How far a contact gives way, of the muscle's size, under a pressure of twice the shear modulus.
SOFT = 6e-5
ROUND = 0.007  # edge of the cells that a bone is rounded over, of the muscle's size
LIFTS = 3  # times that what is left in a bone is lifted out of it, at most


class Near(NamedTuple):
    """Contact points near an obstacle: their indices and embedding, forces on them, obstacles, nodes then.

    ``exact`` are the obstacles as they are, ``contacts`` rounded.
    """

    which: np.ndarray
    columns: np.ndarray
    shares: np.ndarray
    forces: np.ndarray
    contacts: Any
    exact: Any
    y: np.ndarray
    reach: float


class Obstacles:
    """What the contact points of an `Interior` meet.

    Parameters
    ----------
    solid : Interior
    area : float
        Of the surface that a contact point stands for [scene unit squared].
    """

    def __init__(self, solid: Any, area: float) -> None:
        self.solid, self.scale = solid, solid.scale
        self.reach = NEAR * self.scale
        self.yielding = SOFT * self.scale / area
        self._round: dict[int, RoundedField] = {}

    def rounded(self, contacts: Any) -> Any:
        """These obstacles with rounded bones, for questions that leave nothing behind."""
        other = contacts.frozen()
        other.fields = list(contacts.fields)
        for b in contacts.reached:
            field = contacts.fields[b]
            if b not in self._round or self._round[b].field is not field:
                self._round[b] = RoundedField(field, self.solid.frame, ROUND * self.scale)
            other.fields[b] = self._round[b]
        return other

    def near(self, contacts: Any, before: Near | None) -> Near:
        """The contact points near an obstacle, with what pushed them until now."""
        solid = self.solid
        if before is not None:
            solid.forces[:] = 0.0
            solid.forces[before.which] = before.forces
        sources = max(1, len(contacts.names) + len(contacts.neighbours))
        if solid.forces.shape[1] != sources:
            solid.forces = np.zeros((len(solid.points), sources))
        index = np.arange(len(solid.points))
        if not contacts.neighbours:
            index = np.unique(contacts.half_spaces(solid.carry_from(solid.y), self.reach).index)
            contacts = contacts.only(index)
        return Near(
            index, solid.columns[index], solid.shares[index], solid.forces[index], self.rounded(contacts),
            contacts, solid.y.copy(), self.reach,
        )  # fmt: skip

    def push(self, near: Near, y: Floats, step: Floats) -> tuple[Floats, Floats]:
        """What contacts add (N, 3) to a step of the nodes from y, and what they take from the whitened pressures."""
        here, there = _carried(near, y), _carried(near, step)
        motion = there - here
        spaces = near.contacts.half_spaces(
            here, 1.5 * np.sqrt((motion**2).sum(axis=1)) + REACH_MARGIN * self.scale
        )
        return self._touch(near, spaces, motion, near.forces, self.yielding)

    def lifted(self, near: Near) -> Floats:
        """The settled nodes (N, 3), moved so far that no contact point is left in an obstacle."""
        y, tolerance = self.solid.y, CONTACT_TOLERANCE * self.scale
        for _ in range(LIFTS):
            here = _carried(near, y)
            spaces = near.exact.half_spaces(here, REACH_MARGIN * self.scale)
            if spaces.gap.min(initial=0.0) > -tolerance:
                break
            y = y + self._touch(near, spaces, np.zeros_like(here), np.zeros_like(near.forces), 0.0)[0]
        return y

    def _touch(
        self, near: Near, spaces: Any, motion: Floats, forces: Floats, yielding: float
    ) -> tuple[Floats, Floats]:
        solid = self.solid
        push, taken = np.empty_like(solid.y), np.empty(len(solid.pressure))
        touch_loop(
            spaces.index, spaces.gap, spaces.normal, spaces.source % forces.shape[1], motion, solid.inverse,
            near.columns, near.shares, solid.response, forces,
            solid.batch, CONTACT_ROUNDS, CONTACT_SWEEPS, CONTACT_TOLERANCE * self.scale, yielding, push, taken,
        )  # fmt: skip
        return push, taken


def _carried(near: Near, y: Floats) -> Floats:
    out = np.empty((len(near.which), 3))
    carry_loop(y, near.columns, near.shares, out)
    return out
