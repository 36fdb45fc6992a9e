"""Triangles of a rest mesh that are slivers or look inwards: edges flipped, vertices moved, until none is left.

A triangulation that was contracted from a muscle's own and then brought onto a level set has a few such triangles on
the folds of its rims. The material carries them through all frames, so they are mended once, at rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import face_normals, vertex_normals
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh

# Triangles with a smaller angle [degree] are slivers; rounds of mending, and rounds without gain that end it.
LEAST_ANGLE, ROUNDS, PATIENCE = 15.0, 8, 3


def mend_slivers(
    mesh: MaterialMesh, vertices: Floats, onto: Callable[[MaterialMesh, Floats], Floats]
) -> tuple[MaterialMesh, Floats]:
    """A mesh of the same vertices and genus with fewer slivers and triangles that look inwards, none if possible.

    Parameters
    ----------
    mesh : MaterialMesh
    vertices : (n, 3) ndarray
        On the surface [scene unit].
    onto : callable
        Brings vertices (n, 3) of a mesh back onto the surface.

    Returns
    -------
    mesh : MaterialMesh
        Another one where edges were flipped.
    vertices : (n, 3) ndarray
    """
    best, least, waited = (mesh, vertices), _badness(vertices, mesh.faces), 0
    for _ in range(ROUNDS):
        if least == (0, 0) or waited == PATIENCE:
            break
        faces = flip_edges(vertices, mesh.faces)
        if faces is not mesh.faces:
            mesh = MaterialMesh(vertices, faces)
        bad = bad_triangles(vertices, faces)
        if bad.any():
            marked = np.zeros(len(vertices), dtype=np.bool_)
            marked[faces[bad].ravel()] = True
            moved = vertices.copy()
            mesh.smooth(moved, np.flatnonzero(mesh.around(marked, 1)), 2)
            vertices = onto(mesh, moved)
        now = _badness(vertices, mesh.faces)
        waited += 1
        if now < least:
            best, least, waited = (mesh, vertices), now, 0
    return best


def bad_triangles(vertices: Floats, faces: Integers) -> Booleans:
    """Mask (m,) of the triangles that look inwards or have an angle below `LEAST_ANGLE`."""
    found: Booleans = _look_inwards(faces, vertices, vertex_normals(vertices, faces))
    found |= _smallest_angles(vertices, faces) < LEAST_ANGLE
    return found


def flip_edges(vertices: Floats, faces: Integers) -> Integers:
    """Triangles with an edge of each bad one flipped where that makes the pair better; the same array if none is.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
        Closed.

    Returns
    -------
    (m, 3) ndarray of int
    """
    bad: list[int] = np.flatnonzero(bad_triangles(vertices, faces)).tolist()
    if not bad:
        return faces
    normals, count = vertex_normals(vertices, faces), len(vertices)
    sides = faces.astype(np.int64) * count + np.roll(faces, -1, axis=1)
    beside = {side: f for f, row in enumerate(sides.tolist()) for side in row}
    changed = faces.copy()
    done: set[int] = set()
    for f in bad:
        choice, worth = None, None
        for k in range(3):
            i, j, c = (int(v) for v in np.roll(changed[f], -k))
            g = beside.get(j * count + i)
            if g is None or f in done or g in done:
                continue
            d = int(changed[g][~np.isin(changed[g], (i, j))][0])
            # Two triangles on the same edge already: flipped, it would have four.
            if c * count + d in beside or d * count + c in beside:
                continue
            pair = np.array([[c, i, d], [d, j, c]])
            before, after = (_worth(vertices, two, normals) for two in (changed[[f, g]], pair))
            if after > before and (worth is None or after > worth):
                choice, worth = (g, pair), after
        if choice is not None:
            g, pair = choice
            changed[f], changed[g] = pair
            # What lies around them is looked at again in the next round.
            done |= {f, g}
            beside[int(pair[0, 2]) * count + int(pair[0, 0])] = f
            beside[int(pair[1, 2]) * count + int(pair[1, 0])] = g
    return changed if done else faces


def _worth(vertices: Floats, pair: Integers, normals: Floats) -> tuple[int, float]:
    """How good two triangles are: few that look inwards, then a great smallest angle."""
    inwards = int(_look_inwards(pair, vertices, normals).sum())
    return -inwards, float(_smallest_angles(vertices, pair).min())


def _badness(vertices: Floats, faces: Integers) -> tuple[int, int]:
    inwards = _look_inwards(faces, vertices, vertex_normals(vertices, faces))
    return int(inwards.sum()), int((_smallest_angles(vertices, faces) < LEAST_ANGLE).sum())


def _look_inwards(faces: Integers, vertices: Floats, normals: Floats) -> Booleans:
    """Mask of the triangles that look away from the normals of all their corners."""
    along = np.einsum("mkd,md->mk", normals[faces], face_normals(vertices, faces))
    return np.asarray((along < 0.0).all(axis=1), dtype=np.bool_)


def _smallest_angles(vertices: Floats, faces: Integers) -> Floats:
    """Smallest angle of each triangle [degree]."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), np.finfo(float).tiny)
    cosines = -np.einsum("mkd,mkd->mk", sides, np.roll(sides, 1, axis=1))
    found: Floats = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1)
    return found
