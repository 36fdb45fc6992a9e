"""A closed triangulation that goes with the material, and the triangles of it mended that are
slivers or look inwards.

One that was contracted from a muscle's own and then brought onto a level set has a few of them on
the folds of its rims. The material carries them through all frames, so they are mended once, at
rest: edges flipped, vertices moved.
"""

from collections.abc import Callable

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.jit import compiled

# Triangles with a smaller angle [degree] are slivers; rounds of mending, and rounds without gain
# that end it.
LEAST_ANGLE = 15.0
ROUNDS = 8
PATIENCE = 3


class MaterialMesh:
    """A closed triangulation of fixed topology: vertices (n, 3) at rest, outward faces (m, 3).

    ``start`` and ``other`` are CSR lists of neighbours. ``slope`` (n,) is the field's at the
    vertices at rest, if known; where it sinks, sheets have met and the field is not to be trusted.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.slope: Floats | None = None
        self.tree = FaceTree(vertices, faces)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        ends = np.concatenate([self.faces[:, :2], self.faces[:, 1:], self.faces[:, ::2]])
        pairs = np.unique(np.concatenate([ends @ (len(vertices), 1), ends @ (1, len(vertices))]))
        self.other = pairs % len(vertices)
        self.start = np.searchsorted(pairs, len(vertices) * np.arange(len(vertices) + 1))

    def edge(self, vertices: Floats) -> float:
        """Mean length of an edge [scene unit]."""
        return _edges_loop(vertices, self.faces)[0]

    def longest(self, vertices: Floats) -> float:
        """Greatest length of an edge [scene unit]."""
        return _edges_loop(vertices, self.faces)[1]

    def smooth(self, vertices: Floats, rows: Integers, sweeps: int) -> None:
        """Move vertices towards the mean of their neighbours, in place, so many times."""
        for _ in range(sweeps):
            _smooth_loop(vertices, rows, self.start, self.other)

    def around(self, marked: Booleans, rings: int) -> Booleans:
        """Mask (n,) of the vertices within some rings of marked ones."""
        for _ in range(rings):
            grown = marked.copy()
            grown[self.other[np.repeat(marked, np.diff(self.start))]] = True
            marked = grown
        return marked


@compiled(error_model="numpy")
def _edges_loop(vertices, faces):
    """Mean and greatest length of the edges."""
    total, greatest = 0.0, 0.0
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            square = 0.0
            for d in range(3):
                square += (vertices[a, d] - vertices[b, d]) ** 2
            length = np.sqrt(square)
            total += length
            greatest = max(greatest, length)
    return total / (3.0 * len(faces)), greatest


@compiled(error_model="numpy")
def _smooth_loop(vertices, rows, start, other):
    """Half the way to the mean of the neighbours, one vertex after the other."""
    for v in rows:
        x = 0.0
        y = 0.0
        z = 0.0
        for n in range(start[v], start[v + 1]):
            x += vertices[other[n], 0]
            y += vertices[other[n], 1]
            z += vertices[other[n], 2]
        count = start[v + 1] - start[v]
        vertices[v, 0] = 0.5 * (vertices[v, 0] + x / count)
        vertices[v, 1] = 0.5 * (vertices[v, 1] + y / count)
        vertices[v, 2] = 0.5 * (vertices[v, 2] + z / count)


def mend_slivers(
    mesh: MaterialMesh, vertices: Floats, onto: Callable[[MaterialMesh, Floats], Floats]
) -> tuple[MaterialMesh, Floats]:
    """A mesh of the same vertices and genus with fewer slivers and triangles that look inwards,
    none if possible.

    ``vertices`` (n, 3) lie on the surface [scene unit]; ``onto`` brings vertices (n, 3) of a mesh
    back onto it. The mesh is another one where edges were flipped.
    """
    quality = triangle_quality(vertices, mesh.faces, vertex_normals(vertices, mesh.faces))
    best = (mesh, vertices)
    least = _faults(quality)
    waited = 0
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
            best = (mesh, vertices)
            least = now
            waited = 0
    return best


def triangle_quality(vertices: Floats, faces: Integers, normals: Floats) -> Floats:
    """Smallest angle (m,) of each triangle [degree], negative where it looks away from its corners'
    normals (n, 3).
    """
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    inwards = (
        np.einsum("mkd,md->mk", normals[faces], np.cross(sides[:, 0], sides[:, 1])) < 0.0
    ).all(axis=1)
    sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), np.finfo(float).tiny)
    cosines = -np.einsum("mkd,mkd->mk", sides, np.roll(sides, 1, axis=1))
    angle = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1)
    return np.where(inwards, angle - 180.0, angle)


def _faults(quality: Floats) -> tuple[int, int]:
    """How many triangles look inwards, and how many are slivers or do."""
    return int((quality < 0.0).sum()), int((quality < LEAST_ANGLE).sum())


def flip_edges(vertices: Floats, faces: Integers) -> Integers:
    """Faces (m, 3) of a closed mesh, an edge of each bad one flipped where that helps; the same
    array if none is.
    """
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
            two = changed[[f, g]], pair
            before, after = (triangle_quality(vertices, faces, normals).min() for faces in two)
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
