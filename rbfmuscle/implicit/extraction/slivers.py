"""Triangles of a rest mesh that are slivers or look inwards: edges flipped, vertices moved, until none is left.

A triangulation that was contracted from a muscle's own and then brought onto a level set has a few such triangles on
the folds of its rims. The material carries them through all frames, so they are mended once, at rest.
"""

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh

# Triangles with a smaller angle [degree] are slivers; rounds of mending, and rounds without gain that end it.
LEAST_ANGLE, ROUNDS, PATIENCE = 15.0, 8, 3


def mend_slivers(
    mesh: MaterialMesh, vertices: Floats, onto: Callable[[MaterialMesh, Floats], Floats]
) -> tuple[MaterialMesh, Floats]:
    """A mesh of the same vertices and genus with fewer slivers and triangles that look inwards, none if possible.

    ``vertices`` (n, 3) lie on the surface [scene unit]; ``onto`` brings vertices (n, 3) of a mesh back onto it. The
    mesh is another one where edges were flipped.
    """
    quality = triangle_quality(vertices, mesh.faces, vertex_normals(vertices, mesh.faces))
    best, least, waited = (mesh, vertices), _faults(quality), 0
    for _ in range(ROUNDS):
        if least == (0, 0) or waited == PATIENCE:
            break
        faces = flip_edges(vertices, mesh.faces)
        if faces is not mesh.faces:
            mesh = MaterialMesh(vertices, faces)
        bad = triangle_quality(vertices, faces, vertex_normals(vertices, faces)) < LEAST_ANGLE
        if bad.any():
            marked = np.zeros(len(vertices), dtype=np.bool_)
            marked[faces[bad].ravel()] = True
            moved = vertices.copy()
            mesh.smooth(moved, np.flatnonzero(mesh.around(marked, 1)), 2)
            vertices = onto(mesh, moved)
        now = _faults(triangle_quality(vertices, mesh.faces, vertex_normals(vertices, mesh.faces)))
        waited += 1
        if now < least:
            best, least, waited = (mesh, vertices), now, 0
    return best


def triangle_quality(vertices: Floats, faces: Integers, normals: Floats) -> Floats:
    """Smallest angle (m,) of each triangle [degree], negative where it looks away from its corners' normals (n, 3)."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    inwards = (np.einsum("mkd,md->mk", normals[faces], np.cross(sides[:, 0], sides[:, 1])) < 0.0).all(axis=1)
    sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), np.finfo(float).tiny)
    cosines = -np.einsum("mkd,mkd->mk", sides, np.roll(sides, 1, axis=1))
    angle = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1)
    return np.where(inwards, angle - 180.0, angle)


def _faults(quality: Floats) -> tuple[int, int]:
    """How many triangles look inwards, and how many are slivers or do."""
    return int((quality < 0.0).sum()), int((quality < LEAST_ANGLE).sum())


def flip_edges(vertices: Floats, faces: Integers) -> Integers:
    """Faces (m, 3) of a closed mesh, an edge of each bad one flipped where that helps; the same array if none is."""
    normals, count = vertex_normals(vertices, faces), len(vertices)
    bad = np.flatnonzero(triangle_quality(vertices, faces, normals) < LEAST_ANGLE)
    sides = faces.astype(np.int64) * count + np.roll(faces, -1, axis=1)
    beside = {side: f for f, row in enumerate(sides.tolist()) for side in row}
    changed = faces.copy()
    done: set[int] = set()
    for f in bad.tolist():
        choice, worth = None, -np.inf
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
            before, after = (
                triangle_quality(vertices, two, normals).min() for two in (changed[[f, g]], pair)
            )
            if after > max(before, worth):
                choice, worth = (g, pair), after
        if choice is not None:
            g, pair = choice
            changed[f], changed[g] = pair
            # What lies around them is looked at again in the next round.
            done |= {f, g}
            beside[int(pair[0, 2]) * count + int(pair[0, 0])] = f
            beside[int(pair[1, 2]) * count + int(pair[1, 0])] = g
    return changed if done else faces
