"""A block of an elastic solid between two bones, for tests of the solid."""

import numpy as np
import trimesh

from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.muscle.solid import EmbeddedSolid
from rbfmuscle.simulation.contact import BoneContacts

NO_BONES = [], []


def bar(nodes=150, iterations=100, size=(40.0, 10.0, 8.0)):
    """A block whose ends two bones hold, with its surface's vertices as contact points."""
    block = trimesh.creation.box(extents=size)
    for _ in range(4):
        block = block.subdivide()
    frame = RestFrame(block.vertices)
    points = np.asarray(block.vertices)
    half = 0.5 * size[0] - 1e-9
    owner = np.select([points[:, 0] <= -half, points[:, 0] >= half], [0, 1], -1)
    lattice = Lattice(frame.local, np.asarray(block.faces), nodes)
    held = np.flatnonzero(owner >= 0)
    return EmbeddedSolid(
        lattice, frame, points, owner, held, count=len(points), free=np.flatnonzero(owner < 0),
        area=float(block.area) / len(points), iterations=iterations, bones={},
    )  # fmt: skip


def with_fibres(solid, along, ratio=1.0, slack=1.0):
    """Give the solid fibres along a direction, stiffer by a ratio of Young's moduli, slack down to 1 / slack."""
    count = len(solid.weights)
    direction = np.tile(np.asarray(along, dtype=float), (count, 1))
    stiff, lower = np.full(count, 1.5 * (ratio - 1.0)), np.full(count, 1.0 / slack)
    solid.take_fibres(solid.fibres._replace(direction=direction, passive=stiff, lower=lower))
    return solid


def settle(solid, motion):
    """The second bone moves by a 4x4 transform."""
    solid.move(np.array([np.eye(4), motion]), {0: np.eye(4), 1: motion})
    solid.settle(BoneContacts(*NO_BONES, contact_bone=solid.owner))


def shift(x):
    motion = np.eye(4)
    motion[0, 3] = x
    return motion
