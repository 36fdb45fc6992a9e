"""A bone's distance with its facets rounded off, for what settles on it.

Bones are meshes: flat facets that meet at an angle. A surface of points that slides over one has a place to rest
between every two edges, as cogs have; a bone has not. Here the distance is a cubic B-spline whose coefficients are the
exact distances at the nodes of a lattice: smoothed over about a cell (a kernel of a standard deviation of 0.58 cells),
its gradient turns steadily. Only blocks of the lattice that are asked for are ever filled.
"""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.bsplines import bspline_sum, bspline_weights
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.jit import compiled

SIDE = 4  # cells along a block
WIDE = SIDE + 3  # nodes along it, those of the splines that reach into it too
MOST = 1 << 20  # blocks along an axis: beyond any bone
PROBES, STEPS_IN = 300, 12  # paths into a bone that tell how thick it is, and places along each
LEAST_SLOPE = 0.3  # where the distance's slope is less, inside a thin bone, the exact one answers


class RoundedField:
    """The rounded distance to one bone, in place of its `BoneSDF` where a muscle settles.

    Parameters
    ----------
    field : BoneSDF
    frame : RestFrame
        The axes and the origin of the lattice, which are then those of the muscle wherever the scene lies.
    edge : float
        Of a cell [scene unit].
    """

    def __init__(self, field: BoneField, frame: RestFrame, edge: float) -> None:
        self.field, self.frame, self.edge = field, frame, float(edge)
        self.bounds = field.bounds
        self.keys: Integers = np.zeros(0, dtype=np.int64)
        self.nodes: Floats = np.zeros((0, WIDE, WIDE, WIDE))

    def distance_and_gradient(
        self, points: Floats, pose: Floats, reach: Floats | float = np.inf
    ) -> tuple[Floats, Floats]:
        """Distance (n,) and its unit gradient (n, 3), as `BoneSDF.distance_and_gradient` gives them.

        Points beyond ``reach`` keep what that gives.
        """
        distance, gradient = self.field.distance_and_gradient(points, pose=pose, reach=reach)
        near = np.flatnonzero(distance < reach)
        if len(near) == 0:
            return distance, gradient
        axes = self.frame.axes @ pose[:3, :3].T
        origin = pose[:3, :3] @ self.frame.origin + pose[:3, 3]
        local = np.ascontiguousarray((points[near] - origin) @ axes.T) / self.edge
        value, slope = np.empty(len(near)), np.empty((len(near), 3))
        cell = np.floor(local).astype(np.int64)
        _spline_loop(local, cell, self._blocks(cell // SIDE), self.nodes, value, slope)
        steep = np.linalg.norm(slope, axis=1)
        good = steep > LEAST_SLOPE
        near, steep = near[good], steep[good]
        distance[near] = value[good] / steep * self.edge
        gradient[near] = (slope[good] / steep[:, None]) @ axes
        return distance, gradient

    def _blocks(self, block: Integers) -> Integers:
        """Rows of ``nodes`` for blocks (n, 3) of the lattice; those that are new are filled."""
        key = ((block[:, 0] + MOST) * 2 * MOST + block[:, 1] + MOST) * 2 * MOST + block[:, 2] + MOST
        wanted, first = np.unique(key, return_index=True)
        new = ~np.isin(wanted, self.keys)
        if new.any():
            grid = np.stack(np.meshgrid(*[np.arange(WIDE) - 1] * 3, indexing="ij"), -1).reshape(-1, 3)
            nodes = block[first[new]][:, None, :] * SIDE + grid
            places = self.frame.origin + nodes.reshape(-1, 3) * self.edge @ self.frame.axes
            found = self.field.distance(places) / self.edge
            keys = np.concatenate([self.keys, wanted[new]])
            order = np.argsort(keys, kind="stable")
            filled = np.concatenate([self.nodes, found.reshape(-1, WIDE, WIDE, WIDE)])
            self.keys, self.nodes = keys[order], np.ascontiguousarray(filled[order])
        return np.searchsorted(self.keys, key)


def bone_thickness(field: BoneField, vertices: Floats, faces: Integers, most: float) -> float:
    """Thickness that nine tenths of a bone's surface exceed, at most ``most`` [scene unit].

    Twice the depth that a path into the bone, from the middle of a face against its normal, reaches.

    Parameters
    ----------
    field : BoneSDF
        Or any other field of the bone.
    vertices, faces : ndarray
        Of the bone at rest.
    most : float
        [scene unit]
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    share = (np.arange(PROBES) + 0.5) / PROBES * area.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(area), share), len(faces) - 1)
    start, way = (a + b + c)[chosen] / 3.0, -normal[chosen] / np.maximum(area[chosen], 1e-300)[:, None]
    depth = np.zeros(PROBES)
    for t in np.linspace(0.0, most, STEPS_IN + 1)[1:]:
        depth = np.maximum(depth, -field.distance(start + t * way))
    return min(2.0 * float(np.quantile(depth, 0.1)), most)


@compiled(error_model="numpy")
def _spline_loop(local, cell, row, nodes, value, slope):
    """Values and slopes of the splines at places in units of a cell."""
    weight, lean = np.empty((3, 4)), np.empty((3, 4))
    first = np.empty(3, np.int64)
    for n in range(len(local)):
        for k in range(3):
            bspline_weights(local[n, k] - cell[n, k], weight[k], lean[k])
            first[k] = cell[n, k] - SIDE * (cell[n, k] // SIDE)
        value[n], slope[n, 0], slope[n, 1], slope[n, 2] = bspline_sum(nodes[row[n]], first, weight, lean)
