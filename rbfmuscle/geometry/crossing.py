"""Triangles of a surface that go through others of the same surface."""

import numpy as np

from rbfmuscle.compiled.loop import compiled

# Cells of the sorting grid for each triangle, at most.
CELLS_A_FACE = 4


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles cross others of the same surface.

    An edge crosses a triangle where its ends lie on either side of it and its line passes through the inside.
    Triangles that share an edge are never counted, those that share a corner are where the far edge of one
    goes through the other. Triangles that lie in one plane and only overlap do not cross.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        [scene unit]
    faces : (m, 3) ndarray of int

    Returns
    -------
    (m,) ndarray of bool
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    marked = np.zeros(len(faces), dtype=np.bool_)
    if len(faces) == 0:
        return marked
    used = vertices[faces]
    low, high = used.min(axis=1), used.max(axis=1)
    # Twice the mean extent: a triangle lies in few cells, and a cell holds few triangles.
    size = max(2.0 * float((high - low).max(axis=1).mean()), 1e-300)
    extent = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-300)
    while np.prod(np.floor(extent / size) + 1.0) > CELLS_A_FACE * len(faces) + 64:
        size *= 1.3
    shape = np.floor(extent / size).astype(np.int64) + 1
    first = np.floor((low - low.min(axis=0)) / size).astype(np.int64)
    last = np.minimum(np.floor((high - low.min(axis=0)) / size).astype(np.int64), shape - 1)
    start = np.zeros(int(np.prod(shape)) + 1, dtype=np.int64)
    _count_loop(first, last, shape, start)
    members = np.empty(start[-1], dtype=np.int64)
    _fill_loop(first, last, shape, start, members)
    _cross_loop(vertices, faces, low, high, start, members, marked)
    return marked


@compiled
def _count_loop(first, last, shape, start):
    """Number of triangles in each cell, summed up: those of cell c end at start[c + 1]."""
    for f in range(len(first)):
        for i in range(first[f, 0], last[f, 0] + 1):
            for j in range(first[f, 1], last[f, 1] + 1):
                for k in range(first[f, 2], last[f, 2] + 1):
                    start[(i * shape[1] + j) * shape[2] + k + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]


@compiled
def _fill_loop(first, last, shape, start, members):
    filled = start[:-1].copy()
    for f in range(len(first)):
        for i in range(first[f, 0], last[f, 0] + 1):
            for j in range(first[f, 1], last[f, 1] + 1):
                for k in range(first[f, 2], last[f, 2] + 1):
                    c = (i * shape[1] + j) * shape[2] + k
                    members[filled[c]] = f
                    filled[c] += 1


@compiled
def _cross_loop(vertices, faces, low, high, start, members, marked):
    for c in range(len(start) - 1):
        for m in range(start[c], start[c + 1]):
            f = members[m]
            for n in range(m + 1, start[c + 1]):
                g = members[n]
                if marked[f] and marked[g]:
                    continue
                apart = False
                for a in range(3):
                    apart |= low[f, a] > high[g, a] or low[g, a] > high[f, a]
                if apart or _shared(faces, f, g) > 1:
                    continue
                if _edges_cross(vertices, faces, f, g) or _edges_cross(vertices, faces, g, f):
                    marked[f], marked[g] = True, True


@compiled
def _shared(faces, f, g):
    """Corners that two triangles have in common."""
    count = 0
    for a in range(3):
        for b in range(3):
            count += faces[f, a] == faces[g, b]
    return count


@compiled
def _edges_cross(vertices, faces, f, g):
    """Whether an edge of f goes through the inside of g."""
    a, b, c = faces[g, 0], faces[g, 1], faces[g, 2]
    for k in range(3):
        p, q = faces[f, k], faces[f, (k + 1) % 3]
        if p in (a, b, c) or q in (a, b, c):
            continue
        if _side(vertices, a, b, c, p) * _side(vertices, a, b, c, q) >= 0.0:
            continue
        along = _side(vertices, p, q, a, b), _side(vertices, p, q, b, c), _side(vertices, p, q, c, a)
        if (along[0] > 0.0 and along[1] > 0.0 and along[2] > 0.0) or (
            along[0] < 0.0 and along[1] < 0.0 and along[2] < 0.0
        ):
            return True
    return False


@compiled
def _side(vertices, a, b, c, d):
    """Six times the signed volume of a tetrahedron: which side of the triangle abc the point d lies on."""
    o, u, v, w = vertices[a], vertices[b], vertices[c], vertices[d]
    ux, uy, uz = u[0] - o[0], u[1] - o[1], u[2] - o[2]
    vx, vy, vz = v[0] - o[0], v[1] - o[1], v[2] - o[2]
    return (
        (uy * vz - uz * vy) * (w[0] - o[0])
        + (uz * vx - ux * vz) * (w[1] - o[1])
        + (ux * vy - uy * vx) * (w[2] - o[2])
    )
