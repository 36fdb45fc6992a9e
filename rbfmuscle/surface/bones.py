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
        # Vertices that each bone may be within reach of, and what is known of these alone.
        nothing = np.zeros(0, dtype=np.int64)
        self._near = [nothing for _ in bones.names]
        self._known = [Memory.of(0) for _ in bones.names]

    def at_rest(self) -> "ShownBones":
        """The same bones where they are at rest, with nothing known."""
        other = object.__new__(ShownBones)
        other.__dict__.update(self.__dict__)
        other._poses = np.tile(np.eye(4), (len(self._poses), 1, 1))
        other._memories = [Memory.of(len(self._shown.rest)) for _ in self._bones]
        other._near, other._known = list(self._near), list(self._known)
        return other

    def find_near(self, points: Floats) -> None:
        """Find the vertices that a bone may be within reach of, where these are at points (n, 3).

        A bound of the distance is kept for each, which shrinks as the vertex moves. The bone is
        asked only where it falls below the reach, or below what it was when it was found.
        """
        unbounded = np.full(len(points), -np.inf)
        for bone, memory in enumerate(self._memories):
            least, _ = self._ask(bone, points, unbounded, memory)
            stale = np.flatnonzero((least < self._reach) & (memory.bound >= self._reach))
            known = memory.some(stale)
            least[stale], _ = self._ask(bone, points[stale], self._reach[stale], known)
            for part, values in zip(memory, known):
                part[stale] = values
            self._near[bone] = np.flatnonzero(least < self._reach)
            self._known[bone] = memory.some(self._near[bone])

    def _ask(
        self, bone: int, points: Floats, reach: Floats, known: Memory
    ) -> tuple[Floats, Floats]:
        """Distances (k,) of points (k, 3) to one bone and the directions (k, 3) in which they grow;
        beyond ``reach`` (k,) lower bounds, without a direction.
        """
        distance, direction = np.empty(len(points)), np.empty((len(points), 3))

        def work(start: int, stop: int) -> None:
            given = self._bones[bone], self._poses[bone], points[start:stop], reach[start:stop]
            memory = [part[start:stop] for part in known]
            distance_loop(*given, *memory, distance[start:stop], direction[start:stop])

        in_chunks(len(points), work)
        return distance, direction

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
                distance, outward = self._ask(bone, points, np.zeros(len(some)), known)
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
