"""Normals, edges, enclosed volumes and motions of triangle meshes; meshes of fewer triangles."""

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import igl
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.frames import cross, divided, dot, minus, plus, row_of
from rbfmuscle.loops import loop

if TYPE_CHECKING:
    import trimesh


def face_normals(vertices: Floats, faces: Integers) -> Floats:
    """Area vectors (m, 3) of triangles: outward, as long as the area [unit^2]."""
    a = vertices[faces[:, 0]]
    b = vertices[faces[:, 1]]
    c = vertices[faces[:, 2]]
    return 0.5 * np.cross(b - a, c - a)


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """Unit normals (n, 3) at vertices, mean of the faces around weighted by area; zero where these
    cancel.
    """
    normals = np.zeros((len(vertices), 3))
    _vertex_normal_loop(np.asarray(vertices, dtype=np.float64), faces, normals)
    return normals


@loop
def _vertex_normal_loop(vertices, faces, normals):
    for f in range(len(faces)):
        normal = triangle_plane(vertices, faces, f)[3]
        for corner in range(3):
            for k in range(3):
                normals[faces[f, corner], k] += normal[k]
    for v in range(len(normals)):
        total = row_of(normals, v)
        length = max(np.sqrt(dot(total, total)), 1e-300)
        for k in range(3):
            normals[v, k] /= length


def faces_around(faces: Integers, count: int) -> tuple[Integers, Integers]:
    """Faces around each of ``count`` vertices: those of vertex v are ``face[start[v] : start[v +
    1]]``.
    """
    order = np.argsort(faces.ravel(), kind="stable")
    return np.searchsorted(faces.ravel()[order], np.arange(count + 1)), order // 3


@loop
def normal_at(vertices, faces, around, v):
    """One of `vertex_normals`, with the faces ``around`` the vertices (`faces_around`)."""
    start, face = around
    total = 0.0, 0.0, 0.0
    for n in range(start[v], start[v + 1]):
        total = plus(total, triangle_plane(vertices, faces, face[n])[3])
    return divided(total, max(np.sqrt(dot(total, total)), 1e-300))


@loop
def triangle_plane(vertices, faces, f):
    """Corner A of a triangle, its sides to B and C, and its normal, twice its area long."""
    a = row_of(vertices, faces[f, 0])
    to_b = corner_from(vertices, faces[f, 1], a)
    to_c = corner_from(vertices, faces[f, 2], a)
    return a, to_b, to_c, cross(to_b, to_c)


def unique_edges(faces: Integers) -> Integers:
    """Edges of a triangle mesh, (e, 2), each once, its lesser vertex first.

    In the order of the sides that run from the lesser to the greater vertex, which is one of each
    two on a closed, oriented mesh; then those that have none such.
    """
    faces = np.asarray(faces)
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    forward = sides[:, 0] < sides[:, 1]
    ends = np.concatenate([sides[forward], sides[~forward][:, ::-1]])
    _, first = np.unique(ends[:, 0] * (faces.max(initial=0) + 1) + ends[:, 1], return_index=True)
    return ends[np.sort(first)]


def sorted_half_edges(faces: Integers) -> tuple[Integers, Integers, Integers]:
    """Half-edges (3m,), ``3 * face + corner``, so sorted that those of an edge follow each other;
    where each edge begins there (e,), and how many it has (e,).
    """
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(tail, head) * (int(faces.max(initial=0)) + 1) + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    return order, first, np.diff(first, append=len(key))


def opposite_half_edges(faces: Integers) -> Integers:
    """Number (3m,) of the opposite half-edge of each half-edge ``3 * face + corner``, which runs to
    the next corner.

    -1 where the edge has no other face; -2 where it has several, or one that runs the same way.
    """
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    order, first, count = sorted_half_edges(faces)
    opposite = np.full(len(tail), -2)
    opposite[order[first[count == 1]]] = -1
    one, other = (order[first[count == 2] + k] for k in range(2))
    paired = (tail[one] == head[other]) & (one // 3 != other // 3)
    one, other = one[paired], other[paired]
    opposite[one], opposite[other] = other, one
    return opposite


def joined_meshes(vertices: Sequence[Floats], faces: Sequence[Integers]) -> tuple[Floats, Integers]:
    """Meshes as one, each of vertices (n, 3) and faces (m, 3), in their order."""
    starts = np.cumsum([0, *map(len, vertices)])
    moved = [part + start for part, start in zip(faces, starts)]
    return np.concatenate(vertices), np.concatenate(moved)


def repeated_faces(faces: Integers) -> Booleans:
    """Mask (m,) of the faces that name a vertex twice, or the vertices of a face before them."""
    degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    rows = np.sort(faces, axis=1).astype(np.int64).view("V24")  # bytes sort faster than rows
    _, first = np.unique(rows, return_index=True)
    again = np.ones(len(faces), dtype=bool)
    again[first] = False
    return degenerate | again


def split_pinched_vertices(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Repeat each vertex where several fans of triangles meet, so that every fan has its own.

    For closed and consistently oriented faces, which keep their order; repeated vertices come after
    those given.
    """
    size, twin = len(vertices), opposite_half_edges(faces)
    # the corner after the opposite side, in the neighbouring triangle, is at the same vertex
    beside = twin - twin % 3 + (twin + 1) % 3
    corners = len(twin)
    links = coo_matrix((np.ones(corners), (np.arange(corners), beside)), shape=(corners, corners))
    count, fan = connected_components(links, directed=False)
    at, first = faces.ravel(), np.unique(fan, return_index=True)[1]
    number = at[first]
    repeated = np.ones(count, dtype=bool)
    repeated[np.unique(number, return_index=True)[1]] = False
    number[repeated] = size + np.arange(repeated.sum())
    return np.vstack([vertices, vertices[at[first][repeated]]]), number[fan].reshape(-1, 3)


def connected_vertices(faces: Integers, vertices: Integers) -> list[Integers]:
    """Some vertices (k,) of a mesh by the pieces that edges between them join."""
    edges = unique_edges(faces)
    edges = edges[np.isin(edges, vertices).all(axis=1)]
    size = int(faces.max()) + 1
    joined = coo_matrix((np.ones(len(edges)), edges.T), shape=(size, size))
    label = connected_components(joined, directed=False)[1][vertices]
    return [vertices[label == piece] for piece in np.unique(label)]


def label_sheets(faces: Integers, count: int) -> tuple[int, Integers]:
    """Number of connected sheets of a triangle mesh, and the sheet (count,) of each vertex."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(count, count))
    return connected_components(links, directed=False)


def edge_lengths(vertices: Floats, edges: Integers) -> Floats:
    """Length (e,) of each edge [unit of the vertices]."""
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)


def vertex_areas(vertices: Floats, faces: Integers) -> Floats:
    """Area that each vertex stands for: a third of its triangles' (n,)."""
    third = np.linalg.norm(face_normals(vertices, faces), axis=1) / 3.0
    return np.bincount(faces.ravel(), np.repeat(third, 3), minlength=len(vertices)).astype(float)


def even_points(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """Points (count, 3) evenly over the area of a mesh, and the triangle (count,) that holds each;
    none where there are no triangles.
    """
    if not len(faces):
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    number = np.arange(count) + 0.5
    face = np.searchsorted(area, number / count * area[-1])
    # The additive recurrence of the plastic number spreads points evenly (Roberts 2018).
    share = (number[:, None] * [0.7548776662466927, 0.5698402909980532]) % 1.0
    over = share.sum(axis=1) > 1.0
    share[over] = 1.0 - share[over]
    s, t = share.T[:, :, None]
    return a[face] + s * (b - a)[face] + t * (c - a)[face], face


def barycentric_weights(points: Floats, corners: Floats) -> Floats:
    """Weights (n, 3) in [0, 1] of the corners (n, 3, 3) of one triangle for each point (n, 3) in or
    near it.
    """
    a = corners[:, 0]
    b = corners[:, 1]
    c = corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    v = np.einsum("ij,ij->i", np.cross(points - a, c - a), normal) / square
    w = np.einsum("ij,ij->i", np.cross(b - a, points - a), normal) / square
    out = np.maximum(np.column_stack([1 - v - w, v, w]), 0.0)
    return out / out.sum(axis=1)[:, None]


def mesh_volume(vertices: Floats, faces: Integers) -> float:
    """Volume enclosed by a closed, outward mesh, about one of its vertices, so that a far origin
    costs no digits.

    Examples
    --------
    >>> import numpy as np
    >>> tetrahedron = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> round(mesh_volume(tetrahedron, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])), 6)
    0.166667
    """
    return float(volume_loop(np.asarray(vertices, dtype=np.float64), np.asarray(faces)))


@loop
def six_volumes(p, q, r):
    """Six times the signed volume of the tetrahedron of the origin and three points: r . (p x
    q).
    """
    return dot(cross(p, q), r)


@loop
def corner_from(vertices, v, origin):
    """Vertex v relative to an origin, as three numbers."""
    return minus(row_of(vertices, v), origin)


@loop
def volume_loop(vertices, faces):
    """Enclosed volume, measured from a corner of the first face; 0 without faces."""
    if len(faces) == 0:
        return 0.0
    total, origin = 0.0, row_of(vertices, faces[0, 0])
    for f in range(len(faces)):
        p = corner_from(vertices, faces[f, 0], origin)
        q = corner_from(vertices, faces[f, 1], origin)
        r = corner_from(vertices, faces[f, 2], origin)
        total += six_volumes(q, r, p)
    return total / 6.0


@loop
def volume_rate(vertices, faces, direction):
    """The volume of a closed mesh, and how fast it grows along directions d (n, 3)."""
    volume, rate = 0.0, 0.0
    origin = row_of(vertices, faces[0, 0])
    for f in range(len(faces)):
        i, j, k = row_of(faces, f)
        r = corner_from(vertices, k, origin)
        p = minus(corner_from(vertices, i, origin), r)
        q = minus(corner_from(vertices, j, origin), r)
        normal = cross(p, q)
        volume += dot(normal, r)
        for a in range(3):
            rate += normal[a] * (direction[i, a] + direction[j, a] + direction[k, a])
    return volume / 6.0, rate / 6.0


@loop
def volume_cubic(vertices, faces, direction):
    """Coefficients c of the volume V(x + s d) = c0 + c1 s + c2 s^2 + c3 s^3 of a closed mesh along
    directions d (n, 3).

    With N(s) twice a triangle's area vector, dV/ds is the sum of N(s) . (d_i + d_j + d_k) / 6.
    """
    c0 = 0.0
    c1 = 0.0
    c2 = 0.0
    c3 = 0.0
    origin = row_of(vertices, faces[0, 0])
    for f in range(len(faces)):
        i, j, k = row_of(faces, f)
        at = row_of(vertices, i)
        p = minus(at, origin)
        u = row_of(direction, i)
        total = (
            u[0] + direction[j, 0] + direction[k, 0],
            u[1] + direction[j, 1] + direction[k, 1],
            u[2] + direction[j, 2] + direction[k, 2],
        )
        q = corner_from(vertices, j, at)
        r = corner_from(vertices, k, at)
        v = corner_from(direction, j, u)
        w = corner_from(direction, k, u)
        c0 += six_volumes(q, r, p)
        c1 += six_volumes(q, r, total)
        c2 += six_volumes(q, w, total) + six_volumes(v, r, total)
        c3 += six_volumes(v, w, total)
    return c0 / 6.0, c1 / 6.0, c2 / 12.0, c3 / 18.0


def change_to_volume(
    vertices: Floats, faces: Integers, direction: Floats, volume: float, steps: int
) -> float:
    """How far along directions d (n, 3) a closed mesh has a volume, by so many Newton steps of the
    cubic polynomial; NaN where the volume does not grow along them.
    """
    c0, c1, c2, c3 = volume_cubic(vertices, faces, direction)
    change = 0.0
    for _ in range(steps):
        lack = volume - (c0 + change * (c1 + change * (c2 + change * c3)))
        if lack == 0.0:
            break
        rate = c1 + change * (2.0 * c2 + change * 3.0 * c3)
        if not rate > 0.0:
            return np.nan
        change += lack / rate
    return change


@loop
def touching_balls(points, normals, steps, nearest):
    """Radii ``steps`` (2, n) of the empty balls that touch each point from outside and inside,
    infinite where no point limits them, and how far the nearest other point is.
    """
    for i in range(len(points)):
        at = row_of(points, i)
        normal = row_of(normals, i)
        steps[:, i] = np.inf
        least = np.inf
        for j in range(len(points)):
            if j == i:
                continue
            way = corner_from(points, j, at)
            square = dot(way, way)
            along = dot(way, normal)
            least = min(least, square)
            side = 0 if along > 0 else 1
            if along != 0.0:
                steps[side, i] = min(steps[side, i], square / (2 * abs(along)))
        nearest[i] = np.sqrt(least)


def mesh_hash(vertices: Floats, faces: Integers) -> str:
    """SHA-256 of vertices (n, 3) and triangles (m, 3)."""
    points = np.ascontiguousarray(vertices, dtype=np.float64)
    corners = np.ascontiguousarray(faces, dtype=np.int64)
    return hashlib.sha256(points.tobytes() + corners.tobytes()).hexdigest()


class EdgeLengths:
    """Lengths (e,) of the edges of vertices (n, 3) and faces (m, 3), over those at rest; edges
    without a length there are left out.
    """

    def __init__(self, rest: Floats, faces: Integers) -> None:
        edges = unique_edges(faces)
        lengths = edge_lengths(rest, edges)
        self.edges = edges[lengths > 0.0]
        inverse = 1.0 / lengths[lengths > 0.0]
        rows, shape = np.arange(len(self.edges)), (len(self.edges), len(rest))
        places = np.tile(rows, 2), self.edges.T.ravel()
        #: Sparse (e, n), from vertices to edges in units of their lengths at rest.
        self._vectors = coo_matrix((np.concatenate([inverse, -inverse]), places), shape).tocsr()

    def __call__(self, now: Floats) -> Floats:
        """The lengths at vertices (n, 3)."""
        vectors = self._vectors @ now
        return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))

    def stretch(self, now: Floats) -> Floats:
        """Mean change of length (n,) of the edges about each vertex at vertices (n, 3)."""
        ends = self.edges.T.ravel()
        change = np.bincount(ends, np.tile(self(now) - 1.0, 2), len(now))
        return change / np.maximum(np.bincount(ends, minlength=len(now)), 1)


@loop
def farthest_move(before, after):
    """How far a point (n, 3) moved at most; infinity where one is not finite."""
    most = 0.0
    for i in range(len(before)):
        way = minus(row_of(after, i), row_of(before, i))
        square = dot(way, way)
        if not square <= most:
            most = square if np.isfinite(square) else np.inf
    return np.sqrt(most)


@loop
def longest(vectors):
    """The greatest length of vectors (n, 3)."""
    most = 0.0
    for i in range(len(vectors)):
        vector = row_of(vectors, i)
        most = max(most, dot(vector, vector))
    return np.sqrt(most)


def surface_graph(mesh: "trimesh.Trimesh") -> csr_matrix:
    """Lengths of the edges of a mesh, and of the ways across them to the corner on the other side:
    paths along edges alone are up to 15 % too long, these some per cent.
    """
    ends = np.concatenate([mesh.edges_unique, mesh.face_adjacency_unshared])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    count = len(mesh.vertices)
    return coo_matrix((np.maximum(lengths, 1e-300), ends.T), shape=(count, count)).tocsr()


def geodesic(graph: csr_matrix, vertices: ArrayLike) -> Floats:
    """Length (n,) of the shortest path over a surface from the nearest of some vertices, infinite
    where there is none.
    """
    start = np.atleast_1d(vertices)
    found: Floats = dijkstra(graph, directed=False, indices=start, min_only=True)
    return found


def simplified(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """A closed mesh of about as many triangles as wanted, near the given one; one that has no more
    as it is.

    Edges collapse in the order of their quadric error (Garland and Heckbert 1997, "Surface
    simplification using quadric error metrics"). A mesh that is not manifold, or that cannot
    collapse so far, as one of many parts, is `clustered`.
    """
    vertices, faces = np.array(vertices, dtype=float), np.array(faces, dtype=np.int64)
    if len(faces) <= count:
        return vertices, faces
    if not igl.is_edge_manifold(faces)[0]:
        return clustered(vertices, faces, count)
    fewer, kept, _, _ = igl.qslim(vertices, faces, count)
    if not len(kept):  # so it says that it cannot
        return clustered(vertices, faces, count)
    return np.ascontiguousarray(fewer), np.ascontiguousarray(kept)


def clustered(vertices: Floats, faces: Integers, count: int) -> tuple[Floats, Integers]:
    """A mesh of about as many triangles as wanted, with holes and doubled edges; one that has no
    more as it is.

    Takes any mesh of any size. The vertices of each cell of a grid become their mean (Rossignac and
    Borrel 1993, "Multi-resolution 3D approximations for rendering complex scenes").
    """
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    if len(faces) <= count:
        return vertices, faces
    area = float(np.linalg.norm(face_normals(vertices, faces), axis=1).sum())
    cells = np.floor((vertices - vertices.min(axis=0)) / np.sqrt(2.0 * area / count)).astype(
        np.int64
    )
    keys = np.ravel_multi_index(cells.T, cells.max(axis=0) + 1)
    _, place, members = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(place, vertices[:, k]) / members for k in range(3)], axis=1)
    new = place[faces]
    return means, new[(new != np.roll(new, 1, axis=1)).all(axis=1)]
