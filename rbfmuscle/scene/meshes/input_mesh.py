"""The mesh of a file as it stands there: its own vertices, texture coordinates and normals.

A model needs each point of a surface once. Files repeat vertices along the seams of their textures,
or name texture coordinates and normals by numbers of their own. What is given here leads back from
the mesh of the model, wherever its vertices have gone, to that of the file.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import face_normals, repeated_faces
from rbfmuscle.geometry.vectors import unit


class Corners(NamedTuple):
    """Texture coordinates (t, 2), from the lower left, and unit normals (k, 3), and which of them
    each corner of m triangles has, (m, 3); all empty where a file has none.
    """

    texture: Floats
    texture_faces: Integers
    normals: Floats
    normal_faces: Integers

    def of(self, chosen: Integers, order: Integers) -> Corners:
        """Those of some triangles (c,), whose corners come in an ``order`` (c, 3)."""
        faces = [
            np.take_along_axis(numbers[chosen], order, axis=1) if len(values) else numbers
            for values, numbers in ((self[0], self[1]), (self[2], self[3]))
        ]
        return Corners(self.texture, faces[0], self.normals, faces[1])


NO_CORNERS = Corners(
    np.zeros((0, 2)), np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.int64)
)


def vertex_corners(
    faces: Integers, texture: Floats | None = None, normals: Floats | None = None
) -> Corners:
    """Corners of triangles (m, 3) with texture coordinates (n, 2) and normals (n, 3) by vertex;
    what is not finite is left out.
    """
    found = NO_CORNERS
    if texture is not None and len(texture) and np.isfinite(texture).all():
        found = found._replace(texture=np.asarray(texture, float), texture_faces=faces)
    if normals is not None and len(normals) and np.isfinite(normals).all():
        found = found._replace(normals=np.asarray(normals, float), normal_faces=faces)
    return found


class InputMesh(NamedTuple):
    """Vertices (n, 3) and triangles (m, 3) of a file, in its order; ``source`` (n,) is the vertex
    of the model's mesh that each became, whose triangles are ``source[faces]``.
    """

    vertices: Floats
    faces: Integers
    source: Integers
    corners: Corners = NO_CORNERS

    def moved(self, shown: Floats) -> InputMesh:
        """The mesh where the vertices of the model's mesh are ``shown`` (k, 3); normals turn with
        their triangles.
        """
        vertices, corners = shown[self.source], self.corners
        if len(corners.normals):
            corners = corners._replace(normals=self._carried_normals(vertices))
        return self._replace(vertices=vertices, corners=corners)

    def _carried_normals(self, vertices: Floats) -> Floats:
        """Normals (k, 3) that keep, in the frame of the triangles that have them, how they depart
        from these triangles' mean normal by area.
        """
        given = self.corners.normals
        before, after = self._frames(self.vertices), self._frames(vertices)
        depart = np.einsum("kba,ka->kb", before, given - before[:, 0])
        normals = after[:, 0] + np.einsum("kba,kb->ka", after, depart)
        length = np.linalg.norm(normals, axis=1)
        flat = length <= 0.0
        return np.where(flat[:, None], given, normals / np.where(flat, 1.0, length)[:, None])

    def _frames(self, vertices: Floats) -> Floats:
        """Of each normal the mean normal of its triangles, and two tangents (k, 3, 3)."""
        numbers = self.corners.normal_faces
        area, normal = face_normals(vertices, self.faces), np.zeros_like(self.corners.normals)
        for corner in range(3):
            np.add.at(normal, numbers[:, corner], area)
        first = np.unique(numbers, return_index=True)[1]
        ends = self.faces[first // 3, first % 3], self.faces[first // 3, (first + 1) % 3]
        normal = unit(normal)
        side = vertices[ends[1]] - vertices[ends[0]]
        side = unit(side - np.einsum("ka,ka->k", side, normal)[:, None] * normal)
        return np.stack([normal, side, np.cross(normal, side)], axis=1)

    def split(self) -> InputMesh:
        """The mesh with one number for vertex, texture coordinates and normal of a corner.

        A vertex keeps its number for the first of its corners; what differs at others follows the
        vertices of the file.
        """
        count, corners = len(self.vertices), self.corners
        if not len(corners.texture) and not len(corners.normals):
            return self
        columns = [self.faces.ravel()]
        for values, numbers in (corners[:2], corners[2:]):
            columns += [numbers.ravel()] if len(values) else []
        rows, first, label = np.unique(
            np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True
        )
        again = np.ones(len(rows), dtype=bool)
        order = np.argsort(first)
        again[order[np.unique(rows[order, 0], return_index=True)[1]]] = False
        number = rows[:, 0].copy()
        number[again] = count + np.argsort(np.argsort(first[again]))
        place = np.empty(count + int(again.sum()), np.int64)
        place[number] = np.arange(len(rows))
        faces = number[label.ravel()].reshape(-1, 3)
        of = rows[place]
        texture = corners.texture[of[:, 1]] if len(corners.texture) else None
        normals = corners.normals[of[:, -1]] if len(corners.normals) else None
        return InputMesh(
            self.vertices[of[:, 0]],
            faces,
            self.source[of[:, 0]],
            vertex_corners(faces, texture, normals),
        )


def plain_input(vertices: Floats, faces: Integers) -> InputMesh:
    """The mesh of a model as its own file would have it."""
    return InputMesh(vertices, faces, np.arange(len(vertices)))


def input_mesh(
    vertices: Floats, faces: Integers, vertex_map: Integers, given: Integers, corners: Corners
) -> InputMesh | None:
    """The mesh of a file, with triangles ``given`` and their ``corners``, that became vertices
    (n, 3) and faces (m, 3) by ``vertex_map``; None where it has triangles that the file has not.
    """
    there = vertex_map[given]
    kept = np.flatnonzero((there >= 0).all(axis=1) & ~repeated_faces(there))
    there = there[kept]
    _, label = np.unique(
        np.sort(np.concatenate([faces, there]), axis=1), axis=0, return_inverse=True
    )
    place = np.full(len(faces) + len(there), -1)
    place[label.ravel()[len(faces) :]] = np.arange(len(there))
    chosen = place[label.ravel()[: len(faces)]]
    if (chosen < 0).any():
        return None
    order = (faces[:, :, None] == there[chosen][:, None, :]).argmax(axis=2)
    own = np.take_along_axis(given[kept][chosen], order, axis=1)
    used = np.unique(own)
    corners = corners.of(kept[chosen], order)
    source = vertex_map[used]
    found = InputMesh(vertices[source], np.searchsorted(used, own), source, corners)
    return found._replace(corners=_own_normals(found))


def _own_normals(mesh: InputMesh) -> Corners:
    """Corners with normals of their own for each vertex, outward like the triangles."""
    corners = mesh.corners
    if not len(corners.normals):
        return corners
    pairs = np.stack([mesh.faces.ravel(), corners.normal_faces.ravel()], axis=1)
    pairs, label = np.unique(pairs, axis=0, return_inverse=True)
    normals, faces = corners.normals[pairs[:, 1]], label.reshape(-1, 3)
    outward = np.einsum("mka,ma->", normals[faces], face_normals(mesh.vertices, mesh.faces))
    return corners._replace(normals=normals if outward >= 0 else -normals, normal_faces=faces)
