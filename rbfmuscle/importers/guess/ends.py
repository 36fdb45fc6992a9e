"""The two ends of a muscle, along its surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

if TYPE_CHECKING:
    import trimesh


def edge_graph(mesh: trimesh.Trimesh) -> csr_matrix:
    """The edges of a mesh and their lengths."""
    count = len(mesh.vertices)
    return coo_matrix((mesh.edges_unique_length, mesh.edges_unique.T), shape=(count, count)).tocsr()


def geodesic(graph: csr_matrix, vertices: ArrayLike) -> np.ndarray:
    """Distance along edges (n,) to the nearest of some vertices, infinite where there is no way."""
    return dijkstra(graph, directed=False, indices=np.atleast_1d(vertices), min_only=True)


class Ends:
    """The two ends of a closed surface: the points farthest apart along it."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        graph = edge_graph(mesh)

        def away_from(vertex):
            distance = geodesic(graph, vertex)
            return distance, int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))

        first = away_from(0)[1]
        away, second = away_from(first)
        self.tips, self.away = (first, second), (away, away_from(second)[0])
        self.length = float(away[second])

    def along(self, end: int) -> np.ndarray:
        """Place of each vertex between an end (0) and the other one (1)."""
        return self.away[end] / np.maximum(self.away[0] + self.away[1], 1e-300)
