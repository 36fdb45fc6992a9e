"""A bone's distance with its facets rounded off, for what settles on it.

Bones are meshes: flat facets that meet at an angle. A surface of points that slides over one has a
place to rest between every two edges, as cogs have; a bone has not. Here the distance is a cubic
B-spline whose coefficients are the exact distances at the nodes of a lattice: smoothed over about a
cell (a kernel of a standard deviation of 0.58 cells), its gradient turns steadily. The lattice has
the origin and axes of the muscle, so that results do not depend on where a scene lies, and holds
only blocks near the surface.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats, Integers, unit
from rbfmuscle.geometry.frames import RestFrame, box_corners, dot, minus, row_of
from rbfmuscle.geometry.interpolation import bspline_sum
from rbfmuscle.geometry.surfaces import even_points, face_normals
from rbfmuscle.loops import loop

SIDE = 4  # cells along a block
WIDE = SIDE + 3  # nodes along it, those of the splines that reach into it too
# Edge of the cells that a bone is rounded over, relative to the spacing of the samples. With 0.7 to
# 1.0 one pose of the phantom's extensor has shapes 0.6 to 1.6 mm RMS apart, from 1.5 to 2 at most
# 0.06.
ROUNDING = 1.7
LEAST_ROUNDING = 0.1  # of that
PROBES, STEPS_IN = 300, 12  # paths into a bone that tell how thick it is, and places along each
# In place of the row of a block: farther from the bone than the reach it was rounded for, and deep
# inside it.
FAR, UNKNOWN = -1, -2
LEAST_SLOPE = 0.3  # where the distance's slope is less, inside a thin bone, the spline is flat


class RoundedBone(NamedTuple):
    """The rounded distance to one bone for one muscle."""

    edge: float  # of a cell [scene unit]
    origin: Floats  # (3,) of the lattice, in bone coordinates
    axes: Floats  # (3, 3) rows
    low: Integers  # (3,) first block along each axis
    table: Integers  # (i, j, k) int32, row of each block in ``nodes``, `FAR` or `UNKNOWN`
    nodes: Floats  # (blocks, WIDE³) distances [cells]


def round_bone(
    bone: BoneSDF,
    frame: RestFrame,
    spacing: float,
    region: Floats,
    *,
    reach: float = 0.0,
    cache: bool = True,
) -> RoundedBone:
    """Round a bone for a muscle whose contact points are ``spacing`` apart.

    All blocks within ``reach`` of the surface are filled, and those next to them, in the part of a
    ``region`` (2, 3) of bone coordinates that is near the bone. The cells are no larger than the
    bone is thick, or a thin plate would vanish.
    """
    edge = ROUNDING * spacing
    edge = max(bone_thickness(bone, edge), LEAST_ROUNDING * edge)
    place = (frame.origin.tolist(), frame.axes.tolist())
    options = ("rounded", 2, edge, reach, np.asarray(region).tolist(), *place)
    key = content_key(bone.vertices, bone.faces, options) if cache else None
    arrays = None if key is None else load_arrays(key)
    if arrays is None or arrays.keys() != {"low", "table", "nodes"}:
        arrays = _fill(bone, frame, edge, np.asarray(region, dtype=np.float64), reach)
        if key is not None:
            store_arrays(key, arrays)
    return RoundedBone(edge, frame.origin, frame.axes, **arrays)


def bone_thickness(bone: BoneSDF, most: float) -> float:
    """Thickness that nine tenths of a bone's surface exceed, at most ``most`` [scene unit].

    Twice the depth that a path into the bone, from the middle of a face against its normal,
    reaches.
    """
    probed = bone.faces[even_points(bone.vertices, bone.faces, PROBES)[1]]
    start = bone.vertices[probed].mean(axis=1)
    way = -unit(face_normals(bone.vertices, probed))
    depth = np.zeros(PROBES)
    for t in np.linspace(0.0, most, STEPS_IN + 1)[1:]:
        depth = np.maximum(depth, -bone.distance(start + t * way))
    return min(2.0 * float(np.quantile(depth, 0.1)), most)


def _fill(
    bone: BoneSDF, frame: RestFrame, edge: float, region: Floats, reach: float
) -> dict[str, np.ndarray]:
    """Blocks near the surface, and the distances at their nodes."""
    side = SIDE * edge
    # From the middle of a block: half its diagonal, and a block beyond what is asked for.
    band = reach + (0.5 * np.sqrt(3.0) + 1.0) * side
    low = np.maximum(region[0], bone.bounds[0] - band)
    high = np.minimum(region[1], bone.bounds[1] + band)
    corners = (box_corners([low, np.maximum(low, high)]) - frame.origin) @ frame.axes.T / side
    first = np.floor(corners.min(axis=0)).astype(np.int64)
    shape = np.floor(corners.max(axis=0)).astype(np.int64) + 1 - first
    blocks = np.indices(shape).reshape(3, -1).T + first
    middles = frame.origin + (blocks + 0.5) * side @ frame.axes
    middle = bone.distance(middles, reach=band)
    near = np.abs(middle) <= band
    blocks = blocks[near]
    table = np.where(middle > 0.0, FAR, UNKNOWN).astype(np.int32)
    table[near] = np.arange(len(blocks))
    # A block shares most of its nodes with its neighbours.
    inner = np.indices((WIDE, WIDE, WIDE)).reshape(3, -1).T - 1
    size = SIDE * shape + WIDE
    numbers = np.ravel_multi_index(tuple((SIDE * (blocks - first)).T), tuple(size))[:, None]
    numbers = numbers + np.ravel_multi_index(tuple(inner.T + 1), tuple(size))
    distinct, which = np.unique(numbers, return_inverse=True)
    nodes = np.stack(np.unravel_index(distinct, tuple(size)), axis=1) - 1 + SIDE * first
    distance = bone.distance(frame.origin + nodes * edge @ frame.axes) / edge
    return {
        "low": first,
        "table": table.reshape(shape),
        "nodes": np.ascontiguousarray(distance[which.reshape(numbers.shape)]),
    }


@loop
def rounded_at(rounded, x, y, z, least):
    """Rounded distance of a point in bone coordinates: the smoothed one, which changes by little
    more than the point moves; the same over its slope, which is near the distance to the smoothed
    surface; and its unit gradient.

    All are NaN where the point is beyond all blocks or deep inside the bone, and where the slope is
    not more than the ``least``; distances are infinite farther from the bone than it is rounded.
    """
    axes = rounded.axes
    table = rounded.table
    low = rounded.low
    way = minus((x, y, z), rounded.origin)
    u = dot(row_of(axes, 0), way) / rounded.edge
    v = dot(row_of(axes, 1), way) / rounded.edge
    w = dot(row_of(axes, 2), way) / rounded.edge
    i = np.int64(np.floor(u))
    j = np.int64(np.floor(v))
    k = np.int64(np.floor(w))
    a = i // SIDE - low[0]
    b = j // SIDE - low[1]
    c = k // SIDE - low[2]
    inside = 0 <= a < table.shape[0] and 0 <= b < table.shape[1] and 0 <= c < table.shape[2]
    if not inside or table[a, b, c] == UNKNOWN:
        return np.nan, np.nan, np.nan, np.nan, np.nan
    if table[a, b, c] == FAR:
        return np.inf, np.inf, np.nan, np.nan, np.nan
    start = ((i % SIDE) * WIDE + j % SIDE) * WIDE + k % SIDE
    value, sx, sy, sz = bspline_sum(
        rounded.nodes, np.int64(table[a, b, c]), start, WIDE, u - i, v - j, w - k
    )
    slope = np.sqrt(sx * sx + sy * sy + sz * sz)
    if not slope > least:
        return np.nan, np.nan, np.nan, np.nan, np.nan
    gx = (sx * axes[0, 0] + sy * axes[1, 0] + sz * axes[2, 0]) / slope
    gy = (sx * axes[0, 1] + sy * axes[1, 1] + sz * axes[2, 1]) / slope
    gz = (sx * axes[0, 2] + sy * axes[1, 2] + sz * axes[2, 2]) / slope
    value *= rounded.edge
    return value, value / max(slope, LEAST_SLOPE), gx, gy, gz
