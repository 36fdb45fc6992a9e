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


class InputOrder(NamedTuple):
    """Triangles (m, 3) of a file by its own vertices, in its order; ``source`` (n,) is the vertex
    of the model's mesh that each of these is, whose triangles are ``source[faces]``.
    """

    faces: Integers
    source: Integers


class InputMesh(NamedTuple):
    """Vertices (n, 3) and triangles (m, 3) of a file, in its order; ``source`` (n,) is the vertex
    of the model's mesh that each became, whose triangles are ``source[faces]``.
    """

    vertices: Floats
    faces: Integers
    source: Integers
    corners: Corners = NO_CORNERS


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
