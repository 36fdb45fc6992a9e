"""Cells of equal size on a closed mesh: long edges split, farthest points, clustering, and the
triangulation over them.

For that a mesh is contracted to one vertex for each cluster: edges inside each are contracted where
that keeps the manifold (link condition: the ends of the edge share exactly two neighbours; Dey et
al. 1999); what cannot be contracted goes to a neighbouring cluster. The result is closed,
2-manifold and of the input's genus for any clustering.
"""

import heapq
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import (
    face_normals,
    opposite_half_edges,
    unique_edges,
    vertex_areas,
)
from rbfmuscle.loops import loop
from rbfmuscle.validation import MeshError

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
    area = np.linalg.norm(face_normals(vertices, faces), axis=1).sum()
    limit = np.sqrt(2 / np.sqrt(3) * area / count) / FINENESS
    while True:
        sides = np.sort(
            np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1
        )
        long = np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1) > limit
        if not long.any():
            return _with_neighbours(vertices, faces)
        vertices, faces = _split_edges(vertices, faces, sides, long)


def _with_neighbours(vertices: Floats, faces: Integers) -> FineMesh:
    edges = unique_edges(faces)
    tail = edges.T.ravel()
    order = np.argsort(tail, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(tail, minlength=len(vertices)))])
    tail, other = tail[order], edges[:, ::-1].T.ravel()[order]
    length = np.linalg.norm(vertices[tail] - vertices[other], axis=1)
    return FineMesh(
        vertices, faces, edges, start, tail, other, length, vertex_areas(vertices, faces)
    )


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
        short = np.linalg.norm(
            0.5 * (vertices[b] + vertices[c]) - vertices[a], axis=1
        ) < np.linalg.norm(0.5 * (vertices[a] + vertices[b]) - vertices[c], axis=1)
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
