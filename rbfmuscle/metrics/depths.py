"""Depths of muscles in bones and of bones in muscles, as they are measured."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.scene.bone import BoneDistance


def surface_depth(vertices: Floats, probes: list[BoneDistance], poses: dict[str, Floats]) -> Floats:
    """Greatest depth (n,) of vertices (n, 3) in the bones, of poses (4, 4) by name; 0 where in none
    [scene unit].
    """
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


def bones_about(
    vertices: Floats, probes: list[BoneDistance], poses: dict[str, Floats]
) -> list[BoneDistance]:
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


def bone_depth(
    surface: MeshDistance, probes: list[BoneDistance], poses: dict[str, Floats]
) -> float:
    """Greatest depth of any bone vertex in a closed, outward surface in the world, 0 where none is
    [scene unit].
    """
    near = bones_about(surface.vertices, probes, poses)
    depths = [
        surface.depth(probe.vertices, pose=poses[probe.name]).max(initial=0.0) for probe in near
    ]
    return float(max(depths, default=0.0))
