"""A bone's distance with its facets rounded off, for what settles on it.

Bones are meshes: flat facets that meet at an angle. A surface of points that slides over one has a place to rest
between every two edges, as cogs have; a bone has not. Here the distance is a cubic B-spline whose coefficients are the
exact distances at the nodes of a lattice: smoothed over about a cell (a kernel of a standard deviation of 0.58 cells),
its gradient turns steadily. Only blocks of the lattice that are asked for are ever filled.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.bsplines import bspline_sum, bspline_weights
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.jit import compiled

SIDE = 4  # cells along a block
WIDE = SIDE + 3  # nodes along it, those of the splines that reach into it too
MOST = 1 << 20  # blocks along an axis in either direction: beyond any bone
SHIFTS = np.array([42, 21, 0])  # bits of a block's three numbers in its key
PROBES, STEPS_IN = 300, 12  # paths into a bone that tell how thick it is, and places along each
LEAST_SLOPE = 0.3  # where the distance's slope is less, inside a thin bone, the exact one answers


class RoundedField:
    """The rounded distance to one bone, in place of its `BoneSDF` where a muscle settles.

    ``frame`` gives the axes and the origin of the lattice, which are then those of the muscle wherever the scene
    lies; ``edge`` is that of a cell [scene unit].
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

        ``reach`` matters where the exact field answers, which is where the rounded distance is flat.
        """
        axes = np.ascontiguousarray(self.frame.axes @ pose[:3, :3].T)
        origin = pose[:3, :3] @ self.frame.origin + pose[:3, 3]
        row, distance = np.empty(len(points), np.int64), np.empty(len(points))
        gradient = np.empty((len(points), 3))
        if _rows_loop(points, axes, origin, self.edge, self.keys, row):
            self._fill(np.unique(-1 - row[row < 0]))
            _rows_loop(points, axes, origin, self.edge, self.keys, row)
        if _spline_loop(points, axes, origin, self.edge, row, self.nodes, distance, gradient):
            flat = np.flatnonzero(np.isnan(distance))
            limit = reach if np.ndim(reach) == 0 else np.asarray(reach)[flat]
            distance[flat], gradient[flat] = self.field.distance_and_gradient(
                points[flat], pose=pose, reach=limit
            )
        return distance, gradient

    def _fill(self, new: Integers) -> None:
        """Find the distances of blocks of the lattice, by their keys (n,)."""
        block = (new[:, None] >> SHIFTS & 2 * MOST - 1) - MOST
        grid = np.stack(np.meshgrid(*[np.arange(WIDE) - 1] * 3, indexing="ij"), -1).reshape(-1, 3)
        nodes = block[:, None, :] * SIDE + grid
        places = self.frame.origin + nodes.reshape(-1, 3) * self.edge @ self.frame.axes
        found = self.field.distance(places) / self.edge
        keys = np.concatenate([self.keys, new])
        order = np.argsort(keys, kind="stable")
        filled = np.concatenate([self.nodes, found.reshape(-1, WIDE, WIDE, WIDE)])
        self.keys, self.nodes = keys[order], np.ascontiguousarray(filled[order])


def bone_thickness(field: BoneField, vertices: Floats, faces: Integers, most: float) -> float:
    """Thickness that nine tenths of a bone's surface exceed, at most ``most`` [scene unit].

    Twice the depth that a path into the bone, from the middle of a face against its normal, reaches.
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


@compiled(error_model="numpy", inline="always")
def _place(point, axis, origin, edge):
    """Place of a point along an axis of the lattice, in cells."""
    place = 0.0
    for b in range(3):
        place += (point[b] - origin[b]) * axis[b]
    return place / edge


@compiled(error_model="numpy")
def _rows_loop(points, axes, origin, edge, keys, row):
    """Row of the block that holds each point, -1 less its key where that is lacking; returns whether one is."""
    lacking = False
    for n in range(len(points)):
        key = 0
        for a in range(3):
            block = np.int64(np.floor(_place(points[n], axes[a], origin, edge) / SIDE))
            key += (block + MOST) << SHIFTS[a]
        k = np.searchsorted(keys, key)
        row[n] = k
        if k == len(keys) or keys[k] != key:
            row[n], lacking = -1 - key, True
    return lacking


@compiled(error_model="numpy")
def _spline_loop(points, axes, origin, edge, row, nodes, distance, gradient):
    """Distances and gradients by the splines; NaN where these are flat, and returns whether they are anywhere."""
    weight, lean = np.empty((3, 4)), np.empty((3, 4))
    first, flat = np.empty(3, np.int64), False
    for n in range(len(points)):
        for k in range(3):
            place = _place(points[n], axes[k], origin, edge)
            cell = np.int64(np.floor(place))
            bspline_weights(place - cell, weight[k], lean[k])
            first[k] = cell - SIDE * np.int64(np.floor(place / SIDE))
        value, x, y, z = bspline_sum(nodes[row[n]], first, weight, lean)
        steep = np.sqrt(x * x + y * y + z * z)
        if steep > LEAST_SLOPE:
            distance[n] = value / steep * edge
            for b in range(3):
                gradient[n, b] = (x * axes[0, b] + y * axes[1, b] + z * axes[2, b]) / steep
        else:
            distance[n], flat = np.nan, True
    return flat
