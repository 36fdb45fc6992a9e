"""Distances that are measured: exact, sure of their side where a mesh is folded or open; depths in each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.exact_distance import STACK, ExactDistance, Layout, nearest_triangle, record_square
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.geometry.winding import inside_test
from rbfmuscle.jit import compiled
from rbfmuscle.metrics.columns import Columns
from rbfmuscle.validation import check_mesh, check_points

if TYPE_CHECKING:
    import trimesh

_HERE = np.eye(4)


class MeshDistance:
    """Exact distance of points to an outward mesh (vertices (n, 3) [scene unit], faces (m, 3)); negative inside.

    A point is inside where the mesh winds around it: counted exactly for closed meshes (`Columns`); for those with
    holes the winding number exceeds one half (Jacobson et al. 2013; Barill et al. 2018). The trees are built at the
    first call and kept, so that a bone's are built once, in the bone's own coordinates. ``layout`` is that of the same
    faces at another moment, as `ExactDistance` takes it.
    """

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, *, closed: bool = True, layout: Layout | None = None
    ) -> None:
        self.closed = closed
        self.vertices, self.faces = check_mesh(vertices, faces)
        self._known_layout = layout

    @cached_property
    def _exact(self) -> ExactDistance:
        return ExactDistance(self.vertices, self.faces, layout=self._known_layout)

    @cached_property
    def _inside(self) -> Callable[[Floats, Floats], Booleans]:
        if self.closed:
            return Columns(self.vertices, self.faces).inside
        wound = inside_test(self.vertices, self.faces)
        return lambda points, pose: wound(points @ pose[:3, :3].T + pose[:3, 3])

    @property
    def layout(self) -> Layout | None:
        """For the same faces at a later moment; None before the first distance."""
        return self._exact.layout if "_exact" in self.__dict__ else self._known_layout

    def inside(self, points: ArrayLike, *, pose: Floats = _HERE) -> Booleans:
        """Which points (n, 3) lie inside, (n,), once a pose (4, 4) has carried them into the mesh's coordinates."""
        return self._inside(check_points(points), pose)

    def unsigned(self, points: ArrayLike, *, near: Integers | None = None) -> Floats:
        """Distance (n,) of points (n, 3) to the surface [scene unit].

        ``near`` (n,) holds the place in the tree of a triangle near each point, -1 where none is known; afterwards that
        of the nearest one, for the next call with a mesh of the same layout.
        """
        points = check_points(points)
        out, near = np.empty(len(points)), np.full(len(points), -1) if near is None else near

        def work(first: int, last: int) -> None:
            _distance_loop(points[first:last], self._exact.tree, near[first:last], out[first:last])

        in_chunks(len(points), work)
        return out

    def signed(self, points: ArrayLike, *, near: Integers | None = None) -> Floats:
        """Distance to the surface, negative inside; as `unsigned`."""
        return np.where(self.inside(points), -1.0, 1.0) * self.unsigned(points, near=near)

    def nearest(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance (n,) on the side of the nearest face, nearest point (n, 3) and outward pseudonormal there (n, 3)."""
        distance, closest, _, normal = self._exact.nearest(points)
        return distance, closest, normal

    def depth(self, points: ArrayLike, *, pose: Floats = _HERE) -> Floats:
        """How deep points (n, 3) lie inside, (n,) [scene unit], 0 where outside; the pose is as for `inside`."""
        points = check_points(points)
        out, inside = np.zeros(len(points)), self.inside(points, pose=pose)
        if inside.any():
            out[inside] = self.unsigned(points[inside] @ pose[:3, :3].T + pose[:3, 3])
        return out


@compiled
def _distance_loop(points, tree, near, out):
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    best = np.int64(-1)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # The last answer bounds the next one where points come in order.
        best = near[i] if near[i] >= 0 else best
        square = np.inf if best < 0 else record_square(tree.records, best, x, y, z)
        best, square = nearest_triangle(tree, (x, y, z), best, square, 0.0, stack)
        near[i], out[i] = best, np.sqrt(square)


class BoneProbe(MeshDistance):
    """One bone, prepared once in its own coordinates, faces outward; it may have holes."""

    def __init__(self, name: str, mesh: trimesh.Trimesh) -> None:
        super().__init__(mesh.vertices, mesh.faces, closed=bool(mesh.is_watertight))
        self.name = name
        self.bounds = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def surface_depth(vertices: Floats, probes: list[BoneProbe], poses: dict[str, Floats]) -> Floats:
    """Greatest depth (n,) of vertices (n, 3) in the bones, of poses (4, 4) by name; 0 where in none [scene unit]."""
    out = np.zeros(len(vertices))
    for probe in bones_about(vertices, probes, poses):
        np.maximum(out, probe.depth(vertices, pose=inverse_pose(poses[probe.name])), out=out)
    return out


def inverse_pose(pose: Floats) -> Floats:
    """The pose (4, 4) that takes a rigid one back."""
    back = np.eye(4)
    back[:3, :3] = pose[:3, :3].T
    back[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return back


def bones_about(vertices: Floats, probes: list[BoneProbe], poses: dict[str, Floats]) -> list[BoneProbe]:
    """The bones whose boxes, where they are now, meet the box of the points (n, 3)."""
    if not probes or len(vertices) == 0:
        return []
    # Column by column, which takes a tenth of the time of both at once.
    low, high = (np.array([end(column) for column in vertices.T]) for end in (np.min, np.max))
    placed = np.array([poses[probe.name] for probe in probes])
    ends = np.array([probe.bounds for probe in probes])
    middle = np.einsum("bij,bj->bi", placed[:, :3, :3], ends.mean(axis=1)) + placed[:, :3, 3]
    half = np.einsum("bij,bj->bi", np.abs(placed[:, :3, :3]), 0.5 * (ends[:, 1] - ends[:, 0]))
    met = np.all((middle - half < high) & (middle + half > low), axis=1)
    return [probe for probe, near in zip(probes, met) if near]


def bone_depth(surface: MeshDistance, probes: list[BoneProbe], poses: dict[str, Floats]) -> float:
    """Greatest depth of any bone vertex in a closed, outward surface in the world, 0 where none is [scene unit]."""
    near = bones_about(surface.vertices, probes, poses)
    depths = [surface.depth(probe.vertices, pose=poses[probe.name]).max(initial=0.0) for probe in near]
    return float(max(depths, default=0.0))
