"""Cells of equal size on a closed mesh: long edges split, farthest points, clustering."""

import heapq
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import face_normals, unique_edges
from rbfmuscle.implicit.placement.control_mesh import contract_clusters
from rbfmuscle.jit import compiled

# Least ratio of cell size to edge length: about ten mesh vertices a cell, or cells get ragged.
FINENESS = 2.5
# Sweeps over the edges in which vertices change their cell, at most.
ROUNDS = 200


class FineMesh(NamedTuple):
    """The input mesh with its long edges split."""

    vertices: Floats
    faces: Integers


def refine_mesh(vertices: Floats, faces: Integers, count: int) -> FineMesh:
    """Split long edges until ``count`` cells of even size can be made of the mesh's triangles."""
    area = np.linalg.norm(face_normals(vertices, faces), axis=1).sum()
    limit = np.sqrt(2 / np.sqrt(3) * area / count) / FINENESS
    while True:
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        long = np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1) > limit
        if not long.any():
            return FineMesh(vertices, faces)
        vertices, faces = _split_edges(vertices, faces, sides, long)


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
        short = np.linalg.norm(0.5 * (vertices[b] + vertices[c]) - vertices[a], axis=1) < np.linalg.norm(
            0.5 * (vertices[a] + vertices[b]) - vertices[c], axis=1
        )
        for rows, triangles in (
            (one, ((a, ab, c), (ab, b, c))),
            (two & short, ((ab, b, bc), (a, ab, bc), (a, bc, c))),
            (two & ~short, ((ab, b, bc), (a, ab, c), (ab, bc, c))),
        ):
            pieces += [np.column_stack(t)[rows] for t in triangles]
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    pieces += [np.column_stack(t)[number == 3] for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.vstack([vertices, vertices[ends].mean(axis=1)]), np.vstack(pieces)


def cluster_mesh(fine: FineMesh, density: Floats, count: int, seed: int) -> tuple[Integers, Integers]:
    """Cells of equal ``density`` times area, and the triangulation dual to them."""
    area = np.linalg.norm(face_normals(fine.vertices, fine.faces), axis=1)
    weight = np.bincount(fine.faces.ravel(), np.repeat(area / 3, 3), len(fine.vertices)) * density
    edges = unique_edges(fine.faces)
    # Rows of neighbours: those of v are other[start[v]:start[v + 1]].
    tail = np.concatenate([edges[:, 0], edges[:, 1]])
    order = np.argsort(tail, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(tail, minlength=len(fine.vertices)))])
    tail, other = tail[order], np.concatenate([edges[:, 1], edges[:, 0]])[order]
    length = np.linalg.norm(fine.vertices[tail] - fine.vertices[other], axis=1)
    stretch = np.sqrt(density)
    length *= 0.5 * (stretch[tail] + stretch[other])
    used = np.flatnonzero(np.diff(start) > 0)
    first = used[np.random.default_rng(seed).integers(len(used))]
    labels = np.full(len(fine.vertices), -1)
    _farthest_loop(start, other, length, first, count, labels)
    _equalise_loop(fine.vertices - fine.vertices.mean(axis=0), weight, edges, labels, count)
    _mark_loose(tail, other, weight, labels, count)
    _join_loop(start, other, labels)
    return contract_clusters(fine.faces, labels, weight, count)


@compiled
def _farthest_loop(start, other, length, first, count, labels):
    """Farthest points by distance along edges; labels become the nearest of them."""
    distance = np.full(len(start) - 1, np.inf)
    for v in range(len(distance)):
        if start[v] == start[v + 1]:
            distance[v] = -1.0
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
        chosen = np.argmax(distance)


@compiled
def _cell_energy(moment, mass, k, sign, x, w):
    """Inertia of cell k but for a constant, with a vertex added (sign 1), taken away (-1) or neither."""
    m = mass[k] + sign * w
    if m <= 0:
        return 0.0
    total = 0.0
    for c in range(3):
        total += (moment[k, c] + sign * w * x[c]) ** 2
    return -total / m


@compiled
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
    for _ in range(ROUNDS):
        moved = 0
        for e in range(len(edges)):
            for side in range(2):
                v, k = edges[e, side], labels[edges[e, 1 - side]]
                old = labels[v]
                if old == k or members[old] == 1:
                    continue
                x, w = vertices[v], weight[v]
                before = _cell_energy(moment, mass, old, 0.0, x, w) + _cell_energy(moment, mass, k, 0.0, x, w)
                after = _cell_energy(moment, mass, old, -1.0, x, w) + _cell_energy(moment, mass, k, 1.0, x, w)
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
        if moved == 0:
            break


def _mark_loose(tail: Integers, other: Integers, weight: Floats, labels: Integers, count: int) -> None:
    """Label all but the heaviest connected piece of each cell with -2."""
    same = labels[tail] == labels[other]
    links = coo_matrix((np.ones(same.sum()), (tail[same], other[same])), shape=(len(labels), len(labels)))
    _, piece = connected_components(links, directed=False)
    heaviest = np.full(count, -1)
    ordered = np.argsort(np.bincount(piece, weight))
    cell = labels[np.unique(piece, return_index=True)[1]][ordered]
    heaviest[cell[cell >= 0]] = ordered[cell >= 0]
    labels[(labels >= 0) & (piece != heaviest[labels])] = -2


@compiled
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
