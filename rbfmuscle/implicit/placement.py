"""Centres on a closed mesh: cells of equal size (long edges split, farthest points, clustering),
one point in each, its normal, and the control triangulation over them; kept on disk.

For the triangulation a mesh is contracted to one vertex for each cluster: edges inside each are
contracted where that keeps the manifold (link condition: the ends of the edge share exactly two
neighbours; Dey et al. 1999); what cannot be contracted goes to a neighbouring cluster. The result
is closed, 2-manifold and of the input's genus for any clustering.
"""

import heapq
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import morton_order
from rbfmuscle.geometry.exact_distance import nearest_weights
from rbfmuscle.geometry.frames import dot, minus, row_of
from rbfmuscle.geometry.surfaces import (
    barycentric_weights,
    edge_lengths,
    face_normals,
    opposite_half_edges,
    split_pinched_vertices,
    unique_edges,
    vertex_areas,
    vertex_normals,
)
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.loops import loop
from rbfmuscle.validation import MeshError, check_mesh

# Least ratio of cell size to edge length: about ten mesh vertices a cell, or cells get ragged.
FINENESS = 2.5


class FineMesh(NamedTuple):
    """The input mesh with its long edges split, and its vertices' neighbours: those of v are
    ``other[start[v]:start[v + 1]]``.
    """

    vertices: Floats  # (n, 3)
    faces: Integers  # (m, 3)
    edges: Integers  # (e, 2)
    start: Integers  # (n + 1,)
    tail: Integers  # (2e,) the vertex of each neighbour
    other: Integers  # (2e,)
    length: Floats  # (2e,) of the edge to each neighbour
    area: Floats  # (n,) that each vertex stands for


def refine_mesh(vertices: Floats, faces: Integers, count: int) -> FineMesh:
    """Split long edges until ``count`` cells of even size can be made of the mesh's triangles."""
    whole = np.linalg.norm(face_normals(vertices, faces), axis=1).sum()
    limit = np.sqrt(2 / np.sqrt(3) * whole / count) / FINENESS
    while True:
        sides = np.sort(
            np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1
        )
        long = edge_lengths(vertices, sides) > limit
        if not long.any():
            break
        vertices, faces = _split_edges(vertices, faces, sides, long)
    edges = unique_edges(faces)
    tail = edges.T.ravel()
    order = np.argsort(tail, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(tail, minlength=len(vertices)))])
    tail, other = tail[order], edges[:, ::-1].T.ravel()[order]
    length = np.linalg.norm(vertices[tail] - vertices[other], axis=1)
    area = vertex_areas(vertices, faces)
    return FineMesh(vertices, faces, edges, start, tail, other, length, area)


def _split_edges(
    vertices: Floats, faces: Integers, sides: Integers, long: Booleans
) -> tuple[Floats, Integers]:
    """Split the marked ones of the faces' sides (3m, 2) at their middles, conforming."""
    keys, inverse = np.unique(sides[long, 0] * len(vertices) + sides[long, 1], return_inverse=True)
    middle = np.full(len(sides), -1)
    middle[long] = len(vertices) + inverse
    ends = np.column_stack([keys // len(vertices), keys % len(vertices)])
    middle = middle.reshape(-1, 3)
    number = (middle >= 0).sum(axis=1)
    pieces = [faces[number == 0]]
    for corner in range(3):
        a, b, c = np.roll(faces, -corner, axis=1).T
        ab, bc, ca = np.roll(middle, -corner, axis=1).T
        one = (number == 1) & (ab >= 0)
        two = (number == 2) & (ca < 0)
        # Of the two ways to halve the quadrilateral left over, the shorter diagonal.
        to_bc = np.linalg.norm(0.5 * (vertices[b] + vertices[c]) - vertices[a], axis=1)
        to_ab = np.linalg.norm(0.5 * (vertices[a] + vertices[b]) - vertices[c], axis=1)
        short = to_bc < to_ab
        for rows, triangles in (
            (one, ((a, ab, c), (ab, b, c))),
            (two & short, ((ab, b, bc), (a, ab, bc), (a, bc, c))),
            (two & ~short, ((ab, b, bc), (a, ab, c), (ab, bc, c))),
        ):
            pieces += [np.column_stack(t)[rows] for t in triangles]
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    pieces += [
        np.column_stack(t)[number == 3]
        for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    ]
    return np.vstack([vertices, vertices[ends].mean(axis=1)]), np.vstack(pieces)


def cluster_mesh(
    fine: FineMesh, density: Floats, count: int, seed: int
) -> tuple[Integers, Integers]:
    """Cells of equal ``density`` times area, and the triangulation dual to them."""
    weight = fine.area * density
    start, tail = fine.start, fine.tail
    other = fine.other
    stretch = np.sqrt(density)
    length = fine.length * 0.5 * (stretch[tail] + stretch[other])
    used = np.flatnonzero(np.diff(start) > 0)
    first = used[np.random.default_rng(seed).integers(len(used))]
    labels = np.full(len(fine.vertices), -1)
    _farthest_loop(start, other, length, first, count, labels)
    _equalise_loop(fine.vertices - fine.vertices.mean(axis=0), weight, fine.edges, labels, count)
    _mark_loose(tail, other, weight, labels, count)
    _join_loop(start, other, labels)
    return contract_clusters(fine.faces, labels, weight, count)


@loop
def _farthest_loop(start, other, length, first, count, labels):
    """Farthest points by distance along edges; labels become the nearest of them."""
    distance = np.full(len(start) - 1, np.inf)
    # The greatest distance comes first, of equal ones the lowest number; what a vertex was before
    # it came nearer is passed over. A search of all vertices for each point would be quadratic.
    farthest = [(-np.inf, v) for v in range(len(distance)) if start[v] < start[v + 1]]
    chosen = first
    for k in range(count):
        distance[chosen] = 0.0
        labels[chosen] = k
        heap = [(0.0, chosen)]
        while len(heap) > 0:
            d, v = heapq.heappop(heap)
            if d > distance[v]:
                continue
            for e in range(start[v], start[v + 1]):
                w = other[e]
                if d + length[e] < distance[w]:
                    distance[w] = d + length[e]
                    labels[w] = k
                    heapq.heappush(heap, (distance[w], w))
                    heapq.heappush(farthest, (-distance[w], w))
        while len(farthest) > 0:
            d, chosen = heapq.heappop(farthest)
            if -d == distance[chosen]:
                break


@loop
def _cell_energy(moment, mass, k, sign, x, w):
    """Inertia of cell k but for a constant, with a vertex added (sign 1), taken away (-1) or
    neither.
    """
    m = mass[k] + sign * w
    if m <= 0:
        return 0.0
    total = 0.0
    for c in range(3):
        total += (moment[k, c] + sign * w * x[c]) ** 2
    return -total / m


@loop
def _equalise_loop(vertices, weight, edges, labels, count):
    """Move vertices between neighbouring cells while that lowers the sum of the cells' inertias."""
    moment = np.zeros((count, 3))
    mass = np.zeros(count)
    members = np.zeros(count, dtype=np.int64)
    for v in range(len(labels)):
        k = labels[v]
        if k >= 0:
            mass[k] += weight[v]
            members[k] += 1
            for c in range(3):
                moment[k, c] += weight[v] * vertices[v, c]
    # Each move lowers the sum by more than it is rounded, so that no state comes back: this ends.
    moved = -1
    while moved != 0:
        moved = 0
        for e in range(len(edges)):
            for side in range(2):
                v, k = edges[e, side], labels[edges[e, 1 - side]]
                old = labels[v]
                if old == k or members[old] == 1:
                    continue
                x, w = vertices[v], weight[v]
                before = _cell_energy(moment, mass, old, 0.0, x, w) + _cell_energy(
                    moment, mass, k, 0.0, x, w
                )
                after = _cell_energy(moment, mass, old, -1.0, x, w) + _cell_energy(
                    moment, mass, k, 1.0, x, w
                )
                if after < before - 1e-12 * abs(before):
                    moved += 1
                    labels[v] = k
                    members[old] -= 1
                    members[k] += 1
                    mass[old] -= w
                    mass[k] += w
                    for c in range(3):
                        moment[old, c] -= w * x[c]
                        moment[k, c] += w * x[c]


def _mark_loose(
    tail: Integers, other: Integers, weight: Floats, labels: Integers, count: int
) -> None:
    """Label all but the heaviest connected piece of each cell with -2."""
    same = labels[tail] == labels[other]
    links = coo_matrix(
        (np.ones(same.sum()), (tail[same], other[same])), shape=(len(labels), len(labels))
    )
    _, piece = connected_components(links, directed=False)
    heaviest = np.full(count, -1)
    ordered = np.argsort(np.bincount(piece, weight))
    cell = labels[np.unique(piece, return_index=True)[1]][ordered]
    heaviest[cell[cell >= 0]] = ordered[cell >= 0]
    labels[(labels >= 0) & (piece != heaviest[labels])] = -2


@loop
def _join_loop(start, other, labels):
    """Vertices of label -2 join a cell beside them."""
    loose = (labels == -2).sum()
    while loose > 0:
        for v in range(len(labels)):
            if labels[v] != -2:
                continue
            for e in range(start[v], start[v + 1]):
                if labels[other[e]] >= 0:
                    labels[v] = labels[other[e]]
                    loose -= 1
                    break


def contract_clusters(
    faces: Integers, labels: Integers, weights: Floats, count: int
) -> tuple[Integers, Integers]:
    """Contract a closed, oriented 2-manifold to ``count`` vertices, as a clustering says where the
    topology allows it.

    ``labels`` (n,) are the clusters of the vertices, 0 .. count - 1, ``weights`` (n,) their areas:
    the heaviest piece of a cluster that falls apart keeps its name. ``count`` is at least 4 a
    connected component, more for handles. Returns the final labels (n,), equal to those given but
    for pieces that had to change, and triangles (k, 3) over the clusters, oriented like ``faces``
    (m, 3). MeshError if no contraction to so few vertices keeps the topology.
    """
    twin = opposite_half_edges(faces)
    tail = faces.ravel().copy()
    out = np.full(len(labels), -1)
    out[tail] = np.arange(len(tail))
    used = out >= 0
    parent = np.arange(len(labels))
    label, weight = labels.astype(np.int64), weights.astype(np.float64)
    live = _contract_loop(tail, twin, out, parent, label, weight, int(used.sum()), count)
    if live != count:
        raise MeshError(
            f"mesh cannot be contracted to {count} points without changing its topology ({live} "
            "remain); "
            "ask for more points, or remove small components and handles"
        )
    roots = np.flatnonzero(used & (parent == np.arange(len(parent))))
    order = np.full(len(labels), -1)
    # A cluster keeps its number where it can, so that results do not hinge on vertex order.
    order[roots[np.argsort(label[roots], kind="stable")]] = np.arange(count)
    while (parent[parent] != parent).any():
        parent = parent[parent]
    control = tail.reshape(-1, 3)
    return order[parent], order[control[control[:, 0] >= 0]]


@loop
def _preceding(h):
    return h + 2 if h % 3 == 0 else h - 1


@loop
def _is_contractible(h, tail, twin, mark):
    """Whether the ends of half-edge h share exactly two neighbours (link condition)."""
    a, b = tail[h], tail[twin[h]]
    g = h
    while True:
        mark[tail[twin[g]]] = h
        g = twin[_preceding(g)]
        if g == h:
            break
    common = 0
    g = twin[h]
    while True:
        w = tail[twin[g]]
        if w != a and mark[w] == h:
            common += 1
        g = twin[_preceding(g)]
        if g == twin[h]:
            break
    g = h
    while True:
        mark[tail[twin[g]]] = -1
        g = twin[_preceding(g)]
        if g == h:
            break
    return common == 2 and a != b


@loop
def _contract(h, tail, twin, out, parent, weight):
    """Contract half-edge h = (a -> b): b is merged into a, two faces vanish."""
    a, b = tail[h], tail[twin[h]]
    g = twin[h]
    last = g
    while True:
        tail[g] = a
        g = twin[_preceding(g)]
        if g == last:
            break
    for side in (h, last):
        following = side - 2 if side % 3 == 2 else side + 1
        first, second = twin[following], twin[_preceding(side)]
        twin[first], twin[second] = second, first
        out[tail[first]] = first
        out[tail[second]] = second
        face = side - side % 3
        for c in range(3):
            tail[face + c] = -1
    parent[b] = a
    weight[a] += weight[b]


@loop
def _contract_one(tail, twin, out, parent, label, weight, mark, main):
    """Contract the lightest left-over piece into a neighbour; any light pair where no such piece
    can be.
    """
    best, best_cost = -1, np.inf
    for h in range(len(tail)):
        if tail[h] < 0:
            continue
        a, b = tail[h], tail[twin[h]]
        cost = weight[b] if main[label[b]] != b else 1e30 * (weight[a] + weight[b])
        if cost < best_cost and _is_contractible(h, tail, twin, mark):
            best, best_cost = h, cost
    if best >= 0:
        _contract(best, tail, twin, out, parent, weight)
    return best >= 0


@loop
def _contract_loop(tail, twin, out, parent, label, weight, live, count):
    """Contract edges inside clusters, then left-over pieces one by one; return the number of
    vertices left.
    """
    mark = np.full(len(parent), -1)
    main = np.full(label.max() + 1, -1)
    while True:
        changed = True
        while changed and live > count:
            changed = False
            for h in range(len(tail)):
                if tail[h] < 0 or live <= count:
                    continue
                a, b = tail[h], tail[twin[h]]
                inside = label[a] == label[b] and weight[a] >= weight[b]
                if inside and _is_contractible(h, tail, twin, mark):
                    _contract(h, tail, twin, out, parent, weight)
                    live -= 1
                    changed = True
        if live <= count:
            return live
        main[:] = -1
        for v in range(len(parent)):
            if (
                parent[v] == v
                and out[v] >= 0
                and (main[label[v]] < 0 or weight[v] > weight[main[label[v]]])
            ):
                main[label[v]] = v
        if not _contract_one(tail, twin, out, parent, label, weight, mark, main):
            return live
        live -= 1


# Densities stay within this ratio, so that no part of the surface is left without centres that
# carry it.
LARGEST_DENSITY = 30.0
# Trial fits of greedy placement, and centres beyond which they cost seconds: more of them follow
# the curvature alone.
GREEDY_ROUNDS, GREEDY_LARGEST = 5, 1000
# Weight of the cell's mean normal beside the normal at its point: 0 lets rims bulge, more blunts
# them.
CELL_SHARE = 0.5
PLACEMENTS = ("even", "adaptive", "greedy")


@dataclass(frozen=True)
class SurfaceSample:
    """Points (K, 3) [scene unit] on a closed mesh, unit outward normals, a closed, outward
    triangulation of them.
    """

    points: np.ndarray
    normals: np.ndarray
    control_faces: np.ndarray


def sample_surface(
    vertices: ArrayLike, faces: ArrayLike, count: int, *, seed: int = 0, placement: str = "adaptive"
) -> SurfaceSample:
    """Cover a closed, outward mesh (vertices (n, 3) [scene unit], faces (m, 3)) with ``count``
    points.

    The mesh is split into ``count`` connected cells of equal size (farthest points by distance
    along the surface, then clustering as in Valette & Chassery 2004); each cell gives one point.
    Cells never reach through a thin sheet, as distance and connection are those of the surface.
    ``count`` is at least 4 for each connected component; ``seed`` chooses the first point, the rest
    follows.

    ``placement`` is "even" (cells of equal size), "adaptive" (smaller where the surface bends) or
    "greedy" (smaller where a cubic Hermite fit misses the mesh: the most accurate, at 0.1 to 0.5 s;
    beyond 1000 points as adaptive). MeshError if the mesh is not a closed 2-manifold, or its
    topology needs more points; ValueError if ``count`` or ``placement`` is not allowed.
    """
    vertices, faces = check_mesh(vertices, faces)
    count = int(count)
    if count < 4:
        raise ValueError(f"count must be at least 4, got {count}")
    if placement not in PLACEMENTS:
        raise ValueError(f"placement must be one of {', '.join(PLACEMENTS)}, got {placement!r}")
    if (opposite_half_edges(faces) < 0).any():
        raise MeshError("mesh must be a closed, consistently oriented 2-manifold; repair it first")
    fine = refine_mesh(*split_pinched_vertices(vertices, faces), count)
    if placement == "greedy" and count <= GREEDY_LARGEST:
        return _greedy_sample(fine, count, seed)
    density = np.ones(len(fine.vertices)) if placement == "even" else curvature_density(fine, count)
    return _gather(fine, count, *cluster_mesh(fine, density, count, seed))


def _greedy_sample(fine: FineMesh, count: int, seed: int) -> SurfaceSample:
    """Cells made smaller, round by round, where a cubic Hermite fit misses the mesh.

    The first cells are those of `curvature_density`; each round raises the density of a cell by how
    much worse |f| at the mesh's vertices is there than elsewhere. Of all rounds, that with the
    smallest sum of root mean square and a fifth of the largest miss is returned.
    """
    best: SurfaceSample | None = None
    least = np.inf
    density = curvature_density(fine, count)
    for _ in range(GREEDY_ROUNDS):
        labels, control = cluster_mesh(fine, density, count, seed)
        sample = _gather(fine, count, labels, control)
        miss = np.abs(RBFField.fit_hermite(sample.points, sample.normals)(fine.vertices))
        rms = np.sqrt((miss**2).mean())
        if rms + 0.2 * miss.max() < least:
            best, least = sample, rms + 0.2 * miss.max()
        worst = np.zeros(count)
        np.maximum.at(worst, labels, miss)
        factor = np.clip(worst / (3 * rms), 0.7, 2.5)
        density = np.clip(density * factor[labels], 1, LARGEST_DENSITY)
    if best is None:
        raise MeshError(
            "no field fits centres on this mesh: every fit was NaN; try placement = 'even'"
        )
    return best


def curvature_density(fine: FineMesh, count: int) -> Floats:
    """Density of centres at the fine mesh's vertices (n,), 1 or more: how much the surface bends
    across one cell.

    The mean squared turn of the normal along edges, per length squared, smoothed over a cell: it is
    the sum of the squared principal curvatures up to a factor. The density is 1 + 4 (curvature x
    cell size)^2, so that flat parts keep their even cover.
    """
    area = np.linalg.norm(face_normals(fine.vertices, fine.faces), axis=1)
    normals = vertex_normals(fine.vertices, fine.faces)
    i, j = fine.edges.T
    length = edge_lengths(fine.vertices, fine.edges)
    turn = ((normals[i] - normals[j]) ** 2).sum(axis=1)
    size = len(fine.vertices)
    square = _edge_sum(i, j, turn, size) / np.maximum(
        _edge_sum(i, j, length**2, size), np.finfo(float).tiny
    )
    cell = area.sum() / count
    density = 1 + 4 * cell * square
    rounds = int(np.ceil(0.25 * cell / np.mean(length) ** 2))
    valence = np.maximum(_edge_sum(i, j, np.ones(len(i)), size), 1)
    for _ in range(rounds):
        beside = np.bincount(i, density[j], size) + np.bincount(j, density[i], size)
        density = 0.5 * density + 0.5 * beside / valence
    return np.clip(density, 1, LARGEST_DENSITY)


def _edge_sum(i: Integers, j: Integers, values: Floats, size: int) -> Floats:
    return np.asarray(np.bincount(i, values, size) + np.bincount(j, values, size), dtype=np.float64)


def _gather(fine: FineMesh, count: int, labels: Integers, control: Integers) -> SurfaceSample:
    """Points and normals of the cells."""
    vectors = face_normals(fine.vertices, fine.faces)
    third = np.linalg.norm(vectors, axis=1) / 3
    corner = labels[fine.faces]

    def cell_sums(values: Floats) -> Floats:
        """Sums (count, 3) over the cells of values (m, 3) of the triangles, one for each corner."""
        thrice = np.repeat(values, 3, axis=0)
        sums = [np.bincount(corner.ravel(), column, count) for column in thrice.T]
        return np.stack(sums, axis=1).astype(np.float64)

    areas = np.bincount(corner.ravel(), np.repeat(third, 3), count)
    middle = fine.vertices[fine.faces].mean(axis=1)
    tiny = np.finfo(float).tiny
    centroid = cell_sums(third[:, None] * middle) / np.maximum(areas, tiny)[:, None]
    # The nearest point of the cell itself, not of the mesh: that could lie on the other side of a
    # thin sheet.
    points = np.zeros((count, 3))
    piece = np.zeros(count, dtype=np.int64)
    distance = np.full(count, np.inf)
    _nearest_in_cell_loop(fine.vertices, fine.faces, corner, centroid, points, piece, distance)
    # A cell without a triangle of its own gives a vertex.
    for k in np.flatnonzero(np.isinf(distance)):
        places = np.flatnonzero(corner == k)
        its = fine.vertices[fine.faces.ravel()[places]]
        nearest = int(np.argmin(((its - centroid[k]) ** 2).sum(axis=1)))
        points[k], piece[k] = its[nearest], places[nearest] // 3
    # Normals in the triangles, drawn towards the mean of each point's cell.
    corners = fine.faces[piece]
    weights = barycentric_weights(points, fine.vertices[corners])
    here = np.einsum("kc,kcd->kd", weights, vertex_normals(fine.vertices, fine.faces)[corners])
    mean = cell_sums(vectors)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), tiny)[:, None]
    normals = here + CELL_SHARE * mean
    cancelled = np.linalg.norm(normals, axis=1) < 1e-6
    normals[cancelled] = vectors[piece[cancelled]]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return SurfaceSample(points, normals, control)


@loop
def _nearest_in_cell_loop(vertices, faces, corner, target, points, face, distance):
    """Point nearest to target[k] of the triangles wholly in cell k: at a thin rim two would else
    take the same.
    """
    for f in range(len(faces)):
        k = corner[f, 0]
        if corner[f, 1] != k or corner[f, 2] != k:
            continue
        a = row_of(vertices, faces[f, 0])
        b = row_of(vertices, faces[f, 1])
        c = row_of(vertices, faces[f, 2])
        at = row_of(target, k)
        _, second, third = nearest_weights(at, a, b, c)
        found = (
            a[0] + second * (b[0] - a[0]) + third * (c[0] - a[0]),
            a[1] + second * (b[1] - a[1]) + third * (c[1] - a[1]),
            a[2] + second * (b[2] - a[2]) + third * (c[2] - a[2]),
        )
        way = minus(at, found)
        if dot(way, way) < distance[k]:
            distance[k] = dot(way, way)
            face[k] = f
            for axis in range(3):
                points[k, axis] = found[axis]


# Part of the names under which samples are kept: raise it when the way to find them changes.
SAMPLING = 5
SEED = 0


def cached_sample(
    vertices: np.ndarray, faces: np.ndarray, count: int, placement: str
) -> SurfaceSample:
    """`sample_surface` of a muscle's mesh, from the cache on disk by content: greedy placement
    takes a second.

    Points are in an order in which near ones are mostly near each other, except for greedy
    placement. A mesh of ``count`` vertices is its own even sample.
    """
    if placement == "even" and len(vertices) == count:
        normals = vertex_normals(vertices, faces)
        return SurfaceSample(vertices, normals, np.ascontiguousarray(faces, dtype=np.int64))
    key = content_key(vertices, faces, ("surface sample", SAMPLING, count, SEED, placement))
    arrays = load_arrays(key)
    if arrays is None:
        arrays = asdict(sample_surface(vertices, faces, count, seed=SEED, placement=placement))
        if placement != "greedy":
            order = morton_order(arrays["points"])
            corners = np.argsort(order)[arrays.pop("control_faces")]
            arrays = {name: part[order] for name, part in arrays.items()} | {
                "control_faces": corners
            }
        store_arrays(key, arrays)
    return SurfaceSample(**arrays)
