"""Queries of a bone's distance field inside compiled loops.

The field is a sparse grid of cells. Each cell names the few triangles that are nearest to its
corners; a query takes the nearest of them, so it answers with a true distance to the mesh, with its
sharp gradient, and not with an interpolation. Cells are fine in a band about the surface and
coarser elsewhere, and outside the grid those of its border serve.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.cells import (
    BOUND,
    INVERSE,
    UNIT,
    _beyond,
    _block_entry,
    _common_bound,
    _placed,
)
from rbfmuscle.geometry.triangles import CORNER, EDGE, FACE, nearest_in_frame
from rbfmuscle.jit import compiled

# What a cell says of its side.
CROSSED = 0
OUTSIDE = 1
INSIDE = 2
MIXED = 3
# A header counts triangles in its low four bits, holds the side in two more and the lower bound
# above.
COUNT, SIDE = 15, 4
# Offsets below this share of the unit are lost in the rounding of the records (single precision).
ROUNDING = 1e-3
# Marks a far point beside the number of its fine cell.
CELL_FAR = 128
# Steps of a walk over the surface, at most, and what counts as nearer there. What a walk that ends
# early misses is part of the field's error, which is measured when it is built.
WALK, NEARER = 8, 1 - 1e-6
# Points of one stage: their reads of memory overlap instead of waiting for each other.
STAGE = 64
# From how many points on it pays to ask first whether all of a stage are out of reach.
LEAST_TOGETHER = 16


class FieldData(NamedTuple):
    """What a query reads: integers are int32, the rest but ``grid`` is float32."""

    grid: (
        np.ndarray
    )  # (5,) origin, 1 / edge of a block, and the unit of the lower bounds in ``lists``
    # (a, b, c) offset of each block's list, or -1 - k where it is cut into the fine cells k
    blocks: np.ndarray
    cells: np.ndarray  # (k, 64) offsets of the fine cells' lists
    # (l,) header and triangles of each cell; of mixed cells the row of ``corners`` after them
    lists: np.ndarray
    # (q, 12) signed distances at the corners of cells where the mesh gives no sign, least corner, 1
    # / edge
    corners: np.ndarray
    far: np.ndarray  # (f,) triangles that face the outside, for points beyond the grid
    records: np.ndarray  # (m, 16) frames of the triangles, relative to the grid's origin
    edge_normals: np.ndarray  # (m, 3, 3) pseudonormals, edges in the order of the records
    vertex_normals: np.ndarray  # (n, 3) pseudonormals
    vertices: np.ndarray  # (m, 3) corners A, B and C of each record
    across: np.ndarray  # (m, 3) records across the edges AB, BC and CA, -1 where there is none


class Found(NamedTuple):
    """Of the points of one stage: where relative to the origin, cell, nearest record, offset in its
    frame.
    """

    local: np.ndarray
    entry: np.ndarray
    best: np.ndarray
    offset: np.ndarray


@compiled(inline="always")
def _square(n, x, y, z, records):
    """Squared distance to record n of a point relative to the origin, in single precision; without
    branches, as they are a toss-up.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    qx = np.float32(x) - records[n, 0]
    qy = np.float32(y) - records[n, 1]
    qz = np.float32(z) - records[n, 2]
    u = qx * records[n, 3] + qy * records[n, 4] + qz * records[n, 5]
    v = qx * records[n, 6] + qy * records[n, 7] + qz * records[n, 8]
    w = qx * records[n, 9] + qy * records[n, 10] + qz * records[n, 11]
    bx = records[n, 12]
    cx = records[n, 13]
    cy = records[n, 14]
    du = u - min(max(u, zero), bx)
    ab = du * du + v * v
    ex, eu = cx - bx, u - bx
    t = min(max((eu * ex + v * cy) * records[n, 15], zero), one)
    fu, fv = eu - t * ex, v - t * cy
    bc = fu * fu + fv * fv
    t = min(max((u * cx + v * cy) / (cx * cx + cy * cy), zero), one)
    fu, fv = u - t * cx, v - t * cy
    ca = fu * fu + fv * fv
    inside = (v >= zero) & (eu * cy - v * ex <= zero) & (v * cx - u * cy <= zero)
    # A product, as compilers make a jump of a choice.
    return w * w + np.float32(not inside) * min(min(ab, bc), ca)


@compiled(inline="always")
def _nearest_listed(x, y, z, entry, far_point, lists, far, records):
    """Nearest of the triangles of a cell: record and squared distance."""
    best, square = np.int32(-1), np.float32(np.inf)
    first = np.uint32(entry)
    for m in range(np.uint32(lists[first] & COUNT)):
        # Unsigned, so that no index is tested for counting from the end.
        n = np.uint32(lists[first + np.uint32(1) + m])
        s = _square(n, x, y, z, records)
        best = np.int32(n) if s < square else best
        square = min(s, square)
    if far_point:
        for m in range(len(far)):
            s = _square(far[m], x, y, z, records)
            best = far[m] if s < square else best
            square = min(s, square)
    return best, square


@compiled
def _mixed_side(x, y, z, entry, lists, corners):
    """Trilinear interpolation of the signed distances at the corners of the cell."""
    row = lists[entry + 1 + (lists[entry] & COUNT)]
    u = min(max((x - corners[row, 8]) * corners[row, 11], 0.0), 1.0)
    v = min(max((y - corners[row, 9]) * corners[row, 11], 0.0), 1.0)
    w = min(max((z - corners[row, 10]) * corners[row, 11], 0.0), 1.0)
    side = 0.0
    for k in range(8):
        a = u if k & 4 else 1.0 - u
        b = v if k & 2 else 1.0 - v
        c = w if k & 1 else 1.0 - w
        side += a * b * c * corners[row, k]
    return side


@compiled(inline="always")
def _in_frame(n, x, y, z, records):
    """A point in the frame of record n."""
    qx = x - records[n, 0]
    qy = y - records[n, 1]
    qz = z - records[n, 2]
    u = qx * records[n, 3] + qy * records[n, 4] + qz * records[n, 5]
    v = qx * records[n, 6] + qy * records[n, 7] + qz * records[n, 8]
    w = qx * records[n, 9] + qy * records[n, 10] + qz * records[n, 11]
    return u, v, w


@compiled(inline="always")
def _offset(n, x, y, z, records):
    """Offset of a point from its nearest point of record n, in the record's frame; and whether that
    is inside.
    """
    u, v, w = _in_frame(n, x, y, z, records)
    bx = records[n, 12]
    cx = records[n, 13]
    cy = records[n, 14]
    ex, eu = cx - bx, u - bx
    inside = (v >= 0.0) & (eu * cy - v * ex <= 0.0) & (v * cx - u * cy <= 0.0)
    if inside:
        return 0.0, 0.0, w, True
    du, dv, _ = nearest_in_frame(bx, cx, cy, records[n, 15], 1.0 / (cx * cx + cy * cy), u, v)
    return du, dv, w, False


@compiled
def _walk(best, square, x, y, z, records, across):
    """Record at which a walk over neighbours, always to a nearer one, ends.

    The nearest triangle listed in a cell is not always the nearest of all; then the point lies
    beyond one of its edges, mostly that to the nearest.
    """
    for _ in range(WALK):
        u, v, _ = _in_frame(best, x, y, z, records)
        bx = records[best, 12]
        cx = records[best, 13]
        cy = records[best, 14]
        _, _, feature = nearest_in_frame(
            bx, cx, cy, records[best, 15], 1.0 / (cx * cx + cy * cy), u, v
        )
        if feature == FACE:
            return best
        # The edges at corner k are k and k - 1.
        first = feature - EDGE if feature < CORNER else feature - CORNER
        step = best
        for turn in range(1 if feature < CORNER else 2):
            n = across[best, (first + 2 * turn) % 3]
            if n >= 0:
                s = _square(n, x, y, z, records)
                if s < square * NEARER:
                    step, square = n, s
        if step == best:
            return best
        best = step
    return best


@compiled(inline="always")
def _world(n, du, dv, dw, records):
    gx = du * records[n, 3] + dv * records[n, 6] + dw * records[n, 9]
    gy = du * records[n, 4] + dv * records[n, 7] + dw * records[n, 10]
    gz = du * records[n, 5] + dv * records[n, 8] + dw * records[n, 11]
    return gx, gy, gz


@compiled
def _crossed_side(x, y, z, n, records, edge_normals, vertex_normals, vertices):
    """Projection of the offset from an edge or a corner of record n on its pseudonormal."""
    u, v, w = _in_frame(n, x, y, z, records)
    cx, cy = records[n, 13], records[n, 14]
    du, dv, feature = nearest_in_frame(
        records[n, 12], cx, cy, records[n, 15], 1.0 / (cx * cx + cy * cy), u, v
    )
    if feature == FACE:
        return w
    gx, gy, gz = _world(n, du, dv, w, records)
    if feature < CORNER:
        k = feature - EDGE
        return gx * edge_normals[n, k, 0] + gy * edge_normals[n, k, 1] + gz * edge_normals[n, k, 2]
    k = vertices[n, feature - CORNER]
    return gx * vertex_normals[k, 0] + gy * vertex_normals[k, 1] + gz * vertex_normals[k, 2]


@compiled
def _slow_side(x, y, z, entry, n, data):
    """Positive outside: where neither the cell nor the side of a face tells."""
    if data.lists[entry] >> SIDE & 3 == MIXED:
        return _mixed_side(x, y, z, entry, data.lists, data.corners)
    return _crossed_side(
        x, y, z, n, data.records, data.edge_normals, data.vertex_normals, data.vertices
    )


@compiled(inline="always")
def _unit_gradient(n, distance, du, dv, dw, least, records):
    """Gradient of the distance; the normal of the triangle where the offset is lost in rounding."""
    lost = abs(distance) <= least
    scale = 0.0 if lost else 1.0 / distance
    return _world(n, scale * du, scale * dv, 1.0 if lost else scale * dw, records)


@compiled
def _stage(points, pose, reach, data, found, square):
    """Nearest record of up to STAGE points; each pass reads what the next one needs.

    Fills the points relative to the origin, their cells, their nearest record (-1 where out of
    reach) and the squared distance (the lower bound where out of reach).
    """
    grid = data.grid
    lists = data.lists
    far = data.far
    records = data.records
    local = found.local
    entry = found.entry
    best = found.best
    unit = grid[UNIT]
    if len(points) >= LEAST_TOGETHER:
        bound = _common_bound(points, pose, grid, data.blocks, data.cells, lists)
        if bound > reach.max():
            best[:] = -1
            square[:] = bound
            return
    _find_cells(points, pose, data, found, square)
    for n in range(len(points)):
        bound = (lists[entry[n]] >> BOUND) * unit
        if square[n] > 0.0:
            # The bone lies in the grid, so the way to the grid and the way on from there are at a
            # right angle or more.
            bound = np.sqrt(bound * bound + square[n])
        square[n] = bound
        if bound > reach[n]:
            best[n] = -1
        else:
            # Read so that the record is at hand in the next pass.
            square[n] = records[lists[entry[n] + 1], 0]
    for n in range(len(points)):
        if best[n] >= 0:
            far_point = best[n] >= CELL_FAR
            x = local[n, 0]
            y = local[n, 1]
            z = local[n, 2]
            best[n], square[n] = _nearest_listed(x, y, z, entry[n], far_point, lists, far, records)


@compiled
def _find_cells(points, pose, data, found, square):
    """Fill places relative to the origin, the entries of their cells, and squared distances from
    the grid; ``found.best`` gets the flag `CELL_FAR` of what is far.
    """
    scale = data.grid[INVERSE]
    for n in range(len(points)):
        x, y, z = _placed(points[n], pose, data.grid)
        found.local[n, 0] = x
        found.local[n, 1] = y
        found.local[n, 2] = z
        found.entry[n], cell, far_point = _block_entry(x, y, z, scale, data.blocks)
        found.best[n] = cell | (CELL_FAR if far_point else 0)
        square[n] = _beyond(x, y, z, scale, data.blocks) if far_point else 0.0
    for n in range(len(points)):
        if found.entry[n] < 0:
            found.entry[n] = data.cells[-1 - found.entry[n], found.best[n] & (CELL_FAR - 1)]


@compiled
def _finish(count, data, found, square):
    """Turn squared into signed distances, and fill the offsets from the surface in the frames of
    the records.
    """
    local, entry, best, offset = found
    lists = data.lists
    records = data.records
    across = data.across
    for n in range(count):
        if best[n] < 0:
            continue
        x = local[n, 0]
        y = local[n, 1]
        z = local[n, 2]
        m = best[n]
        du, dv, dw, inside = _offset(m, x, y, z, records)
        if not inside:
            m = _walk(m, square[n], x, y, z, records, across)
            du, dv, dw, inside = _offset(m, x, y, z, records)
            best[n] = m
        # The nearest was found in single precision.
        square[n] = du * du + dv * dv + dw * dw
        offset[n, 0] = du
        offset[n, 1] = dv
        offset[n, 2] = dw
        state = lists[entry[n]] >> SIDE & 3
        side = 1.0 if state == OUTSIDE else (-1.0 if state == INSIDE else dw)
        if state == MIXED or (state == CROSSED and not inside):
            side = _slow_side(x, y, z, entry[n], m, data)
        d = np.sqrt(square[n])
        square[n] = d if side >= 0.0 else -d


@compiled
def query_loop(points, pose, reach, size, distance, gradient, data):
    """Distances (n,) and gradients (n, 3), world axes, of points in world coordinates; ``gradient``
    may be empty.

    ``pose`` takes local units to the world, one of which is ``size`` long; ``reach`` (n,) is in the
    world's.
    """
    found = Found(
        np.empty((STAGE, 3)),
        np.empty(STAGE, np.int32),
        np.empty(STAGE, np.int32),
        np.empty((STAGE, 3)),
    )
    least = ROUNDING * data.grid[UNIT]
    near = np.empty(STAGE)
    for start in range(0, len(points), STAGE):
        end = min(start + STAGE, len(points))
        some, d = points[start:end], distance[start:end]
        for n in range(len(some)):
            # Not below zero, as cells inside the bone have zero for a bound.
            near[n] = max(reach[start + n], 0.0) / size
        _stage(some, pose, near[: len(some)], data, found, d)
        _finish(len(some), data, found, d)
        if len(gradient) > 0:
            _turn(len(some), pose, size, least, found, d, data.records, gradient[start:end])
        for n in range(len(some)):
            d[n] *= size


@compiled
def _turn(count, pose, size, least, found, distance, records, gradient):
    """Gradients in world axes; zero where the bone is out of reach."""
    best, offset = found.best, found.offset
    for n in range(count):
        gx = 0.0
        gy = 0.0
        gz = 0.0
        if best[n] >= 0:
            du = offset[n, 0]
            dv = offset[n, 1]
            dw = offset[n, 2]
            gx, gy, gz = _unit_gradient(best[n], distance[n], du, dv, dw, least, records)
        for k in range(3):
            gradient[n, k] = size * (pose[k, 0] * gx + pose[k, 1] * gy + pose[k, 2] * gz)
