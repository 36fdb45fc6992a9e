"""The distance fields of several bones as flat arrays, for compiled loops that ask any of them.

A `BoneSDF` answers from Python. Here the arrays of all bones stand one behind the other, so that
one NamedTuple of one type holds any number of bones, and a loop takes the part of a bone as views.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.broad_phase import (
    direction_loop,
    may_reach,
    note_query,
)
from rbfmuscle.bones.query import FieldData, query_loop
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.jit import compiled


class Bones(NamedTuple):
    """Constant arrays of b bones: those of `FieldData`, one bone behind the other, and frames.

    ``span`` (b, 2, 10) says where the part of a bone begins and ends in ``blocks``, ``cells``,
    ``lists``, ``corners``, ``far``, ``records``, ``edge_normals``, ``vertex_normals``, ``vertices``
    and ``across``; ``shape`` (b, 3) is that of its blocks.
    """

    boxes: np.ndarray  # (b, 2, 3) in bone coordinates
    frames: np.ndarray  # (b, 4, 4) from local units to bone coordinates
    sizes: np.ndarray  # (b,) length of a local unit [scene unit]
    grid: np.ndarray
    shape: np.ndarray
    span: np.ndarray
    blocks: np.ndarray
    cells: np.ndarray
    lists: np.ndarray
    corners: np.ndarray
    far: np.ndarray
    records: np.ndarray
    edge_normals: np.ndarray
    vertex_normals: np.ndarray
    vertices: np.ndarray
    across: np.ndarray


class PlaneStack(NamedTuple):
    """Planes of several kinds, one below the other."""

    point: np.ndarray  # (p,) contact point
    gap: np.ndarray  # (p,) distance of the anchor [scene unit]
    normal: np.ndarray  # (p, 3)
    anchor: np.ndarray  # (p, 3)
    kind: np.ndarray  # (p,)
    softness: np.ndarray  # (kinds,)


class Known(NamedTuple):
    """Where points were when they were last asked about bones, and what bounds the distances
    there.
    """

    anchor: np.ndarray  # (b, n, 3) in bone coordinates
    bound: np.ndarray  # (b, n), -infinity where nothing is known


class Obstacles(NamedTuple):
    """What a muscle's contact points meet, for compiled loops."""

    bones: Bones  # the b bones in reach
    poses: np.ndarray  # (b, 4, 4)
    free: np.ndarray  # (n,) whether no bone holds a contact point
    allowed: np.ndarray  # (b, n) how deep a contact point may be in a bone [scene unit]
    known: Known  # changed in place
    planes: PlaneStack


# The arrays of no bone.
NOTHING = [
    np.zeros(0, np.int32),
    np.zeros((0, 64), np.int32),
    np.zeros(0, np.int32),
    np.zeros((0, 12), np.float32),
    np.zeros(0, np.int32),
    np.zeros((0, 16), np.float32),
    np.zeros((0, 3, 3), np.float32),
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.int32),
    np.zeros((0, 3), np.int32),
]


def stack_bones(fields: Sequence[BoneSDF]) -> Bones:
    """The fields of some bones, which may be none, as one set of arrays."""
    data = [field.cells.data for field in fields]
    parts = [NOTHING, *([one.blocks.ravel(), *one[2:]] for one in data)]
    sizes = np.array([[len(part) for part in row] for row in parts], dtype=np.int64)
    ends = np.cumsum(sizes, axis=0)
    return Bones(
        np.array([field.bounds for field in fields]).reshape(-1, 2, 3),
        np.array([field.cells.local_to_bone for field in fields]).reshape(-1, 4, 4),
        np.array([field.cells.unit for field in fields]),
        np.array([one.grid for one in data]).reshape(-1, 5),
        np.array([one.blocks.shape for one in data], dtype=np.int64).reshape(-1, 3),
        np.stack([ends[:-1], ends[1:]], axis=1),
        *(np.ascontiguousarray(np.concatenate(column)) for column in zip(*parts)),
    )


@compiled
def field_of(bones, b):
    """The field of bone b: views into the arrays of all."""
    first = bones.span[b, 0]
    end = bones.span[b, 1]
    shape = bones.shape[b]
    return FieldData(
        bones.grid[b],
        bones.blocks[first[0] : end[0]].reshape((shape[0], shape[1], shape[2])),
        bones.cells[first[1] : end[1]],
        bones.lists[first[2] : end[2]],
        bones.corners[first[3] : end[3]],
        bones.far[first[4] : end[4]],
        bones.records[first[5] : end[5]],
        bones.edge_normals[first[6] : end[6]],
        bones.vertex_normals[first[7] : end[7]],
        bones.vertices[first[8] : end[8]],
        bones.across[first[9] : end[9]],
    )


@compiled
def query_bone(bones, b, pose, points, reach, distance, gradient):
    """Signed distances (n,) to bone b in a pose (4, 4) of points (n, 3) in the world.

    Negative inside. Gradients (n, 3) are unit vectors in world axes, away from the middle of the
    bone where the field has none; ``gradient`` may be (0, 3). Where the bone is farther than
    ``reach`` (n,) only a lower bound beyond it is given, and the gradient there means nothing.
    """
    placed = np.zeros((4, 4))
    frame = bones.frames[b]
    for a in range(3):
        placed[a, 3] = pose[a, 3]
        for k in range(3):
            placed[a, 3] += pose[a, k] * frame[k, 3]
            # The query takes the transpose for the inverse: columns are over a unit squared.
            for m in range(3):
                placed[a, k] += pose[a, m] * frame[m, k] / bones.sizes[b] ** 2
    query_loop(points, placed, reach, bones.sizes[b], distance, gradient, field_of(bones, b))
    if len(gradient) > 0:
        direction_loop(points, gradient, pose, bones.boxes[b])


@compiled
def ask_near(bones, b, pose, free, known, points, reach, wanted):
    """Numbers (m,) of the free points (n, 3) that may be nearer to bone b in a pose than their
    ``reach`` (n,), by what is ``known`` of it; their distances (m,), which are noted there, and
    where they are wanted directions (m, 3), else (0, 3).
    """
    bounds = bones.boxes[b]
    anchor, bound = known.anchor[b], known.bound[b]
    some = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        some[count] = i
        count += free[i] & may_reach(points, i, pose, bounds, anchor, bound, reach[i])
    near = some[:count]
    distance, way = np.empty(count), np.empty((count if wanted else 0, 3))
    query_bone(bones, b, pose, points[near], reach[near], distance, way)
    for k in range(count):
        note_query(points, near[k], pose, distance[k], anchor, bound)
    return near, distance, way
