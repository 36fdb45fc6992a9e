"""How deep a muscle's surface and the bones are in each other, by exact distance to both meshes."""

from __future__ import annotations

from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.metrics.occupancy import OccupancyGrid

if TYPE_CHECKING:
    import trimesh


class BoneProbe:
    """One bone, prepared once in its own coordinates.

    Parameters
    ----------
    name : str
    mesh : trimesh.Trimesh
        Faces outward. Holes are allowed; the sign then comes from winding numbers.
    """

    def __init__(self, name: str, mesh: trimesh.Trimesh) -> None:
        self.name = name
        self.vertices = np.ascontiguousarray(mesh.vertices, dtype=float)
        self.faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
        self.bounds = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        self.closed = bool(mesh.is_watertight)
        self._distance: MeshDistance | None = None
        self._grid: OccupancyGrid | None = None
        self._making = Lock()

    def depth(self, points: Floats) -> Floats:
        """How deep points lie inside the bone.

        Parameters
        ----------
        points : (n, 3) ndarray
            Bone coordinates [scene unit].

        Returns
        -------
        (n,) ndarray
            Distance to the bone's surface where inside, else 0.
        """
        out = np.zeros(len(points))
        near = np.flatnonzero(np.all((points > self.bounds[0]) & (points < self.bounds[1]), axis=1))
        if len(near) == 0:
            return out
        distance, grid = self._prepared()
        if grid is not None:
            near = near[grid.candidates(points[near])]
        out[near] = distance.depth(points[near])
        return out

    def _prepared(self) -> tuple[MeshDistance, OccupancyGrid | None]:
        """What answers, made when a point first comes near, by whichever thread brings it."""
        with self._making:
            if self._distance is None:
                self._grid = OccupancyGrid(self.vertices, self.faces) if self.closed else None
                self._distance = MeshDistance(self.vertices, self.faces, closed=self.closed)
            return self._distance, self._grid


def bone_coordinates(points: Floats, pose: Floats) -> Floats:
    """World points in the rest coordinates of a bone with this (4, 4) pose."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


def surface_depth(vertices: Floats, probes: list[BoneProbe], poses: dict[str, Floats]) -> Floats:
    """Depth of surface vertices inside the bones.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        World coordinates [scene unit].
    probes : list of BoneProbe
    poses : dict of str to (4, 4) ndarray

    Returns
    -------
    (n,) ndarray
        The greatest depth over all bones; 0 where a vertex is in none.
    """
    out = np.zeros(len(vertices))
    if len(vertices) == 0:
        return out
    for probe in bones_about(vertices.min(axis=0), vertices.max(axis=0), probes, poses):
        np.maximum(out, probe.depth(bone_coordinates(vertices, poses[probe.name])), out=out)
    return out


def bones_about(
    low: Floats, high: Floats, probes: list[BoneProbe], poses: dict[str, Floats]
) -> list[BoneProbe]:
    """The bones whose boxes, where they are now, meet the box from ``low`` to ``high`` (3,)."""
    if not probes:
        return []
    placed = np.array([poses[probe.name] for probe in probes])
    ends = np.array([probe.bounds for probe in probes])
    middle = np.einsum("bij,bj->bi", placed[:, :3, :3], ends.mean(axis=1)) + placed[:, :3, 3]
    half = np.einsum("bij,bj->bi", np.abs(placed[:, :3, :3]), 0.5 * (ends[:, 1] - ends[:, 0]))
    met = np.all((middle - half < high) & (middle + half > low), axis=1)
    return [probe for probe, near in zip(probes, met) if near]


def bone_depth(
    vertices: Floats,
    faces: Integers,
    probes: list[BoneProbe],
    poses: dict[str, Floats],
    *,
    distance: MeshDistance | None = None,
) -> float:
    """Greatest depth of any bone vertex inside a muscle's closed surface.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        Closed, outward surface in world coordinates.
    probes : list of BoneProbe
    poses : dict of str to (4, 4) ndarray
    distance : MeshDistance, optional
        Of the surface, where it is at hand.

    Returns
    -------
    float
        [scene unit]; 0 where no bone vertex is inside.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    near = []
    for probe in bones_about(low, high, probes, poses):
        pose = poses[probe.name]
        local = bone_coordinates(vertices, pose)
        within = _rows_within_box_of(local, probe.vertices)
        near.append(probe.vertices[within] @ pose[:3, :3].T + pose[:3, 3])
    points = np.concatenate(near) if near else np.zeros((0, 3))
    if len(points) == 0:
        return 0.0
    points = points[OccupancyGrid(vertices, faces).candidates(points)]
    distance = MeshDistance(vertices, faces) if distance is None else distance
    return float(distance.depth(points).max(initial=0.0))


def _rows_within_box_of(points: Floats, others: Floats) -> Integers:
    """Rows of the others inside the box of points; axis by axis, as a bone has many and few are near one muscle."""
    rows = np.arange(len(others))
    for axis in range(3):
        ends, values = points[:, axis], others[rows, axis]
        rows = rows[(values > ends.min()) & (values < ends.max())]
    return rows
