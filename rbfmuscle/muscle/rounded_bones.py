"""A bone's distance with its facets rounded off, for what settles on it.

Bones are meshes: flat facets that meet at an angle. A surface of points that slides over one has a
place to rest between every two edges, as cogs have; a bone has not. Here the distance is a cubic
B-spline whose coefficients are the exact distances at the nodes of a lattice: smoothed over about a
cell (a kernel of a standard deviation of 0.58 cells), its gradient turns steadily. Only blocks of
the lattice that are asked for are ever filled.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import Known, query_bone
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.bsplines import bspline_sum
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.jit import compiled

SHIFT = 2  # bits of a cell within its block
SIDE = 1 << SHIFT  # cells along a block
WIDE = SIDE + 3  # nodes along it, those of the splines that reach into it too
MOST = 1 << 20  # blocks along an axis in either direction: beyond any bone
BITS = 21  # of each of a block's three numbers in its key
PROBES, STEPS_IN = 300, 12  # paths into a bone that tell how thick it is, and places along each
LEAST_SLOPE = 0.3  # where the distance's slope is less, inside a thin bone, the exact one answers
FIRST_ROOM = 256  # blocks that there is room for at first, a power of two
FULLEST = 0.6  # share of the room that may be filled
# Edge of the cells that a bone is rounded over, relative to the spacing of the samples. With 0.7 to
# 1.0 one pose of the phantom's extensor has shapes 0.6 to 1.6 mm RMS apart, from 1.5 to 2 at most
# 0.06.
ROUNDING = 1.7
LEAST_ROUNDING = 0.1  # of that


class RoundedBones(NamedTuple):
    """The rounded distances to some bones, in place of their exact fields where a muscle settles.

    Their lattices have the origin and the axes of the muscle, wherever the scene lies. Filled
    blocks stand in a table with open addressing.
    """

    edges: np.ndarray  # (b,) of the cells of each bone's lattice [scene unit]
    origin: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3) rows
    keys: np.ndarray  # (room, 2) bone and place of each block, -1 where there is none
    nodes: np.ndarray  # (room, WIDE³) distances, in cells
    filled: np.ndarray  # (1,) blocks that are filled
    known: Known  # of the muscle's contact points, changed in place


def round_bones(
    bone_sdfs: Mapping[str, BoneSDF],
    frame: RestFrame,
    spacing: float,
    meshes: Mapping[str, tuple[Floats, Integers]],
    points: int,
) -> RoundedBones:
    """The bones that a muscle with so many contact points can reach, rounded, without any block.

    A bone of ``meshes`` (vertices, faces) is rounded over cells no larger than it is thick, or a
    thin plate would vanish; ``spacing`` is that of the muscle's contact points.
    """
    edge = ROUNDING * spacing
    edges = []
    for name, field in bone_sdfs.items():
        thickness = bone_thickness(field, *meshes[name], edge) if name in meshes else edge
        edges.append(max(thickness, LEAST_ROUNDING * edge))
    count = len(edges)
    known = Known(np.zeros((count, points, 3)), np.full((count, points), -np.inf))
    lengths = np.array(edges, dtype=np.float64)
    return _with_room(lengths, frame.origin, frame.axes, FIRST_ROOM, known)


def _with_room(
    edges: Floats, origin: Floats, axes: Floats, room: int, known: Known
) -> RoundedBones:
    keys = np.full((room, 2), -1, dtype=np.int64)
    nodes, filled = np.empty((room, WIDE**3)), np.zeros(1, dtype=np.int64)
    return RoundedBones(edges, origin, axes, keys, nodes, filled, known)


def grown(rounded: RoundedBones) -> RoundedBones:
    """The same with room for twice as many blocks."""
    more = _with_room(*rounded[:3], 2 * len(rounded.keys), rounded.known)
    for old in np.flatnonzero(rounded.keys[:, 0] >= 0):
        new = find_slot(more.keys, *rounded.keys[old])
        more.keys[new], more.nodes[new] = rounded.keys[old], rounded.nodes[old]
    more.filled[:] = rounded.filled
    return more


def bone_thickness(field: BoneSDF, vertices: Floats, faces: Integers, most: float) -> float:
    """Thickness that nine tenths of a bone's surface exceed, at most ``most`` [scene unit].

    Twice the depth that a path into the bone, from the middle of a face against its normal,
    reaches.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    share = (np.arange(PROBES) + 0.5) / PROBES * area.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(area), share), len(faces) - 1)
    start, way = (
        (a + b + c)[chosen] / 3.0,
        -normal[chosen] / np.maximum(area[chosen], 1e-300)[:, None],
    )
    depth = np.zeros(PROBES)
    for t in np.linspace(0.0, most, STEPS_IN + 1)[1:]:
        depth = np.maximum(depth, -field.distance(start + t * way))
    return min(2.0 * float(np.quantile(depth, 0.1)), most)


@compiled
def find_slot(keys, b, key):
    """Where a block of bone b stands in the table, or would stand; its room is a power of two."""
    last = len(keys) - 1
    # Neighbouring blocks should lie apart: multiply by an odd number and take high bits (Knuth).
    slot = ((key * np.int64(0x9E3779B97F4A7C1) >> 20) + b) & last
    while keys[slot, 0] >= 0 and (keys[slot, 0] != b or keys[slot, 1] != key):
        slot = (slot + 1) & last
    return slot


@compiled
def _fill_block(rounded, bones, b, key, slot):
    """Find the distances at the nodes of a block of bone b."""
    edge = rounded.edges[b]
    place = np.empty(3)
    first = np.empty(3)
    for a in range(3):
        block = (key >> (BITS * (2 - a)) & (2 * MOST - 1)) - MOST
        first[a] = block * SIDE - 1
    points, n = np.empty((WIDE**3, 3)), 0
    for i in range(WIDE):
        for j in range(WIDE):
            for k in range(WIDE):
                place[0] = (first[0] + i) * edge
                place[1] = (first[1] + j) * edge
                place[2] = (first[2] + k) * edge
                for a in range(3):
                    points[n, a] = rounded.origin[a]
                    for m in range(3):
                        points[n, a] += place[m] * rounded.axes[m, a]
                n += 1
    distance = np.empty(n)
    query_bone(bones, b, np.eye(4), points, np.full(n, np.inf), distance, np.empty((0, 3)))
    for n in range(len(distance)):
        rounded.nodes[slot, n] = distance[n] / edge
    rounded.keys[slot, 0] = b
    rounded.keys[slot, 1] = key
    rounded.filled[0] += 1


class Scratch(NamedTuple):
    """Room for one question."""

    local: np.ndarray  # (3,) the point in bone coordinates
    gradient: np.ndarray  # (3,) of the distance there
    place: np.ndarray  # (3,) in a cell of the lattice
    # (1,) smoothed distance [scene unit], which moves by no more than the point does
    smooth: np.ndarray
    normal: np.ndarray  # (3,) of the answer, in the world


@compiled
def no_scratch():
    """Room for questions."""
    return Scratch(np.empty(3), np.empty(3), np.empty(3), np.empty(1), np.empty(3))


@compiled
def rounded_distance(rounded, bones, b, scratch):
    """Distance of the point ``scratch.local`` to bone b, rounded: the smoothed one over its slope;
    fills its unit gradient.

    Infinite where there is no room for the block; NaN where the spline is flat.
    """
    local = scratch.local
    gradient = scratch.gradient
    place = scratch.place
    edge, axes = rounded.edges[b], rounded.axes
    key, start = np.int64(0), np.int64(0)
    for a in range(3):
        at = 0.0
        for k in range(3):
            at += (local[k] - rounded.origin[k]) * axes[a, k]
        at /= edge
        cell = np.int64(np.floor(at))
        place[a] = at - cell
        block = cell >> SHIFT
        start = start * WIDE + cell - SIDE * block
        key += (block + MOST) << (BITS * (2 - a))
    slot = find_slot(rounded.keys, b, key)
    if rounded.keys[slot, 0] < 0:
        if rounded.filled[0] >= FULLEST * len(rounded.keys):
            return np.inf
        _fill_block(rounded, bones, b, key, slot)
    value, x, y, z = bspline_sum(rounded.nodes, slot, start, WIDE, place[0], place[1], place[2])
    steep = np.sqrt(x * x + y * y + z * z)
    if not steep > LEAST_SLOPE:
        return np.nan
    for a in range(3):
        gradient[a] = (x * axes[0, a] + y * axes[1, a] + z * axes[2, a]) / steep
    scratch.smooth[0] = value * edge
    return value / steep * edge
