"""How the elastic solid of a muscle meets bones and neighbours: yielding while it settles, exactly
in the end.

A surface of points on a bone of flat facets has many equilibria, because each point has to be
lifted over each edge. A muscle on a bone has not. So the solid settles with contacts that yield a
little, on bones whose facets are rounded (`RoundedBones`): one shape for each pose. What is then
left in a bone is lifted out of it in the metric of the energy, volumes kept. The next sub-step
starts from the settled shape, not from the lifted one.
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.muscle.carrier import Carrier
from rbfmuscle.muscle.rounded_bones import RoundedBones, RoundedContacts, bone_thickness
from rbfmuscle.muscle.solid_loops import carry_loop, contact_loop
from rbfmuscle.muscle.solid_step import ways_loop
from rbfmuscle.simulation.contact import BoneContacts, HalfSpaces

TOLERANCE = 2e-5  # violation of a contact that is left, of the muscle's size
REACH_MARGIN = 0.003  # of the muscle's size
# contact points nearer to an obstacle than this take part in a solve, of the muscle's size
NEAR = 0.03
# contacts that join the working set in one round, rounds, sweeps in each
BATCH = 24
ROUNDS = 10
SWEEPS = 400
# How far a contact yields under a pressure of 2 μ, of the muscle's size, and the greatest pressure
# that it takes, over 2 μ. With 5 the gluteus maximus is pressed 6.6 mm into the femur in 90 degrees
# of flexion.
YIELDING, MOST_CONTACT_PRESSURE = 1e-4, 40.0
SHOWN_YIELDING = (
    0.1  # share of YIELDING by which obstacles yield where room is made in what is shown
)
# Edge of the cells that a bone is rounded over, relative to the spacing of the samples. With 0.7 to
# 1.0 one pose of the phantom's extensor has shapes 0.6 to 1.6 mm RMS apart, from 1.5 to 2 at most
# 0.06.
ROUNDING = 1.7
LEAST_ROUNDING = 0.1  # of that
LIFTS = 3  # linear steps, at most, that lift what is left in a bone out of it


class Solid(Protocol):
    """What contact needs of an `EmbeddedSolid`; attributes as there."""

    scale: float
    frame: RestFrame
    rest: Floats
    y: Floats
    points: Floats
    owner: Integers
    columns: Integers
    shares: Floats
    carrier: Carrier
    inverse: Floats
    response: Floats
    pressure: Floats
    forces: Floats

    def mobility(self) -> Floats:
        """Motion (n,) of each contact point for a unit force at it."""


class NearPoints(NamedTuple):
    """Contact points near an obstacle, and what they meet."""

    which: Integers  # (m,)
    columns: Integers  # (m, w) their nodes
    shares: Floats  # (m, w) shape functions
    forces: Floats  # (m, sources), changed in place
    contacts: RoundedContacts  # obstacles with rounded bones
    hard: BoneContacts  # bones as they are, and planes that do not yield
    y: Floats  # (N, 3) nodes when the points were chosen
    reach: float  # distance within which points were chosen [scene unit]
    most: Floats  # (m,) greatest force on each, over 2 μ
    softness: Floats  # (sources,) of each obstacle, relative to that of a bone

    def carry(self, y: Floats) -> Floats:
        """Positions (m, 3) for nodes (N, 3)."""
        out = np.empty((len(self.which), 3))
        carry_loop(y, self.columns, self.shares, out)
        return out


class SolidContact:
    """Contact of an `EmbeddedSolid`: forces of a linear complementarity problem through the inverse
    of its matrix.

    ``area`` is that of the surface per sample, ``bones`` has their (vertices, faces) by name.
    """

    def __init__(
        self, solid: Solid, area: float, bones: Mapping[str, tuple[Floats, Integers]]
    ) -> None:
        self.bones = bones
        self.solid, self.reach = solid, NEAR * solid.scale
        self.tolerance, self.margin = TOLERANCE * solid.scale, REACH_MARGIN * solid.scale
        self.yielding, self.most = YIELDING * solid.scale / area, self._greatest_forces(area)
        self.edge = ROUNDING * float(np.sqrt(area))
        self._round: RoundedBones | None = None
        self._last_push = np.zeros_like(solid.rest)

    def _greatest_forces(self, area: float) -> Floats:
        """Greatest force on each contact point, less where it moves less than the median for a unit
        force.

        What a bone that is driven into an attachment would need to lift the points beside it bends
        the whole muscle.
        """
        mobility = self.solid.mobility()
        free = self.solid.owner < 0
        return MOST_CONTACT_PRESSURE * area * np.minimum(1.0, mobility / np.median(mobility[free]))

    def near(self, contacts: BoneContacts, before: NearPoints | None) -> NearPoints:
        """The contact points near an obstacle, with the forces on them until now."""
        solid = self.solid
        if before is None:
            self._last_push = np.zeros_like(solid.y)
        else:
            solid.forces[:] = 0.0
            solid.forces[before.which] = before.forces
        sources = max(1, len(contacts.names) + len(contacts.neighbours))
        if solid.forces.shape[1] != sources:
            solid.forces = np.zeros((len(solid.points), sources))
        softness = np.ones(sources)
        for k, planes in enumerate(contacts.neighbours):
            softness[-1 - k] = planes.softness
        index = np.unique(contacts.half_spaces(solid.carrier.carry(solid.y), self.reach).index)
        contacts = contacts.only(index)
        return NearPoints(
            index,
            solid.columns[index],
            solid.shares[index],
            solid.forces[index],
            RoundedContacts(self._rounded(contacts), contacts, len(index)),
            contacts.unyielding(),
            solid.y.copy(),
            self.reach,
            self.most[index],
            softness,
        )

    def _rounded(self, contacts: BoneContacts) -> RoundedBones:
        """The bones in reach, rounded."""
        fields, kept = [contacts.fields[b] for b in contacts.reached], self._round
        if kept is None or [*map(id, fields)] != [*map(id, kept.fields)]:
            edges = [self._edge(contacts.fields[b], contacts.names[b]) for b in contacts.reached]
            kept = self._round = RoundedBones(
                fields, self.solid.frame, np.array(edges, dtype=np.float64)
            )
        return kept

    def _edge(self, field: BoneField, bone: str) -> float:
        """Cells over which a bone is rounded: no larger than it is thick, or a thin plate would
        vanish.
        """
        if bone not in self.bones:
            return self.edge
        thickness = bone_thickness(field, *self.bones[bone], self.edge)
        return max(thickness, LEAST_ROUNDING * self.edge)

    def push(self, near: NearPoints, y: Floats, step: Floats, part: float) -> tuple[Floats, Floats]:
        """Contact correction (N, 3) of a step of the nodes from ``y`` to ``step``, ``part`` of a
        full one.

        Also what the contacts take from the whitened pressures, (M,).
        """
        here, motion = np.empty((2, len(near.which), 3))
        reach = np.empty(len(near.which))
        # Contacts that push now push in the next iteration too: where the points will then go
        # decides what they meet.
        ways_loop(
            y, step, self._last_push, near.columns, near.shares, self.margin, here, motion, reach
        )
        spaces = near.contacts.half_spaces(here, reach)
        push, taken = self._touch(
            near, spaces, motion, near.forces, self.yielding / part, near.most * part
        )
        self._last_push = push
        return push, taken

    def parted(self, contacts: BoneContacts) -> Floats:
        """The settled nodes (N, 3), moved by the planes of neighbours and then out of bones."""
        near, y = self.near(contacts, None), self.solid.y
        spaces = near.contacts.exact.half_spaces(near.carry(y), self.margin)
        return self.lifted(near, y + self._push_out(near, spaces, SHOWN_YIELDING * self.yielding))

    def lifted(self, near: NearPoints, y: Floats) -> Floats:
        """Nodes (N, 3), moved so far that no contact point is left in an obstacle that does not
        yield.
        """
        for _ in range(LIFTS):
            spaces = near.hard.half_spaces(near.carry(y), self.margin)
            if spaces.gap.min(initial=0.0) > -self.tolerance:
                break
            y = y + self._push_out(near, spaces, 0.0)
        return y

    def _push_out(self, near: NearPoints, spaces: HalfSpaces, yielding: float) -> Floats:
        """Motion (N, 3) of nodes that stand still, out of obstacles."""
        still, none = np.zeros((len(near.which), 3)), np.zeros_like(near.forces)
        return self._touch(near, spaces, still, none, yielding, near.most)[0]

    def _touch(
        self,
        near: NearPoints,
        spaces: HalfSpaces,
        motion: Floats,
        forces: Floats,
        yielding: float,
        most: Floats,
    ) -> tuple[Floats, Floats]:
        solid, source = self.solid, spaces.source % forces.shape[1]
        push, taken = np.empty_like(solid.y), np.empty(len(solid.pressure))
        contact_loop(
            spaces.index,
            spaces.gap,
            spaces.normal,
            source,
            motion,
            solid.inverse,
            near.columns,
            near.shares,
            solid.response,
            forces,
            (BATCH, ROUNDS, SWEEPS, self.tolerance),
            (yielding * near.softness[source], most[spaces.index]),
            push,
            taken,
        )
        return push, taken
