"""Other ways to detect that a point is in a bone, behind the interface of `BoneSDF`, to be compared
with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rbfmuscle.bones.sdf import prepare_bone
from rbfmuscle.geometry.arrays import Booleans, Floats, MeshLike
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.mesh_distance import inside_test
from rbfmuscle.validation import check_mesh, check_points

# Share of the longest side that a baseline's grid reaches beyond the mesh.
MARGIN = 0.1


class PointDetector:
    """Distance and gradient in any pose, from ``_local(points)`` in bone coordinates."""

    closed = True

    def _local(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) and gradients (n, 3) in bone coordinates."""
        raise NotImplementedError

    def distance_and_gradient(
        self, points: Floats, pose: Floats | None = None, reach: Floats | float = np.inf
    ) -> tuple[Floats, Floats]:
        """Signed distance (n,) and gradient (n, 3), in the axes of ``points``; ``reach`` is not
        made use of.
        """
        points = check_points(points)
        if pose is None:
            return self._local(points)
        pose = np.asarray(pose, dtype=np.float64)
        distance, gradient = self._local((points - pose[:3, 3]) @ pose[:3, :3])
        return distance, gradient @ pose[:3, :3].T

    def distance(
        self, points: Floats, pose: Floats | None = None, *, reach: Floats | float = np.inf
    ) -> Floats:
        """Signed distance (n,) [unit of the mesh], negative inside."""
        return self.distance_and_gradient(points, pose)[0]

    def gradient(self, points: Floats, pose: Floats | None = None) -> Floats:
        """Gradient of the distance, (n, 3)."""
        return self.distance_and_gradient(points, pose)[1]

    def direction(self, points: Floats, pose: Floats | None = None) -> Floats:
        """Unit direction (n, 3) in which the distance grows."""
        gradient = self.gradient(points, pose)
        return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)

    def closest_point(self, points: Floats, pose: Floats | None = None) -> Floats:
        """Surface point (n, 3) that distance and direction point to."""
        distance, gradient = self.distance_and_gradient(points, pose)
        square = np.maximum((gradient * gradient).sum(axis=1), 0.25)
        return check_points(points) - (distance / square)[:, None] * gradient


class TreeDetector(PointDetector):
    """Every query asks the bounding volume tree for the nearest triangle: exact, and the
    slowest."""

    def __init__(self, exact: ExactDistance) -> None:
        self.exact = exact
        self.bounds = np.array([exact.vertices.min(axis=0), exact.vertices.max(axis=0)])

    @classmethod
    def from_mesh(cls, mesh: MeshLike) -> TreeDetector:
        """Tree of a closed mesh (trimesh.Trimesh or a pair of vertices and faces)."""
        pair = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
        return cls(ExactDistance(*check_mesh(*pair)))

    @property
    def memory(self) -> int:
        """Bytes of the tree and its triangles."""
        arrays = (self.exact.tree.boxes, self.exact.tree.records, *self.exact.pseudonormals)
        return sum(array.nbytes for array in arrays)

    def _local(self, points):
        distance, closest, _, normal = self.exact.nearest(points)
        offset = points - closest
        on_surface = np.abs(distance) <= 1e-12 * np.ptp(self.bounds, axis=0).max()
        offset[on_surface] = normal[on_surface]
        scale = np.where(on_surface, np.linalg.norm(offset, axis=1), distance)
        return distance, offset / scale[:, None]


class VoxelDetector(PointDetector):
    """Voxels inside or outside, as in the paper's first code; depths are counted in voxels.

    Distances are exact to the nearest voxel's centre on the other side, so they err by up to a
    voxel's diagonal.
    """

    def __init__(self, inside: Booleans, origin: Floats, edge: Floats | float) -> None:
        from scipy.ndimage import distance_transform_edt

        self.inside = inside
        self.origin = origin
        self.edge = edge
        self.bounds = np.array([origin, origin + edge * np.array(inside.shape)])
        outward = distance_transform_edt(~inside, sampling=edge)
        inward = distance_transform_edt(inside, sampling=edge)
        half = 0.5 * float(np.min(edge))
        self.values = np.where(inside, half - inward, outward - half).astype(np.float32)

    @classmethod
    def from_mesh(cls, mesh: MeshLike, *, resolution: int = 64) -> VoxelDetector:
        """Voxels along each axis of the mesh's box, widened by a tenth of its longest side."""
        exact, low, high = grid_of(mesh)
        edge = (high - low) / resolution
        axes = [low[k] + edge[k] * (np.arange(resolution) + 0.5) for k in range(3)]
        return cls(sample_nodes(exact.signed_distance, axes) < 0.0, low, edge)

    @property
    def memory(self) -> int:
        """Bytes of the voxels."""
        return self.inside.nbytes + self.values.nbytes

    def _local(self, points):
        top = np.array(self.inside.shape) - 1
        cell = np.clip(np.floor((points - self.origin) / self.edge).astype(np.int64), 0, top)
        gradient = np.empty(points.shape)
        for axis in range(3):
            before, after = cell.copy(), cell.copy()
            before[:, axis] = np.maximum(cell[:, axis] - 1, 0)
            after[:, axis] = np.minimum(cell[:, axis] + 1, top[axis])
            run = (after - before)[:, axis] * self.edge[axis]
            gradient[:, axis] = (self.values[tuple(after.T)] - self.values[tuple(before.T)]) / run
        beyond = np.maximum(np.maximum(self.bounds[0] - points, points - self.bounds[1]), 0.0)
        distance = self.values[tuple(cell.T)] + np.linalg.norm(beyond, axis=1)
        return distance.astype(np.float64), gradient


def grid_of(mesh: MeshLike) -> tuple[Any, Floats, Floats]:
    """Exact distance of a mesh, and the box (low, high) of a baseline's grid around it."""
    vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
    vertices = np.asarray(vertices, dtype=float)
    faces, closed, _ = prepare_bone(vertices, np.asarray(faces))
    exact = ExactDistance(vertices, faces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    margin = MARGIN * (high - low).max()
    if closed:
        return exact, low - margin, high + margin
    return _WoundDistance(exact, inside_test(vertices, faces)), low - margin, high + margin


class _WoundDistance:
    """Distance of an open mesh with the sign of its winding number."""

    def __init__(self, exact: ExactDistance, inside: Callable[[Floats], Booleans]) -> None:
        self.exact, self.inside = exact, inside

    def signed_distance(self, points: Floats) -> Floats:
        distance = np.abs(self.exact.signed_distance(points))
        return np.where(self.inside(points), -distance, distance)


def sample_nodes(function: Callable[[Floats], Floats], axes: Sequence[Floats]) -> Floats:
    """Values of a function at the nodes of a grid given by its three axes."""
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return function(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
