"""Vertices of a shown surface on their way, the level that gives them their volume, and the bones
that they are kept out of.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from rbfmuscle.bones.distance import BoneArrays, Memory, distances
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.point_grid import PointGrid, push_off
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.evaluation import Blend
from rbfmuscle.simulation.contact import BonesInReach

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


# No point of a triangle is farther from a corner than its longest side over root 3, and a bone's
# vertex behind it, which pushes it, no deeper than a third of that side; in longest sides, which
# may stretch by a fifth.
NEAR_FACE = 1.2 * 0.8
# Lengths below are in mean edges of the mesh at rest.
OUT = 1e-5  # what is no deeper in a bone counts as out of it
SUNK = 1.0  # deeper in a bone the material is sunk
LAMELLA = 0.02  # where both sides of a muscle sink into a bone, the far one stays above it by this
LIFTS = 2  # rounds of moving what lies in a bone onto it, at most


class ShownBones:
    """The bones in reach of a shown surface, and what is known of their distances.

    ``poses`` (r, 4, 4) are those of the bones, which may change in place, ``grids`` those of their
    vertices, by name. What is known changes no result.
    """

    def __init__(
        self, shown: Shown, bones: BonesInReach, poses: Floats, grids: Mapping[str, PointGrid]
    ) -> None:
        self._shown = shown
        self._poses = poses
        self._bones: list[BoneArrays] = [field.arrays for field in bones.fields]
        self._grids = [grids[name] for name in bones.names]
        self._memories = [Memory.of(len(shown.rest)) for _ in bones.names]
        self._reach = NEAR_FACE * shown.side
        # Vertices that each bone may be within reach of, and what is known of these alone.
        nothing = np.zeros(0, dtype=np.int64)
        self._near = [nothing for _ in bones.names]
        self._known = [Memory.of(0) for _ in bones.names]

    def find_near(self, points: Floats) -> None:
        """Find the vertices that a bone may be within reach of, where these are at points (n, 3).

        A bound of the distance is kept for each, which shrinks as the vertex moves. The bone is
        asked only where it falls below the reach, or below what it was when it was found.
        """
        unbounded = np.full(len(points), -np.inf)
        for bone, memory in enumerate(self._memories):
            asked = self._bones[bone], self._poses[bone]
            least, _ = distances(*asked, points, unbounded, memory)
            stale = np.flatnonzero((least < self._reach) & (memory.bound >= self._reach))
            known = memory.some(stale)
            least[stale], _ = distances(*asked, points[stale], self._reach[stale], known)
            for part, values in zip(memory, known):
                part[stale] = values
            self._near[bone] = np.flatnonzero(least < self._reach)
            self._known[bone] = memory.some(self._near[bone])

    def lift(self, sheet: Sheet, rows: Integers | None = None) -> Integers:
        """Move vertices that lie in a bone onto it, where they stay: these.

        Of ``rows``; without them, of those that `find_near` found. What looks away from the bone
        keeps off it, so that both sides of a muscle that sinks into it stay apart.
        """
        moved = []
        for bone in range(len(self._bones)):
            if rows is None:
                some, known = self._near[bone], self._known[bone]
            else:
                some, known = rows, self._memories[bone].some(rows)
            for _ in range(LIFTS):
                points = sheet.vertices[some]
                distance, outward = distances(
                    self._bones[bone], self._poses[bone], points, np.zeros(len(some)), known
                )
                inside = np.flatnonzero(distance < -OUT * self._shown.edge)
                if len(inside) == 0:
                    break
                some, known = some[inside], known.some(inside)
                self._move_onto(sheet, some, distance[inside], outward[inside])
                moved.append(some)
        return np.unique(np.concatenate(moved)) if moved else np.zeros(0, dtype=np.int64)

    def _move_onto(self, sheet: Sheet, rows: Integers, distance: Floats, outward: Floats) -> None:
        """Move vertices onto a bone that they lie in by a ``distance`` (k,) below zero, which grows
        ``outward`` (k, 3).
        """
        edge = self._shown.edge
        if not sheet.normals.any():
            sheet.normals[:] = vertex_normals(sheet.carried, self._shown.faces)
        away = np.einsum("ij,ij->i", sheet.normals[rows], outward)
        height = LAMELLA * edge * np.maximum(away, 0.0) - distance
        sheet.suspect[rows] |= distance < -SUNK * edge
        sheet.vertices[rows] += height[:, None] * outward
        sheet.hold(rows)

    def push_off(self, sheet: Sheet, among: Booleans | None = None) -> None:
        """Move the corners of triangles that a bone's vertices came through, of those with a corner
        in ``among`` (n,), and out of the bones again what that drove into another.
        """
        shown, count = self._shown, len(sheet.vertices)
        for _ in range(2):
            moved = np.zeros(count, dtype=np.bool_)
            for grid, pose, near in zip(self._grids, self._poses, self._near):
                some = np.zeros(count, dtype=np.bool_)
                some[near] = True if among is None else among[near]
                if some.any():
                    push_off(sheet.vertices, shown.faces, grid, pose, shown.edge, moved, some)
            rows = np.flatnonzero(moved)
            sheet.suspect[rows] = True
            sheet.hold(rows)
            if len(self.lift(sheet, rows)) == 0:
                return
            among = np.zeros(count, dtype=np.bool_)
            among[shown.grown(rows)] = True
