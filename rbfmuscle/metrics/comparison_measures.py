"""Measures that mean the same for every model, whatever its mesh: material points, curvature."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import barycentric_weights, edge_lengths, face_normals, unique_edges
from rbfmuscle.implicit.placement.sampling import sample_surface, spread_points

if TYPE_CHECKING:
    import trimesh


POINTS = 1200  # material points of a muscle
PATCHES = 5000  # points at which curvature is taken
NEIGHBOURS = 24
FEWEST = 8  # of the neighbours, on the same sheet


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


def curvature_variation(vertices: Floats, faces: Integers, *, patches: int = PATCHES, seed: int = 0) -> float:
    """How unevenly a surface is curved.

    Points are spread over the surface at random, in proportion to its area. At each a quadric is fitted to its
    nearest neighbours on the same sheet, which gives the mean curvature H there. The variation is the standard
    deviation of H among neighbours, root mean square over all points: zero on a sphere, a plane and a
    cylinder. Since all surfaces get the same number of points, the scale is the same for models of one
    muscle, whatever their meshes.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        Closed, outward surface.
    patches : int
        Number of points.
    seed : int

    Returns
    -------
    float
        [1 / scene unit]
    """
    # In strips of equal area, so that no region goes without points.
    points, face = spread_points(vertices, faces, patches, seed=seed)
    normals = face_normals(vertices, np.asarray(faces))[face]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    near = cKDTree(points).query(points, k=NEIGHBOURS)[1]
    same_sheet = np.einsum("pkd,pd->pk", normals[near], normals) > 0.3
    # On the rim of a thin plate a point can have too few neighbours on its own sheet for a quadric.
    enough = same_sheet.sum(axis=1) >= FEWEST
    same_sheet &= enough[near]
    curvature = np.zeros(len(points))
    curvature[enough] = _mean_curvature(points, normals, near[enough], same_sheet[enough])
    near, same_sheet = near[enough], same_sheet[enough]
    weight = same_sheet / same_sheet.sum(axis=1, keepdims=True)
    mean = (weight * curvature[near]).sum(axis=1)
    variance = (weight * (curvature[near] - mean[:, None]) ** 2).sum(axis=1)
    return float(np.sqrt(variance.mean()))


def _mean_curvature(points, normals, near, same_sheet):
    """Mean curvature at each point from the quadric z = h + gu u + gv v + a u^2 + b u v + c v^2."""
    weight = same_sheet[:, :, None].astype(float)
    normal = (weight * normals[near]).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    helper = np.where(np.abs(normal[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u_axis = np.cross(normal, helper)
    u_axis /= np.linalg.norm(u_axis, axis=1, keepdims=True)
    axes = np.stack([u_axis, np.cross(normal, u_axis), normal], axis=2)
    local = np.einsum("pkd,pde->pke", points[near] - points[near[:, :1]], axes)
    scale = np.sqrt((weight[..., 0] * (local[..., :2] ** 2).sum(axis=2)).mean(axis=1))[:, None]
    u, v, z = np.moveaxis(local, 2, 0) / scale
    columns = weight * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    matrix = np.einsum("pki,pkj->pij", columns, columns) + 1e-9 * NEIGHBOURS * np.eye(6)
    right = np.einsum("pki,pk->pi", columns, z)
    _, gu, gv, a, b, c = np.linalg.solve(matrix, right[:, :, None])[..., 0].T
    top = (1 + gv**2) * 2 * a - 2 * gu * gv * b + (1 + gu**2) * 2 * c
    return top / (2 * (1 + gu**2 + gv**2) ** 1.5) / scale[:, 0]
