"""The bones that a shown surface meets: vertices moved out of them, and bone vertices moved out of
the surface.
"""

from collections.abc import Mapping

import numpy as np

from rbfmuscle.bones.distance import BoneArrays, Memory, distance_loop
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.point_grid import PointGrid, push_off
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.surface.sheet import Sheet, Shown

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

    ``grids`` are those of the bones' vertices, by name. What is known changes no result.
    """

    def __init__(
        self, shown: Shown, contacts: BoneContacts, grids: Mapping[str, PointGrid]
    ) -> None:
        bones = contacts.bones
        self._shown, self._poses = shown, contacts.placed
        self._bones: list[BoneArrays] = [field.arrays for field in bones.fields]
        self._grids = [grids[name] for name in bones.names]
        self._memories = [Memory.of(len(shown.rest)) for _ in bones.names]
        self._reach = NEAR_FACE * shown.side
        # Which vertices each bone may be within reach of.
        self._near = np.zeros((len(bones.names), len(shown.rest)), dtype=np.bool_)

    def at_rest(self) -> "ShownBones":
        """The same bones where they are at rest, with nothing known."""
        other = object.__new__(ShownBones)
        other.__dict__.update(self.__dict__)
        other._poses = np.tile(np.eye(4), (len(self._poses), 1, 1))
        other._memories = [Memory.of(len(self._shown.rest)) for _ in self._bones]
        other._near = np.zeros_like(self._near)
        return other

    def find_near(self, points: Floats) -> None:
        """Find the vertices that a bone may be within reach of, where these are at points (n, 3).

        A bound of the distance is kept for each, which shrinks as the vertex moves. The bone is
        asked only where it falls below the reach, or below what it was when it was found.
        """
        least, unbounded = np.empty(len(points)), np.full(len(points), -np.inf)
        for bone, near in enumerate(self._near):
            self._ask(bone, points, None, unbounded, least)
            memory = self._memories[bone]
            stale = np.flatnonzero((least < self._reach) & (memory.bound >= self._reach))
            found = np.empty(len(stale))
            self._ask(bone, points, stale, self._reach[stale], found)
            least[stale] = found
            near[:] = least < self._reach

    def _ask(
        self,
        bone: int,
        points: Floats,
        rows: Integers | None,
        reach: Floats,
        distance: Floats,
    ) -> Floats:
        """Fill distances (k,) of some vertices, of points (n, 3), to one bone; the directions
        (k, 3) in which they grow.
        """
        memory, direction = self._memories[bone], np.empty((len(distance), 3))
        if rows is not None:
            points, memory = points[rows], Memory(*(part[rows] for part in memory))

        def work(start: int, stop: int) -> None:
            given = self._bones[bone], self._poses[bone], points[start:stop], reach[start:stop]
            known = [part[start:stop] for part in memory]
            distance_loop(*given, *known, distance[start:stop], direction[start:stop])

        in_chunks(len(distance), work)
        if rows is not None:
            for part, values in zip(self._memories[bone], memory):
                part[rows] = values
        return direction

    def _depth(self, points: Floats, rows: Integers) -> tuple[Floats, Floats]:
        """Distances (k,) of some vertices, of points (n, 3), to the nearest bone where they are in
        one, else 0, and the directions (k, 3) in which they grow.
        """
        smallest, outward = np.zeros(len(rows)), np.zeros((len(rows), 3))
        for bone, near in enumerate(self._near):
            some = np.flatnonzero(near[rows])
            distance = np.empty(len(some))
            direction = self._ask(bone, points, rows[some], smallest[some], distance)
            deeper = distance < smallest[some]
            smallest[some[deeper]] = distance[deeper]
            outward[some[deeper]] = direction[deeper]
        return smallest, outward

    def lift(self, sheet: Sheet, rows: Integers | None = None) -> Integers:
        """Move vertices that lie in a bone onto it, where they stay: these.

        Of ``rows``, which count as near all bones from then on; without them, of all that are near
        one. What looks away from the bone keeps off it, so that both sides of a muscle that sinks
        into it stay apart.
        """
        edge = self._shown.edge
        if rows is None:
            rows = np.flatnonzero(self._near.any(axis=0))
        else:
            self._near[:, rows] = True
        moved = np.zeros(0, dtype=np.int64)
        for turn in range(LIFTS):
            distance, outward = self._depth(sheet.vertices, rows)
            inside = np.flatnonzero(distance < -OUT * edge)
            rows, distance, outward = rows[inside], distance[inside], outward[inside]
            if len(rows) == 0:
                break
            moved = rows if turn == 0 else moved
            if not sheet.normals.any():
                sheet.normals[:] = vertex_normals(sheet.carried, self._shown.faces)
            away = np.einsum("ij,ij->i", sheet.normals[rows], outward)
            height = LAMELLA * edge * np.maximum(away, 0.0) - distance
            sheet.suspect[rows] |= distance < -SUNK * edge
            sheet.vertices[rows] += height[:, None] * outward
            sheet.hold(rows)
        return moved

    def push_off(self, sheet: Sheet, among: Booleans | None = None) -> None:
        """Move the corners of triangles that a bone's vertices came through, of those with a corner
        in ``among`` (n,), and out of the bones again what that drove into another.
        """
        shown, count = self._shown, len(sheet.vertices)
        for _ in range(2):
            moved = np.zeros(count, dtype=np.bool_)
            for grid, pose, near in zip(self._grids, self._poses, self._near):
                some = near if among is None else near & among
                if some.any():
                    push_off(sheet.vertices, shown.faces, grid, pose, shown.edge, moved, some)
            rows = np.flatnonzero(moved)
            sheet.suspect[rows] = True
            sheet.hold(rows)
            if len(self.lift(sheet, rows)) == 0:
                return
            among = np.zeros(count, dtype=np.bool_)
            among[shown.grown(rows)] = True
