"""Marching cubes over a list of cells, always closed and 2-manifold.

The triangle table is made here from its rules, not copied. In each face of a cell the crossed edges are
joined by segments; where a face has four of them, the sign at the saddle of the bilinear interpolant decides
(Nielson & Hamann 1991), which both cells of the face see alike. The segments close to loops, and the loops
are cut into triangles without a diagonal that lies in a face: the cell on the other side could have the same,
and its edge would have four triangles. Each crossed edge then has one ring of cells around it: a manifold.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.jit import compiled

# Corner c of a cell sits at (c & 1, c >> 1 & 1, c >> 2). Edge e runs from its corner along its axis.
EDGE_CORNER = np.array([c for axis in range(3) for c in range(8) if not c >> axis & 1])
EDGE_AXIS = np.repeat(np.arange(3), 4)
# Corners of each face, anticlockwise seen from outside.
FACE_CORNERS = np.array([[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]])


class Tables(NamedTuple):
    """Tables of the 256 cases, each with one entry for every answer of its ambiguous faces.

    Attributes
    ----------
    ambiguous : (256, 6) int array
        Faces of each case that need a decision, -1 past the last.
    first : (256,) int array
        First entry of each case; bit b of the number added to it is set where the inside joins in
        ``ambiguous[case, b]``.
    start : (entries + 1,) int array
        Rows of ``triangles`` of each entry.
    triangles : (n, 3) int array
        Outward triangles: edge 0 .. 11, or 12 + i for the i-th loop's own middle vertex.
    corner, axis : (12,) int array
        Lower corner of each edge, and the axis along which it runs.
    faces : (6, 4) int array
        Corners of each face, anticlockwise seen from outside.
    """

    ambiguous: Integers
    first: Integers
    start: Integers
    triangles: Integers
    corner: Integers
    axis: Integers
    faces: Integers


class Samples(NamedTuple):
    """Values f of the field and c of what cuts it at the nodes of cells.

    A cell is the flat number of its lower node, ``strides`` are the steps of that number along the axes, and
    ``place`` (all nodes of the grid,) tells where f and c of a node stand.
    """

    strides: Integers
    place: Array
    f: Floats
    c: Floats


class Made(NamedTuple):
    """What marching fills: the vertex of each node's three edges, -1 for none; of each vertex its lower node and its
    shift from there in cells; the triangles.
    """

    of: Array
    node: Integers
    shift: Floats
    triangles: Integers


@lru_cache(maxsize=1)
def marching_tables() -> Tables:
    """The tables, made from their rules."""
    ambiguous = np.full((256, 6), -1)
    first = np.zeros(256, dtype=np.int64)
    start = [0]
    triangles: list[tuple[int, int, int]] = []
    for case in range(256):
        inside = [(case >> c) & 1 for c in range(8)]
        unclear = [k for k, face in enumerate(FACE_CORNERS) if _is_ambiguous([inside[c] for c in face])]
        ambiguous[case, : len(unclear)] = unclear
        first[case] = len(start) - 1
        for bits in range(1 << len(unclear)):
            joined = {face for b, face in enumerate(unclear) if bits >> b & 1}
            middle = 12
            for loop in _trace_loops(inside, joined):
                pieces = _triangulate(loop)
                if pieces is None:
                    pieces = [(loop[i - 1], loop[i], middle) for i in range(len(loop))]
                    middle += 1
                triangles.extend(pieces)
            start.append(len(triangles))
    return Tables(
        ambiguous, first, np.array(start), np.array(triangles), EDGE_CORNER, EDGE_AXIS, FACE_CORNERS
    )


def _is_ambiguous(signs: list[int]) -> bool:
    return signs in ([0, 1, 0, 1], [1, 0, 1, 0])


def _edge_between(a: int, b: int) -> int:
    low, axis = min(a, b), int(a ^ b).bit_length() - 1
    return int(np.flatnonzero((low == EDGE_CORNER) & (axis == EDGE_AXIS))[0])


_FACE_EDGES = [[_edge_between(face[i], face[(i + 1) % 4]) for i in range(4)] for face in FACE_CORNERS]
_FACES_OF_EDGE = [{k for k, edges in enumerate(_FACE_EDGES) if e in edges} for e in range(12)]


def _trace_loops(inside: list[int], joined: set[int]) -> list[list[int]]:
    """Loops of crossed edges; a segment runs from an edge that leaves the inside to one that enters."""
    following = {}
    for k, face in enumerate(FACE_CORNERS):
        signs = [inside[c] for c in face]
        leave = [i for i in range(4) if signs[i] and not signs[(i + 1) % 4]]
        enter = [i for i in range(4) if not signs[i] and signs[(i + 1) % 4]]
        for i in leave:
            # Joined, the segment goes round the outside corner ahead; else round the inside corner behind.
            step = 1 if k in joined else -1
            j = enter[0] if len(enter) == 1 else (i + step) % 4
            following[_FACE_EDGES[k][i]] = _FACE_EDGES[k][j]
    loops = []
    while following:
        edge = next(iter(following))
        loop = []
        while edge in following:
            loop.append(edge)
            edge = following.pop(edge)
        # Backwards, so that triangles face outwards.
        loops.append(loop[::-1])
    return loops


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a loop of edges with no diagonal inside a face of the cell; None where there are none."""
    if len(loop) < 3:
        return []
    for k in range(1, len(loop) - 1):
        left, right = loop[: k + 1], loop[k:]
        if _shares_face(left) or _shares_face(right):
            continue
        first, second = _triangulate(left), _triangulate(right)
        if first is not None and second is not None:
            return [*first, (loop[0], loop[k], loop[-1]), *second]
    return None


def _shares_face(part: list[int]) -> bool:
    """Whether the chord that closes a part of a loop is a diagonal that lies in a face."""
    return len(part) > 2 and bool(_FACES_OF_EDGE[part[0]] & _FACES_OF_EDGE[part[-1]])


@compiled(error_model="numpy")
def _combined(f, c, level):
    """The function whose zero set is extracted: max(f - level, -c)."""
    return max(f - level, -c)


@compiled(error_model="numpy")
def _crossing(f0, f1, c0, c1, level):
    """Where along an edge max(f - level, -c) vanishes, with f and c linear; ends 0 and 1 differ in sign.

    Interpolating f and c apart puts the point on the nearer of the two surfaces; interpolating their maximum
    would miss both where they meet.
    """
    start_inside = max(f0 - level, -c0) < 0
    fa, fb, ca, cb = (f0, f1, c0, c1) if start_inside else (f1, f0, c1, c0)
    t = 1.0
    if fb >= level:
        t = min(t, (level - fa) / (fb - fa))
    if cb <= 0:
        t = min(t, ca / (ca - cb))
    # Off the nodes, so that no triangle is degenerate.
    t = min(max(t, 1e-6), 1 - 1e-6)
    return t if start_inside else 1.0 - t


@compiled(error_model="numpy")
def _march_loop(cells, samples, level, tables, made):
    """Triangles of all cells; returns the numbers of vertices and triangles."""
    strides, f, c = samples.strides, samples.f, samples.c
    start, table, corner, axis = tables.start, tables.triangles, tables.corner, tables.axis
    vertex_of, vertex_node, vertex_shift, triangles = made
    nodes, values = np.empty(8, dtype=np.int64), np.empty(8)
    local = np.empty(16, dtype=np.int64)
    n_vertices, n_triangles = 0, 0
    for n in range(len(cells)):
        entry = _entry_of(cells[n], samples, level, tables, nodes, values)
        if entry < 0:
            continue
        rows = table[start[entry] : start[entry + 1]]
        local[:] = -1
        for t in range(len(rows)):
            for s in range(3):
                e = rows[t, s]
                if e < 12 and local[e] < 0:
                    q, a = corner[e], axis[e]
                    low, high = nodes[q], nodes[q + (1 << a)]
                    if vertex_of[low, a] < 0:
                        vertex_of[low, a] = n_vertices
                        vertex_node[n_vertices] = _corner_node(cells[n], q, strides)
                        vertex_shift[n_vertices] = 0.0
                        vertex_shift[n_vertices, a] = _crossing(f[low], f[high], c[low], c[high], level)
                        n_vertices += 1
                    local[e] = vertex_of[low, a]
                elif e >= 12 and local[e] < 0:
                    local[e] = n_vertices
                    n_vertices += 1
                triangles[n_triangles, s] = local[e]
            n_triangles += 1
        for e in range(12, 16):
            if local[e] >= 0:
                _centre_vertex(cells[n], local, e, rows, corner, vertex_shift, vertex_node)
    return n_vertices, n_triangles


@compiled(error_model="numpy")
def _corner_node(cell, q, strides):
    """Flat number of corner q of a cell."""
    return cell + (q & 1) * strides[0] + (q >> 1 & 1) * strides[1] + (q >> 2) * strides[2]


@compiled(error_model="numpy")
def _entry_of(cell, samples, level, tables, nodes, values):
    """Table entry of a cell, -1 where it is not crossed; its nodes and values go to the last two arrays."""
    strides, index, f, c = samples
    ambiguous, faces4 = tables.ambiguous, tables.faces
    case = 0
    for q in range(8):
        nodes[q] = index[_corner_node(cell, q, strides)]
        values[q] = _combined(f[nodes[q]], c[nodes[q]], level)
        if values[q] < 0:
            case |= 1 << q
    if case == 0 or case == 255:
        return -1
    bits = 0
    for b in range(6):
        k = ambiguous[case, b]
        if k < 0:
            break
        product = values[faces4[k, 0]] * values[faces4[k, 2]] - values[faces4[k, 1]] * values[faces4[k, 3]]
        # The saddle is inside where the product of the inside corners is the larger one.
        if product != 0 and (product > 0) == (values[faces4[k, 0]] < 0):
            bits |= 1 << b
    return tables.first[case] + bits


@compiled(error_model="numpy")
def _centre_vertex(cell, local, e, rows, corner, vertex_shift, vertex_node):
    """Put the middle vertex of a loop at the mean of the loop."""
    v = local[e]
    vertex_node[v] = cell
    vertex_shift[v] = 0.0
    number = 0
    for t in range(len(rows)):
        if rows[t, 2] == e:
            edge = rows[t, 0]
            q = corner[edge]
            for k in range(3):
                vertex_shift[v, k] += (q >> k & 1) + vertex_shift[local[edge], k]
            number += 1
    for k in range(3):
        vertex_shift[v, k] /= number
