"""Control triangulation: a closed triangle mesh contracted to one vertex for each cluster.

Edges inside each cluster are contracted where that keeps the manifold (link condition: the ends of the edge share
exactly two neighbours; Dey et al. 1999); what cannot be contracted goes to a neighbouring cluster. The result is
closed, 2-manifold and of the input's genus for any clustering.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import opposite_half_edges
from rbfmuscle.jit import compiled
from rbfmuscle.validation import MeshError


def contract_clusters(
    faces: Integers, labels: Integers, weights: Floats, count: int
) -> tuple[Integers, Integers]:
    """Contract a closed, oriented 2-manifold to ``count`` vertices, as a clustering says where the topology allows it.

    ``labels`` (n,) are the clusters of the vertices, 0 .. count - 1, ``weights`` (n,) their areas: the heaviest piece
    of a cluster that falls apart keeps its name. ``count`` is at least 4 a connected component, more for handles.
    Returns the final labels (n,), equal to those given but for pieces that had to change, and triangles (k, 3) over the
    clusters, oriented like ``faces`` (m, 3). MeshError if no contraction to so few vertices keeps the topology.
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
            f"mesh cannot be contracted to {count} points without changing its topology ({live} remain); "
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


@compiled
def _following(h):
    return h - 2 if h % 3 == 2 else h + 1


@compiled
def _preceding(h):
    return h + 2 if h % 3 == 0 else h - 1


@compiled
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


@compiled
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
        first, second = twin[_following(side)], twin[_preceding(side)]
        twin[first], twin[second] = second, first
        out[tail[first]] = first
        out[tail[second]] = second
        face = side - side % 3
        for c in range(3):
            tail[face + c] = -1
    parent[b] = a
    weight[a] += weight[b]


@compiled
def _contract_one(tail, twin, out, parent, label, weight, mark, main):
    """Contract the lightest left-over piece into a neighbour; any light pair where no such piece can be."""
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


@compiled
def _contract_loop(tail, twin, out, parent, label, weight, live, count):
    """Contract edges inside clusters, then left-over pieces one by one; return the number of vertices left."""
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
            if parent[v] == v and out[v] >= 0 and (main[label[v]] < 0 or weight[v] > weight[main[label[v]]]):
                main[label[v]] = v
        if not _contract_one(tail, twin, out, parent, label, weight, mark, main):
            return live
        live -= 1
