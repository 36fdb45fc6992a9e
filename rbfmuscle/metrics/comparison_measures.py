"""The strain of material points, which means the same for every model, whatever its mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import barycentric_weights, edge_lengths, unique_edges
from rbfmuscle.implicit.placement.sampling import sample_surface

if TYPE_CHECKING:
    import trimesh

POINTS = 1200  # material points of a muscle


class MaterialProbe:
    """The same points of a muscle's material in every model.

    Points are spread evenly over the input mesh and bound to the model's carried mesh at rest: to the
    nearest triangle, by its barycentric coordinates. Edges between neighbouring points are the same for all
    models, so their strain compares, which the strain of each model's own mesh does not.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The muscle at rest [scene unit].
    vertices, faces : (n, 3) and (m, 3) ndarray
        The model's carried mesh at rest.
    count : int
    """

    def __init__(
        self, mesh: trimesh.Trimesh, vertices: Floats, faces: Integers, *, count: int = POINTS
    ) -> None:
        sample = sample_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), count, placement="even")
        faces = np.asarray(faces, dtype=np.int64)
        _, closest, nearest, _ = ExactDistance(vertices, faces).nearest(sample.points)
        self.corners = faces[nearest]
        self.shares = barycentric_weights(closest, vertices[self.corners])
        self.edges = unique_edges(sample.control_faces)
        self.rest = edge_lengths(sample.points, self.edges)

    def points(self, vertices: Floats) -> Floats:
        """Places (count, 3) of the material points for the carried mesh's vertices now."""
        return np.einsum("pk,pkd->pd", self.shares, vertices[self.corners])

    def strain(self, points: Floats, start: Floats | None = None) -> float:
        """Root mean square of the relative change of the edges' lengths.

        Parameters
        ----------
        points : (count, 3) ndarray
        start : (count, 3) ndarray, optional
            Places that count as unstrained; the input mesh's where not given.
        """
        rest = self.rest if start is None else edge_lengths(start, self.edges)
        used = rest > 0
        change = edge_lengths(points, self.edges)[used] / rest[used] - 1.0
        return float(np.sqrt(np.mean(change**2)))
