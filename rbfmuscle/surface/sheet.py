"""Vertices of a shown surface on their way, and the level that gives them their volume."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.surfaces import volume_cubic
from rbfmuscle.implicit.evaluation import Blend

# Newton steps of the cubic polynomial of the volume.
CUBIC = 4
# Rings of vertices on which a displacement fades, by so much on each.
RINGS, FADE = 3, 0.6


class Shown(NamedTuple):
    """What never changes of a shown mesh: n vertices, m outward triangles."""

    rest: Floats  # (n, 3) the vertices at rest
    faces: Integers  # (m, 3)
    links: csr_matrix  # (n, n) 1 between neighbours
    degree: Floats  # (n,) how many neighbours a vertex has
    tree: FaceTree
    weights: Blend | None  # of the local fits at the vertices, None without a field
    offset: Floats  # (n,) level offset, the field's value at rest
    slope: Floats  # (n,) |grad F| at rest
    side: Floats  # (n,) longest side of the triangles around a vertex at rest [scene unit]
    volume: float  # at rest [scene unit cubed]
    edge: float  # mean length of an edge at rest [scene unit]

    def touching(self, marked: Booleans) -> Booleans:
        """Which triangles (m,) have a marked corner."""
        one, two, three = self.faces.T
        found: Booleans = marked[one] | marked[two] | marked[three]
        return found

    def grown(self, rows: Integers) -> Integers:
        """Some vertices and their neighbours."""
        return np.union1d(rows, self.links[rows].indices)

    def spread(self, displacement: Floats) -> Integers:
        """Let a displacement (n, 3) of some vertices fade away over rings around them; the vertices
        that it has then.
        """
        rows = np.flatnonzero(displacement.any(axis=1))
        for _ in range(RINGS if len(rows) else 0):
            marked = np.zeros(len(displacement))
            marked[rows] = 1.0
            ring = np.setdiff1d(self.links[rows].indices, rows)
            near = self.links[ring]
            displacement[ring] = FADE * (near @ displacement) / (near @ marked)[:, None]
            rows = np.concatenate([rows, ring])
        return rows


class Sheet(NamedTuple):
    """A surface on its way; arrays by vertex, changed in place."""

    carried: Floats  # (n, 3) where the material carries the vertices
    vertices: Floats  # (n, 3)
    direction: Floats  # (n, 3) motion for a unit of level; 0 where something else holds a vertex
    normals: Floats  # (n, 3) unit, of the carried surface; 0 until they are asked for
    bounded: Booleans  # (n,) kept from a level set that is too far away
    suspect: Booleans  # (n,) beside which triangles may cross others

    @classmethod
    def at(cls, carried: Floats) -> "Sheet":
        """The surface where the material carries it."""
        flags = np.zeros((2, len(carried)), dtype=np.bool_)
        nothing = np.zeros((2, *carried.shape))
        return cls(carried, carried.copy(), nothing[0], nothing[1], flags[0], flags[1])

    def shift(self, change: float) -> None:
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices[:] += change * self.direction

    def displace(self, displacement: Floats) -> None:
        """Move vertices by a displacement (n, 3), where they stay."""
        rows = np.flatnonzero(displacement.any(axis=1))
        self.vertices[rows] += displacement[rows]
        self.suspect[rows] = True
        self.hold(rows)

    def hold(self, rows: Integers | Booleans) -> None:
        """Let some vertices stay where they are when the level changes."""
        self.direction[rows] = 0.0


def level_change(shown: Shown, sheet: Sheet) -> float:
    """Change of the level that brings a surface to its volume, a cubic polynomial of the change;
    NaN where none does.
    """
    c0, c1, c2, c3 = volume_cubic(sheet.vertices, shown.faces, sheet.direction)
    change = 0.0
    for _ in range(CUBIC):
        lack = shown.volume - (c0 + change * (c1 + change * (c2 + change * c3)))
        if lack == 0.0:
            break
        rate = c1 + change * (2.0 * c2 + change * 3.0 * c3)
        if not rate > 0.0:
            return np.nan
        change += lack / rate
    return change
