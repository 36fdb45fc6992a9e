"""Vertices of a shown surface on their way, the level that gives them their volume, and the bones
that they are kept out of.
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from rbfmuscle.bones.distance import (
    BoneArrays,
    Memory,
    ask,
    least_distance,
    near_loop,
)
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.exact_distance import STACK
from rbfmuscle.geometry.frames import dot, local_point, row_of, turned
from rbfmuscle.geometry.point_grid import PointGrid, push_off
from rbfmuscle.geometry.surfaces import faces_around, normal_at
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.implicit.evaluation import Blend
from rbfmuscle.loops import loop
from rbfmuscle.simulation.contact import BonesInReach
from rbfmuscle.surface.display import neighbour_lists

# Rings of vertices on which a displacement fades, by so much on each.
RINGS, FADE = 3, 0.6


class Shown(NamedTuple):
    """What never changes of a shown mesh: n vertices, m outward triangles."""

    rest: Floats  # (n, 3) the vertices at rest
    faces: Integers  # (m, 3)
    links: tuple[Integers, Integers]  # the neighbours of each vertex, as `neighbour_lists` has them
    around: tuple[Integers, Integers]  # the faces around each vertex, as `faces_around` has them
    tree: FaceTree
    weights: Blend | None  # of the local fits at the vertices, None without a field
    offset: Floats  # (n,) level offset, the field's value at rest
    slope: Floats  # (n,) |grad F| at rest
    side: Floats  # (n,) longest side of the triangles around a vertex at rest [scene unit]
    volume: float  # at rest [scene unit cubed]
    edge: float  # mean length of an edge at rest [scene unit]

    @classmethod
    def of(
        cls,
        rest: Floats,
        faces: Integers,
        volume: float,
        *,
        weights: Blend | None,
        offset: Floats,
        slope: Floats,
    ) -> "Shown":
        """A mesh, and what its field is at rest."""
        count = len(rest)
        sides = np.linalg.norm(rest[faces] - rest[np.roll(faces, 1, axis=1)], axis=2)
        longest = np.zeros(count)
        np.maximum.at(longest, faces.ravel(), np.repeat(sides.max(axis=1), 3))
        return cls(
            rest,
            faces,
            neighbour_lists(faces, count),
            faces_around(faces, count),
            FaceTree(rest, faces),
            weights,
            offset,
            slope,
            longest,
            volume,
            float(sides.mean()),
        )

    def touching(self, rows: Integers) -> Integers:
        """Triangles with one of some vertices as a corner."""
        found = np.zeros(len(self.faces), dtype=np.bool_)
        _mark_loop(rows, *self.around, found)
        return np.flatnonzero(found)

    def grown(self, rows: Integers, rings: int = 1) -> Integers:
        """Some vertices and those on so many rings around them."""
        for _ in range(rings):
            found = np.zeros(len(self.rest), dtype=np.bool_)
            found[rows] = True
            _mark_loop(rows, *self.links, found)
            rows = np.flatnonzero(found)
        return rows

    def graph(self, rows: Integers) -> csr_matrix:
        """Sparse (k, k), 1 between neighbours of some vertices (k,)."""
        start, other = self.links
        whole = csr_matrix((np.ones(len(other)), other, start), (len(self.rest),) * 2)
        return whole[rows][:, rows]

    def means(self, rows: Integers, values: Floats) -> Floats:
        """Means (k, 3) of the values (n, 3) at the neighbours of some vertices (k,)."""
        found = np.zeros((len(rows), 3))
        everywhere = np.ones(len(values), dtype=np.bool_)
        _mean_loop(rows, *self.links, everywhere, values, found)
        return found

    def spread(self, displacement: Floats) -> Integers:
        """Let a displacement (n, 3) of some vertices fade away over rings around them; the vertices
        that it has then.
        """
        rows = np.flatnonzero(displacement.any(axis=1))
        for _ in range(RINGS):
            marked = np.zeros(len(displacement), dtype=np.bool_)
            marked[rows] = True
            wider = self.grown(rows)
            ring = wider[~marked[wider]]
            found = np.zeros((len(ring), 3))
            _mean_loop(ring, *self.links, marked, displacement, found)
            displacement[ring] = FADE * found
            rows = wider
        return rows


@loop
def _mark_loop(rows, start, other, found):
    """Mark what belongs to some vertices, as their neighbours or triangles."""
    for v in rows:
        for n in range(start[v], start[v + 1]):
            found[other[n]] = True


@loop
def _mean_loop(rows, start, other, marked, values, means):
    """Means (k, 3) of the values (n, 3) at the neighbours, of those that are marked, of some
    vertices (k,).
    """
    for k in range(len(rows)):
        v = rows[k]
        count = 0
        for n in range(start[v], start[v + 1]):
            if marked[other[n]]:
                count += 1
                for a in range(3):
                    means[k, a] += values[other[n], a]
        for a in range(3):
            means[k, a] /= count


class Sheet(NamedTuple):
    """A surface on its way; arrays by vertex, changed in place."""

    carried: Floats  # (n, 3) where the material carries the vertices
    vertices: Floats  # (n, 3)
    direction: Floats  # (n, 3) motion for a unit of level; 0 where something else holds a vertex
    bounded: Booleans  # (n,) kept from a level set that is too far away
    suspect: Booleans  # (n,) beside which triangles may cross others

    @classmethod
    def at(cls, carried: Floats) -> "Sheet":
        """The surface where the material carries it."""
        flags = np.zeros((2, len(carried)), dtype=np.bool_)
        return cls(carried, carried.copy(), np.zeros_like(carried), flags[0], flags[1])

    def shift(self, change: float) -> None:
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices[:] += change * self.direction

    def displace(self, displacement: Floats) -> None:
        """Move vertices by a displacement (n, 3), where they stay."""
        if not displacement.any():
            return
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
        # Vertices that each bone may be within reach of.
        self._all = np.arange(len(shown.rest))
        self._near = [self._all for _ in bones.names]

    def find_near(self, points: Floats) -> None:
        """Find the vertices that a bone may be within reach of, where they are at points (n, 3)."""
        bones = range(len(self._bones))
        self._near = [self._within_reach(bone, points, self._all) for bone in bones]

    def _within_reach(self, bone: int, points: Floats, rows: Integers) -> Integers:
        """Those of some vertices that a bone may be within reach of, by the bound of the distance
        that is known of each, which shrinks as the vertex moves.
        """
        boxes, memory = self._bones[bone].boxes, self._memories[bone]
        near = np.empty(len(rows), dtype=np.bool_)
        given = points, rows, self._reach, memory.anchor, memory.bound
        near_loop(boxes, self._poses[bone], *given, near)
        return rows[near]

    def lift(self, sheet: Sheet, rows: Integers | None = None) -> Integers:
        """Move vertices that lie in a bone onto it, where they stay: these.

        Of ``rows``; without them, of those that `find_near` found. What looks away from the bone
        keeps off it, so that both sides of a muscle that sinks into it stay apart.
        """
        shown = self._shown
        lifted = np.zeros(len(sheet.vertices), dtype=np.bool_)
        material = sheet.carried, shown.faces, shown.around, shown.edge
        moved = sheet.vertices, sheet.direction, sheet.suspect, lifted
        for number, memory in enumerate(self._memories):
            some = self._near[number] if rows is None else rows
            given = self._bones[number], self._poses[number], *memory, *material, *moved
            in_chunks(len(some), partial(_lift_some, some, given))
        return np.flatnonzero(lifted)

    def push_off(self, sheet: Sheet, among: Booleans | None = None) -> None:
        """Move the corners of triangles that a bone's vertices came through, of those with a corner
        in ``among`` (n,), and out of the bones again what that drove into another.
        """
        shown, count = self._shown, len(sheet.vertices)
        for _ in range(2):
            moved = np.zeros(count, dtype=np.bool_)
            for bone, near in enumerate(self._near):
                rows = near if among is None else near[among[near]]
                some = shown.touching(self._within_reach(bone, sheet.vertices, rows))
                given = self._grids[bone], self._poses[bone], shown.edge
                push_off(sheet.vertices, shown.faces, *given, moved, some)
            rows = np.flatnonzero(moved)
            sheet.suspect[rows] = True
            sheet.hold(rows)
            if len(self.lift(sheet, rows)) == 0:
                return
            among = np.zeros(count, dtype=np.bool_)
            among[shown.grown(rows)] = True


def _lift_some(rows: Integers, given: tuple, start: int, stop: int) -> None:
    _lift_loop(rows[start:stop], *given)


@loop
def _lift_loop(
    rows,
    bone,
    pose,
    anchor,
    bound,
    triangle,
    carried,
    faces,
    around,
    edge,
    vertices,
    direction,
    suspect,
    lifted,
):
    """Move some vertices onto a bone that they lie in, and mark them."""
    stack = np.empty(STACK, np.int64)
    squares = np.empty(STACK)
    known = anchor, bound, triangle
    out = -OUT * edge
    for v in rows:
        for _ in range(LIFTS):
            local = local_point(pose, row_of(vertices, v))
            if least_distance(bone.boxes, local, row_of(anchor, v), bound[v]) > out:
                break
            distance, way = ask(bone, local, known, v, stack, squares)
            if distance >= out:
                break
            outward = turned(pose, way)
            away = dot(normal_at(carried, faces, around, v), outward)
            height = LAMELLA * edge * max(away, 0.0) - distance
            suspect[v] |= distance < -SUNK * edge
            lifted[v] = True
            for k in range(3):
                vertices[v, k] += height * outward[k]
                direction[v, k] = 0.0
