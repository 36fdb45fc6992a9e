"""The two ends of a muscle, along its surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

if TYPE_CHECKING:
    import trimesh


class Ends:
    """The two ends of a closed surface: the points farthest apart along it."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        count = len(mesh.vertices)
        graph = coo_matrix(
            (mesh.edges_unique_length, mesh.edges_unique.T), shape=(count, count)
        ).tocsr()

        def away_from(vertex):
            distance = dijkstra(graph, directed=False, indices=vertex)
            return distance, int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))

        first = away_from(0)[1]
        away, second = away_from(first)
        self.tips, self.away = (first, second), (away, away_from(second)[0])
        self.length = float(away[second])

    def along(self, end: int) -> np.ndarray:
        """Place of each vertex between an end (0) and the other one (1)."""
        return self.away[end] / np.maximum(self.away[0] + self.away[1], 1e-300)
