"""Exact signed distance to one bone, for compiled loops: a tree of triangles asked about many
points.

The nearest triangle is found in a tree of boxes. The sign of a closed mesh comes from
angle-weighted pseudonormals (Baerentzen & Aanaes 2005); that of an open mesh, or of one that
intersects itself, from its winding number, summed over the same tree (Barill et al. 2018, "Fast
winding numbers for soups and clouds").
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import (
    BX,
    CX,
    CY,
    FACE,
    STACK,
    ExactDistance,
    box_square,
    feature_normal,
    nearest_triangle,
    offset_in_frame,
    record_square,
)
from rbfmuscle.geometry.frames import dot, local_point, minus, row_of, turned
from rbfmuscle.geometry.mesh_distance import half_solid_angle
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.loops import loop

# Relative difference of squared distances below which triangles count as equally near: rounding in
# large triangles, beside which the point is near. The one of the least number is taken, whatever
# was known before.
TIE = 1e-10
# Nearer to the surface than this share of the bone's box, the direction from the nearest point is
# rounding.
ON_SURFACE = 1e-12
# Farther from a part of the mesh than this many of its radii its solid angle is that of a dipole.
DIPOLE_REACH = 2.0


class BoneArrays(NamedTuple):
    """What loops read of one bone, in bone coordinates; f faces, v vertices, l leaves."""

    boxes: Floats  # (2 l, 6) of the nodes of the tree, a binary heap
    starts: Integers  # (l + 1,) first record of each leaf
    records: Floats  # (f, WIDTH) frames of the triangles, in the order of the tree
    order: Integers  # (f,) face of each record
    edge_normals: Floats  # (f, 3, 3) pseudonormals
    vertex_normals: Floats  # (v, 3)
    faces: Integers  # (f, 3)
    dipoles: Floats  # (2 l, 6) middles and area vectors of the nodes, (0, 6) for a closed mesh


class Memory(NamedTuple):
    """What is known about one bone from the last question about each of n points."""

    anchor: Floats  # (n, 3) where a point was, in bone coordinates
    bound: Floats  # (n,) lower bound of the distance there, -infinity where nothing is known
    triangle: Integers  # (n,) record of the nearest triangle, -1 where nothing is known

    @classmethod
    def of(cls, count: int) -> "Memory":
        """Nothing known of so many points."""
        return cls(
            np.zeros((count, 3)), np.full(count, -np.inf), np.full(count, -1, dtype=np.int64)
        )

    def some(self, rows: Integers) -> "Memory":
        """What is known about some of the points."""
        return Memory(self.anchor[rows], self.bound[rows], self.triangle[rows])


def bone_arrays(exact: ExactDistance, *, closed: bool) -> BoneArrays:
    """Arrays of a mesh; ``closed`` says that it is closed and does not intersect itself."""
    boxes, starts, records, _ = exact.tree
    dipoles = np.empty((0 if closed else len(boxes), 6))
    if not closed:
        _dipole_loop(boxes, starts, records, dipoles)
    return BoneArrays(*exact.tree, *exact.pseudonormals, exact.faces, dipoles)


@loop
def _dipole_loop(boxes, starts, records, dipoles):
    """Fill middles, weighted by area, and area vectors of the nodes of a tree."""
    leaves = len(starts) - 1
    areas = np.zeros(len(boxes))
    dipoles[:] = 0.0
    for leaf in range(leaves):
        node = leaves + leaf
        for n in range(starts[leaf], starts[leaf + 1]):
            area = 0.5 * records[n, BX] * records[n, CY]
            areas[node] += area
            for k in range(3):
                middle = (
                    records[n, k]
                    + (
                        (records[n, BX] + records[n, CX]) * records[n, 3 + k]
                        + records[n, CY] * records[n, 6 + k]
                    )
                    / 3.0
                )
                dipoles[node, k] += area * middle
                dipoles[node, 3 + k] += area * records[n, 9 + k]
    for node in range(leaves - 1, 0, -1):
        areas[node] = areas[2 * node] + areas[2 * node + 1]
        for k in range(6):
            dipoles[node, k] = dipoles[2 * node, k] + dipoles[2 * node + 1, k]
    for node in range(1, len(boxes)):
        for k in range(3):
            dipoles[node, k] /= max(areas[node], 1e-300)


@loop
def _solid_angle(record, x, y, z):
    """Half the solid angle of the triangle of a record."""
    a = record[0] - x, record[1] - y, record[2] - z
    b = (
        a[0] + record[BX] * record[3],
        a[1] + record[BX] * record[4],
        a[2] + record[BX] * record[5],
    )
    c = (
        a[0] + record[CX] * record[3] + record[CY] * record[6],
        a[1] + record[CX] * record[4] + record[CY] * record[7],
        a[2] + record[CX] * record[5] + record[CY] * record[8],
    )
    return half_solid_angle(a, b, c)


@loop
def winding_number(bone, x, y, z, stack):
    """How often a mesh winds around a point: about 1 inside and 0 outside."""
    boxes = bone.boxes
    dipoles = bone.dipoles
    leaves = len(bone.starts) - 1
    total = 0.0
    top = 0
    stack[0] = 1
    while top >= 0:
        node = stack[top]
        top -= 1
        offset = minus(row_of(dipoles, node), (x, y, z))
        away = dot(offset, offset)
        flux = dot(offset, (dipoles[node, 3], dipoles[node, 4], dipoles[node, 5]))
        radius = 0.0
        for k in range(3):
            radius += (
                max(boxes[node, 3 + k] - dipoles[node, k], dipoles[node, k] - boxes[node, k]) ** 2
            )
        if away > DIPOLE_REACH * DIPOLE_REACH * radius:
            total += 0.5 * flux / (away * np.sqrt(away))
        elif node < leaves:
            stack[top + 1] = 2 * node
            stack[top + 2] = 2 * node + 1
            top += 2
        else:
            for n in range(bone.starts[node - leaves], bone.starts[node - leaves + 1]):
                total += _solid_angle(bone.records[n], x, y, z)
    return total / (2.0 * np.pi)


@loop
def winding_loop(bone, points, winding):
    """Fill winding numbers (n,) of points (n, 3) in bone coordinates."""
    stack = np.empty(STACK, np.int64)
    for i in range(len(points)):
        winding[i] = winding_number(bone, points[i, 0], points[i, 1], points[i, 2], stack)


@loop
def distance_at(bone, x, y, z, triangle, stack, squares):
    """Signed distance of one point in bone coordinates, its unit gradient, and the record of the
    nearest triangle.

    ``triangle`` is a record that may be near, or -1; it does not change the answer. ``stack`` and
    ``squares`` (STACK,) are arrays to work in, of int64 and float64.
    """
    records = bone.records
    square = np.inf if triangle < 0 else record_square(records, triangle, x, y, z)
    tree = (bone.boxes, bone.starts, records, bone.order)
    best = nearest_triangle(tree, (x, y, z), triangle, square, TIE, (stack, squares))[0]
    _, (du, dv, w), feature = offset_in_frame(records, best, x, y, z)
    distance = np.sqrt(du * du + dv * dv + w * w)
    # From the nearest point to the point asked about.
    ox = du * records[best, 3] + dv * records[best, 6] + w * records[best, 9]
    oy = du * records[best, 4] + dv * records[best, 7] + w * records[best, 10]
    oz = du * records[best, 5] + dv * records[best, 8] + w * records[best, 11]
    normals = bone.edge_normals, bone.vertex_normals, bone.faces, bone.order
    nx, ny, nz = feature_normal(normals, records, best, feature)
    side = 1.0 if ox * nx + oy * ny + oz * nz >= 0.0 else -1.0
    boxes = bone.boxes
    size = boxes[1, 3] - boxes[1, 0] + boxes[1, 4] - boxes[1, 1] + boxes[1, 5] - boxes[1, 2]
    if len(bone.dipoles) > 0:
        solid = winding_number(bone, x, y, z, stack) > 0.5
        if feature == FACE and (side < 0.0) != solid:  # a face that looks inward
            nx, ny, nz = -nx, -ny, -nz
        side = -1.0 if solid else 1.0
    if feature != FACE and distance > ON_SURFACE * size:
        return (
            side * distance,
            side * ox / distance,
            side * oy / distance,
            side * oz / distance,
            best,
        )
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-9:  # a pseudonormal that vanishes, as at a fold
        nx = x - 0.5 * (boxes[1, 0] + boxes[1, 3])
        ny = y - 0.5 * (boxes[1, 1] + boxes[1, 4])
        nz = z - 0.5 * (boxes[1, 2] + boxes[1, 5]) + 1e-300
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return side * distance, nx / length, ny / length, nz / length, best


@loop
def least_distance(boxes, point, anchor, bound):
    """Lower bound of the distance of a point in bone coordinates, three numbers: by the box of the
    bone, and by the ``bound`` that was known at ``anchor``, where the point was.
    """
    moved = minus(point, anchor)
    least = bound - np.sqrt(dot(moved, moved))
    beyond = box_square(boxes, 1, *point)
    return max(least, np.sqrt(beyond)) if beyond > 0.0 else least


def distances(
    bone: BoneArrays, pose: Floats, points: Floats, reach: Floats, known: Memory
) -> tuple[Floats, Floats]:
    """Signed distances (n,) of points (n, 3) to a bone in a pose, and their unit gradients (n, 3),
    as `distance_loop` has them; what is ``known`` of the points is brought up to date.
    """
    distance, gradient = np.empty(len(points)), np.empty((len(points), 3))

    def work(a: int, b: int) -> None:
        memory = [part[a:b] for part in known]
        distance_loop(bone, pose, points[a:b], reach[a:b], *memory, distance[a:b], gradient[a:b])

    in_chunks(len(points), work)
    return distance, gradient


@loop
def distance_loop(bone, pose, points, reach, anchor, bound, triangle, distance, gradient):
    """Signed distances (n,) of points (n, 3) in the world to a bone in a pose (4, 4), and their
    unit gradients (n, 3) in world axes.

    Negative inside. Where the bone is farther than ``reach`` (n,), only a lower bound beyond it may
    be given, with a gradient of zero; a reach below zero asks for depths beyond it only. On the
    surface the gradient is the pseudonormal. ``anchor``, ``bound`` and ``triangle`` are those of a
    `Memory`, which save time, change no answer and are brought up to date.
    """
    stack = np.empty(STACK, np.int64)
    squares = np.empty(STACK)
    for i in range(len(points)):
        local = local_point(pose, row_of(points, i))
        least = least_distance(bone.boxes, local, row_of(anchor, i), bound[i])
        if least > reach[i]:
            distance[i] = least
            gradient[i] = 0.0
            continue
        known = anchor, bound, triangle
        distance[i], way = ask(bone, local, known, i, stack, squares)
        gradient[i, 0], gradient[i, 1], gradient[i, 2] = turned(pose, way)


@loop
def ask(bone, local, known, i, stack, squares):
    """Signed distance of one point in bone coordinates and its unit gradient; row i of the arrays
    of a `Memory` is brought up to date.
    """
    anchor, bound, triangle = known
    d, gx, gy, gz, best = distance_at(bone, *local, triangle[i], stack, squares)
    for k in range(3):
        anchor[i, k] = local[k]
    triangle[i] = best
    # The sign of an open mesh may change without a zero between.
    bound[i] = d if len(bone.dipoles) == 0 else -np.inf
    return d, (gx, gy, gz)


@loop
def near_loop(boxes, pose, points, rows, reach, anchor, bound, near):
    """Mark ``near`` (k,) those of some points that a bone in a pose may be within ``reach`` (n,)
    of, by its boxes and the ``anchor`` and ``bound`` of a `Memory` of all points (n, 3).
    """
    for k in range(len(rows)):
        i = rows[k]
        local = local_point(pose, row_of(points, i))
        near[k] = least_distance(boxes, local, row_of(anchor, i), bound[i]) < reach[i]
