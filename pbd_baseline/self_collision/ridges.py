"""Vertices of bones against the faces of a mesh muscle: what comes up between the muscle's own vertices."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.jit import compiled

# Most cells of a bone's grid.
MOST_CELLS = 200_000
# A face opposes a bone's vertex where its normal and the vertex's differ by more than 100 degrees or so.
OPPOSED = -0.2
# How far, as a share of a face, a vertex may lie beside it and still be met: the gusset between faces around a dent.
BESIDE = 0.15
# Room for contacts at first; more is taken where it does not suffice.
ROOM = 512


class VertexGrid(NamedTuple):
    """Vertices of a bone by cells, in its own coordinates.

    Attributes
    ----------
    low : (3,) ndarray
    cell : float
    shape : (3,) ndarray of int
    start : (cells + 1,) ndarray of int
    points, normals : (v, 3) ndarray
        In the order of the cells; normals are outward.
    """

    low: Floats
    cell: float
    shape: Integers
    start: Integers
    points: Floats
    normals: Floats

    @classmethod
    def of_mesh(cls, mesh: Any, cell: float) -> VertexGrid:
        """Sort the vertices of a bone into cells of about this width [scene unit]."""
        points = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        normals = vertex_normals(points, np.asarray(mesh.faces))
        low, size = points.min(axis=0), np.ptp(points, axis=0)
        cell = max(cell, float(np.prod(size + cell) / MOST_CELLS) ** (1.0 / 3.0))
        shape = (size / cell).astype(np.int64) + 1
        at = np.minimum(((points - low) / cell).astype(np.int64), shape - 1)
        number = (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2]
        order = np.argsort(number, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=int(np.prod(shape))))])
        return cls(low, float(cell), shape, start, points[order], normals[order])


class Ridges:
    """Finds the vertices of bones that are just behind faces of the muscle.

    Parameters
    ----------
    faces : (m, 3) ndarray of int
    meshes : list of trimesh.Trimesh
        Of all bones, in the order of the scene.
    cell : float
        Width of the cells that bones' vertices are sorted into [scene unit].
    deepest : float
        Depth behind a face beyond which a vertex is not the face's to deal with [scene unit].
    """

    def __init__(self, faces: Integers, meshes: list[Any], *, cell: float, deepest: float) -> None:
        self.faces, self.meshes = faces, meshes
        self.cell, self.deepest = cell, deepest
        self._grids: dict[int, VertexGrid] = {}

    def find(self, contacts: Any, points: Floats, near: dict[int, Booleans]) -> tuple[Any, ...]:
        """Bone vertices behind the faces that have a corner among the vertices ``near`` (n,) each bone, by its number.

        Returns
        -------
        columns, shares : (c, 3) ndarrays
            Corners of the face and shares of the place before the vertex.
        normal : (c, 3) ndarray
            Way in which the face has to go, unit.
        depth : (c,) ndarray
            How far [scene unit].
        """
        parts = [
            self._of_bone(contacts, b, points, np.flatnonzero(faces_of(near[b], self.faces)))
            for b in contacts.reached
            if b in near
        ]
        return tuple(np.concatenate([part[k] for part in parts]) for k in range(4)) if parts else NOTHING

    def _of_bone(self, contacts, b, points, chosen):
        if len(chosen) == 0:
            return NOTHING
        if b not in self._grids:
            self._grids[b] = VertexGrid.of_mesh(self.meshes[b], self.cell)
        grid, pose = self._grids[b], contacts.poses[contacts.names[b]]
        room = ROOM
        while True:
            face, values = np.empty(room, np.int64), np.empty((room, 7))
            count = _ridge_loop(points, self.faces, chosen, grid, pose, self.deepest, face, values)
            if count <= room:
                break
            room = 2 * count
        values = values[:count]
        return (
            self.faces[face[:count]],
            np.ascontiguousarray(values[:, :3]),
            np.ascontiguousarray(values[:, 3:6]),
            np.ascontiguousarray(values[:, 6]),
        )


def faces_of(marked: Booleans, faces: Integers) -> Booleans:
    """Faces (m,) that have a corner among the vertices marked (n,)."""
    return marked[faces[:, 0]] | marked[faces[:, 1]] | marked[faces[:, 2]]


NOTHING = (np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@compiled(error_model="numpy")
def _ridge_loop(points, faces, chosen, grid, pose, deepest, face, values):
    """Pairs of face and bone vertex behind it; returns how many there are, of which as many are kept as fit."""
    count = 0
    corner, low, high = np.empty((3, 3)), np.empty(3, np.int64), np.empty(3, np.int64)
    n, shares = np.empty(3), np.empty(3)
    for f in chosen:
        outside = False
        for a in range(3):
            least, most = np.inf, -np.inf
            for k in range(3):
                v = faces[f, k]
                value = 0.0
                for j in range(3):
                    value += pose[j, a] * (points[v, j] - pose[j, 3])
                corner[k, a] = value
                least, most = min(least, value), max(most, value)
            first = int(np.floor((least - deepest - grid.low[a]) / grid.cell))
            last = int(np.floor((most + deepest - grid.low[a]) / grid.cell))
            outside |= last < 0 or first >= grid.shape[a]
            low[a], high[a] = max(first, 0), min(last, grid.shape[a] - 1)
        if outside:
            continue
        u, w = corner[1] - corner[0], corner[2] - corner[0]
        n[0], n[1], n[2] = u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]
        square = n[0] ** 2 + n[1] ** 2 + n[2] ** 2
        if square < 1e-300:
            continue
        length = np.sqrt(square)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                row = (i * grid.shape[1] + j) * grid.shape[2]
                # cells of a row lie one behind the other
                for p in range(grid.start[row + low[2]], grid.start[row + high[2] + 1]):
                    away, opposed = 0.0, 0.0
                    for a in range(3):
                        away += n[a] * (grid.points[p, a] - corner[0, a])
                        opposed += n[a] * grid.normals[p, a]
                    depth = -away / length
                    if depth <= 0.0 or depth > deepest or opposed > OPPOSED * length:
                        continue
                    if not _beside(grid.points[p], corner, n, square, shares):
                        continue
                    if count < len(face):
                        face[count] = f
                        for a in range(3):
                            values[count, a] = shares[a]
                            values[count, 3 + a] = 0.0
                            for k in range(3):
                                values[count, 3 + a] -= pose[a, k] * n[k] / length
                        values[count, 6] = depth
                    count += 1
    return count


@compiled(error_model="numpy")
def _beside(point, corner, n, square, shares):
    """Shares (3,) of a point's foot on a triangle, cut to it; whether the foot is on it, or just beside."""
    total = 0.0
    for k in range(3):
        one, two = corner[(k + 1) % 3], corner[(k + 2) % 3]
        ux, uy, uz = two[0] - one[0], two[1] - one[1], two[2] - one[2]
        vx, vy, vz = point[0] - one[0], point[1] - one[1], point[2] - one[2]
        share = (
            n[0] * (uy * vz - uz * vy) + n[1] * (uz * vx - ux * vz) + n[2] * (ux * vy - uy * vx)
        ) / square
        if share < -BESIDE:
            return False
        shares[k] = max(share, 0.0)
        total += shares[k]
    for k in range(3):
        shares[k] /= total
    return True
