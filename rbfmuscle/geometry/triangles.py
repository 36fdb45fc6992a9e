"""Distance from a point to a triangle, and the normals that give it a sign.

Each triangle has a record: a plane frame with the longest edge on its x-axis. In that frame the two
angles at the x-axis are acute, so the nearest feature follows from a few comparisons. A triangle of
zero area is its longest edge. The sign comes from angle-weighted pseudonormals (Baerentzen & Aanaes
2005, "Signed distance computation using the angle weighted pseudonormal").
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.loops import loop

# Columns of a record: corner A, x-axis, y-axis, normal, then x of B, x and y of C, and 1/|BC|^2,
# 1/|CA|^2.
WIDTH = 18
BX = 12
CX = 13
CY = 14
INVERSE_BC = 15
INVERSE_CA = 16
# The last column tells which corner of the face is A.
FIRST = 17
# Features: the face, the edges AB, BC, CA, the corners A, B, C.
FACE = 0
EDGE = 1
CORNER = 4


@loop
def fill_records(vertices, faces, order, records):
    """Fill ``records`` (m, WIDTH) with the frames of the triangles ``faces[order]``; zero area is
    allowed.
    """
    length = np.empty(3)
    corner = np.empty((3, 3))
    for n in range(len(order)):
        face = order[n]
        for k in range(3):
            total = 0.0
            for j in range(3):
                total += (vertices[faces[face, (k + 1) % 3], j] - vertices[faces[face, k], j]) ** 2
            length[k] = total
        first = 0
        for k in range(1, 3):
            if length[k] > length[first]:
                first = k
        for k in range(3):
            for j in range(3):
                corner[k, j] = vertices[faces[face, (first + k) % 3], j]
        _fill_record(corner, records[n])
        records[n, FIRST] = first


@loop
def _fill_record(corner, record):
    bx = 0.0
    along = 0.0
    cy = 0.0
    for j in range(3):
        record[j] = corner[0, j]
        record[3 + j] = corner[1, j] - corner[0, j]
        bx += record[3 + j] ** 2
    bx = np.sqrt(bx)
    if bx > 0.0:
        for j in range(3):
            record[3 + j] /= bx
    else:
        record[3] = 1.0
        record[4] = 0.0
        record[5] = 0.0
    for j in range(3):
        along += (corner[2, j] - corner[0, j]) * record[3 + j]
    for j in range(3):
        record[6 + j] = corner[2, j] - corner[0, j] - along * record[3 + j]
        cy += record[6 + j] ** 2
    cy = np.sqrt(cy)
    if cy > 1e-14 * bx:
        for j in range(3):
            record[6 + j] /= cy
    else:
        cy = 0.0
        _any_normal(record)
    for j in range(3):
        a, b = (j + 1) % 3, (j + 2) % 3
        record[9 + j] = record[3 + a] * record[6 + b] - record[3 + b] * record[6 + a]
    record[BX] = bx
    record[CX] = along
    record[CY] = cy
    bc, ca = (along - bx) ** 2 + cy**2, along**2 + cy**2
    record[INVERSE_BC] = 1.0 / bc if bc > 0.0 else 0.0
    record[INVERSE_CA] = 1.0 / ca if ca > 0.0 else 0.0


@loop
def _any_normal(record):
    least = 0
    for j in range(1, 3):
        if abs(record[3 + j]) < abs(record[3 + least]):
            least = j
    scale = 1.0 / np.sqrt(1.0 - record[3 + least] ** 2)
    for j in range(3):
        unit = 1.0 if j == least else 0.0
        record[6 + j] = scale * (unit - record[3 + least] * record[3 + j])


@loop
def nearest_in_frame(bx, cx, cy, inverse_bc, inverse_ca, x, y):
    """In-plane offset from the triangle to (x, y), and the feature nearest to it: ``(dx, dy,
    feature)``.
    """
    if y <= 0.0 or cy <= 0.0:
        if x <= 0.0:
            return x, y, CORNER
        if x >= bx:
            return x - bx, y, CORNER + 1
        return 0.0, y, EDGE
    # Outside of an edge where the cross product with its direction is negative.
    beyond_bc = (x - bx) * cy + y * (bx - cx)
    beyond_ca = y * cx - x * cy
    if beyond_bc <= 0.0 and beyond_ca <= 0.0:
        return 0.0, 0.0, FACE
    best = np.inf
    dx = 0.0
    dy = 0.0
    feature = FACE
    if beyond_bc > 0.0:
        t = ((x - bx) * (cx - bx) + y * cy) * inverse_bc
        feature = CORNER + 1 if t <= 0.0 else (CORNER + 2 if t >= 1.0 else EDGE + 1)
        t = min(max(t, 0.0), 1.0)
        dx, dy = x - bx - t * (cx - bx), y - t * cy
        best = dx * dx + dy * dy
    if beyond_ca > 0.0:
        t = (x * cx + y * cy) * inverse_ca
        ax, ay = x - min(max(t, 0.0), 1.0) * cx, y - min(max(t, 0.0), 1.0) * cy
        if ax * ax + ay * ay < best:
            dx, dy = ax, ay
            feature = CORNER if t <= 0.0 else (CORNER + 2 if t >= 1.0 else EDGE + 2)
    return dx, dy, feature


def pseudonormals(vertices: Floats, faces: Integers, across: Integers) -> tuple[Floats, Floats]:
    """Directions that sign a distance, of edges (m, 3, 3) and of vertices (n, 3).

    Edge k of a face takes the sum of the unit normals of the face and of that ``across`` (m, 3) it,
    below zero where there is none; a vertex takes the normals weighted by their angle. Faces
    without area have no normal.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    normal = np.cross(u, v)
    area = np.sqrt(np.einsum("md,md->m", normal, normal))
    unit = np.divide(normal, area[:, None], out=np.zeros_like(normal), where=area[:, None] > 0.0)
    at_a = np.arctan2(area, np.einsum("md,md->m", u, v))
    at_b = np.arctan2(area, -np.einsum("md,md->m", u, v - u))
    angles = np.column_stack([at_a, at_b, np.pi - at_a - at_b])
    of_vertices = np.zeros((len(vertices), 3))
    np.add.at(of_vertices, faces, angles[:, :, None] * unit[:, None])
    return unit[:, None] + np.where((across >= 0)[:, :, None], unit[across], 0.0), of_vertices


@loop
def _dot(a, b, p, q):
    """(b - a) . (p - q), without temporary arrays."""
    return (
        (b[0] - a[0]) * (p[0] - q[0])
        + (b[1] - a[1]) * (p[1] - q[1])
        + (b[2] - a[2]) * (p[2] - q[2])
    )


@loop
def triangle_normal(vertices, faces, f):
    """Normal of a triangle, twice its area long."""
    a = faces[f, 0]
    b = faces[f, 1]
    c = faces[f, 2]
    ux = vertices[b, 0] - vertices[a, 0]
    uy = vertices[b, 1] - vertices[a, 1]
    uz = vertices[b, 2] - vertices[a, 2]
    vx = vertices[c, 0] - vertices[a, 0]
    vy = vertices[c, 1] - vertices[a, 1]
    vz = vertices[c, 2] - vertices[a, 2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@loop
def nearest_weights(p, a, b, c, weights):
    """Barycentric weights of the point of a triangle nearest to p (Ericson 2005, section 5.1.5)."""
    d1, d2 = _dot(a, b, p, a), _dot(a, c, p, a)
    weights[:] = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        weights[0] = 1.0
        return
    d3, d4 = _dot(a, b, p, b), _dot(a, c, p, b)
    if d3 >= 0.0 and d4 <= d3:
        weights[1] = 1.0
        return
    d5, d6 = _dot(a, b, p, c), _dot(a, c, p, c)
    if d6 >= 0.0 and d5 <= d6:
        weights[2] = 1.0
        return
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        weights[1] = d1 / (d1 - d3)
        weights[0] = 1.0 - weights[1]
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        weights[2] = d2 / (d2 - d6)
        weights[0] = 1.0 - weights[2]
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        weights[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        weights[1] = 1.0 - weights[2]
    else:
        # The whole is zero on a triangle without area, all of which its edges hold.
        whole = max(va + vb + vc, 1e-300)
        weights[1], weights[2] = vb / whole, vc / whole
        weights[0] = 1.0 - weights[1] - weights[2]
