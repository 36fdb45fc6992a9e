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
        self._near = np.zeros(0, dtype=np.int64)

    def at_rest(self) -> "ShownBones":
        """The same bones where they are at rest, with nothing known."""
        other = object.__new__(ShownBones)
        other.__dict__.update(self.__dict__)
        other._poses = np.tile(np.eye(4), (len(self._poses), 1, 1))
        other._memories = [Memory.of(len(self._shown.rest)) for _ in self._bones]
        return other

    def nearest(self, points: Floats, rows: Integers, reach: Floats) -> tuple[Floats, Floats]:
        """Distances (k,) of some vertices, of points (n, 3), to the nearest bone, and the
        directions (k, 3) in which they grow, for those within ``reach`` (k,); elsewhere a lower
        bound beyond it, without a direction.
        """
        count = len(rows)
        smallest, outward = np.full(count, np.inf), np.zeros((count, 3))
        whole = count == len(points)
        where = points if whole else points[rows]

        def work(start: int, stop: int) -> None:
            some = slice(start, stop)
            distance, way = np.empty(stop - start), np.empty((stop - start, 3))
            for bone, pose, memory in zip(self._bones, self._poses, self._memories):
                known = [part[some] if whole else part[rows[some]] for part in memory]
                limit = np.minimum(reach[some], smallest[some])
                distance_loop(bone, pose, where[some], limit, *known, distance, way)
                if not whole:
                    for part, values in zip(memory, known):
                        part[rows[some]] = values
                near = np.flatnonzero((distance < smallest[some]) & (distance <= limit))
                np.minimum(smallest[some], distance, out=smallest[some])
                outward[start + near] = way[near]

        if self._bones:
            in_chunks(count, work)
        return smallest, outward

    def lift(self, sheet: Sheet, rows: Integers | None = None, *, again: bool = False) -> Integers:
        """Move vertices that lie in a bone onto it, where they stay: these.

        Where ``rows`` are given only these; with ``again`` only those that were near a bone when
        all were last asked for. What looks away from the bone keeps off it, so that both sides of a
        muscle that sinks into it stay apart.
        """
        if not self._bones:
            return np.zeros(0, dtype=np.int64)
        edge, reach = self._shown.edge, None
        if rows is None and not again:
            rows, reach = np.arange(len(sheet.vertices)), self._reach
        elif rows is None:
            rows = self._near
        moved = np.zeros(0, dtype=np.int64)
        for turn in range(LIFTS):
            limit = np.zeros(len(rows)) if reach is None else reach
            distance, outward = self.nearest(sheet.vertices, rows, limit)
            if reach is not None:
                self._near = np.flatnonzero(distance < reach)
                reach = None
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
        shown = self._shown
        near = np.zeros(len(sheet.vertices), dtype=np.bool_)
        near[self._near] = True
        if among is not None:
            near &= among
        for _ in range(2):
            if not near.any():
                return
            moved = np.zeros(len(near), dtype=np.bool_)
            for grid, pose in zip(self._grids, self._poses):
                push_off(sheet.vertices, shown.faces, grid, pose, shown.edge, moved, near)
            rows = np.flatnonzero(moved)
            sheet.suspect[rows] = True
            sheet.hold(rows)
            if len(rows) == 0 or len(self.lift(sheet, rows)) == 0:
                return
            near[:] = False
            near[shown.grown(rows)] = True
