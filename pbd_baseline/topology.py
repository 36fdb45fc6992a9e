"""Connections of a closed triangle mesh: edges, wings, one-rings, and the colouring of
constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components

from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.geometry.surfaces import opposite_half_edges
from rbfmuscle.loops import loop
from rbfmuscle.validation import MeshError, check_mesh

# Offsets in a flat array of coordinates, as unsigned as the vertices of `members_in_order`.
ONE = np.uint32(1)
TWO = np.uint32(2)
THREE = np.uint32(3)


@dataclass(frozen=True)
class Topology:
    """Connections of a closed, consistently oriented mesh; every array is read only."""

    faces: np.ndarray  # (m, 3)
    edges: np.ndarray  # (e, 2) each undirected edge once, the smaller vertex first
    # (e, 2) vertices opposite to an edge: in the face that runs along it, then in the one against
    # it
    wings: np.ndarray
    ring_start: np.ndarray  # (n + 1,)
    ring: (
        np.ndarray
    )  # (2 e,) sorted neighbours of vertex i: ring[ring_start[i] : ring_start[i + 1]]
    ring_edge: np.ndarray  # (2 e,) edge that leads to each neighbour

    @classmethod
    def from_mesh(cls, vertices: Floats, faces: Integers) -> Topology:
        """Connect a mesh; MeshError if it is not closed and consistently oriented, or a vertex has
        no face.
        """
        vertices, faces = check_mesh(vertices, faces)
        edges, wings = _edges_and_wings(faces)
        source, target = np.concatenate([edges, edges[:, ::-1]]).T
        order = np.lexsort((target, source))
        ring_start = np.searchsorted(source[order], np.arange(len(vertices) + 1))
        ring = np.ascontiguousarray(target[order])
        ring_edge = order % len(edges)
        lonely = np.flatnonzero(np.diff(ring_start) == 0)
        if len(lonely):
            raise MeshError(
                f"{len(lonely)} vertices of the muscle belong to no face, the first is {lonely[0]}"
            )
        parts = faces, edges, wings, ring_start, ring, ring_edge
        for part in parts:
            part.setflags(write=False)
        return cls(*parts)

    @property
    def vertex_count(self) -> int:
        """Number of vertices."""
        return len(self.ring_start) - 1


def _edges_and_wings(faces):
    tail = faces.ravel()
    head = np.roll(faces, -1, axis=1).ravel()
    if (tail == head).any():
        raise MeshError("the muscle has a face that uses one vertex twice")
    opposite = opposite_half_edges(faces)
    if (opposite < 0).any():
        raise MeshError(
            "the muscle is not a closed, consistently oriented 2-manifold; repair it first"
        )
    along = np.flatnonzero(tail < head)
    along = along[np.lexsort((head[along], tail[along]))]
    apex = np.roll(faces, -2, axis=1).ravel()
    edges = np.column_stack([tail[along], head[along]])
    return edges, np.column_stack([apex[along], apex[opposite[along]]])


def colour(members: Integers, inverse_mass: Floats) -> tuple[Integers, Integers]:
    """Order constraints, given by their vertices (c, k), so that those of one colour share no
    vertex; without those that can move none, by the ``inverse_mass`` (n,) of the vertices.

    Greedy: each constraint takes the smallest colour that none of its vertices has yet. Constraints
    of one colour may be projected in any order, or at once, with the same result to the last bit.
    Returns the order (l,), by colour and then by the first vertex for the sake of the cache, and
    where each colour starts, (colours + 1,).
    """
    count = len(inverse_mass)
    members = np.ascontiguousarray(members, dtype=np.int64)
    if len(members) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    colours = np.empty(len(members), dtype=np.int64)
    words = 1 + members.shape[1] * int(np.bincount(members.ravel(), minlength=count).max()) // 63
    taken = np.zeros((count, words), dtype=np.int64)
    _colour_loop(members, taken, colours)
    order = np.lexsort((members.min(axis=1), colours))
    order = order[(inverse_mass[members[order]] > 0.0).any(axis=1)]
    start = np.searchsorted(colours[order], np.arange(int(colours.max()) + 2))
    return order, start


def members_in_order(members: Integers, order: Integers) -> Array:
    """Vertices (l, k) of constraints in the order of their colours, for the loops over them."""
    return np.ascontiguousarray(members[order], dtype=np.uint32)


@loop
def _colour_loop(members, taken, colours):
    """Bit q of ``taken[v]`` (63 to a word) says that colour q is used at vertex v."""
    for c in range(len(members)):
        for word in range(taken.shape[1]):
            used = np.int64(0)
            for v in members[c]:
                used |= taken[v, word]
            if used == 0x7FFFFFFFFFFFFFFF:
                continue
            bit = 0
            while used >> bit & 1:
                bit += 1
            colours[c] = 63 * word + bit
            for v in members[c]:
                taken[v, word] |= np.int64(1) << bit
            break


def cache_order(faces: Integers, count: int) -> Integers:
    """Order (count,) of vertices that puts neighbours near each other in memory (reverse Cuthill
    and McKee 1969).
    """
    ends = np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]])
    degree = np.bincount(ends.ravel(), minlength=count)
    # SciPy's own reverse_cuthill_mckee begins at a vertex that depends on the processor, by an
    # unstable sort.
    by_degree = np.argsort(degree, kind="stable")
    rows, columns = np.argsort(by_degree, kind="stable")[ends].T
    graph = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    _, part = connected_components(graph, directed=False)
    starts = np.unique(part, return_index=True)[1]
    orders = [breadth_first_order(graph, start, return_predecessors=False) for start in starts]
    return by_degree[np.concatenate(orders)[::-1]].astype(np.int64)
