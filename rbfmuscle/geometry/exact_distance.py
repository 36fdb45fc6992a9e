"""Exact signed distance to a triangle mesh: a bounding volume tree with angle-weighted
pseudonormals.

The tree is a balanced binary heap over triangles in an order that halves them along the longest
extent.

Each triangle has a record: a plane frame with the longest edge on its x-axis. In that frame the two
angles at the x-axis are acute, so the nearest feature follows from a few comparisons. A triangle of
zero area is its longest edge. The sign comes from angle-weighted pseudonormals (Baerentzen & Aanaes
2005, "Signed distance computation using the angle weighted pseudonormal").
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import opposite_half_edges
from rbfmuscle.geometry.threads import in_chunks
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


# Triangles in a leaf, at most.
LEAF = 4
# Deeper than any tree that fits in memory.
STACK = 64


class Tree(NamedTuple):
    """Boxes of the heap's nodes, starts of the leaves, records of the triangles and the face of
    each record.
    """

    boxes: NDArray[np.float64]
    starts: NDArray[np.int64]
    records: NDArray[np.float64]
    order: NDArray[np.int64]


class Layout(NamedTuple):
    """What stays where vertices move: order of the triangles, starts of the leaves, faces across
    the edges.
    """

    order: NDArray[np.int64]
    starts: NDArray[np.int64]
    across: NDArray[np.int64]


class ExactDistance:
    """Signed distance, nearest point and nearest face of a closed triangle mesh.

    Parameters
    ----------
    vertices : (n, 3) array_like
        Finite.
    faces : (m, 3) array_like of int
        At least one, outward; vertices are shared by index. The sign is exact where the mesh is
        closed and consistently oriented, and that of the nearest face elsewhere.
    layout : Layout, optional
        Of the same faces with their vertices elsewhere, as in a frame before: halves the time.

    Examples
    --------
    >>> tetrahedron = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> exact = ExactDistance(tetrahedron, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    >>> exact.signed_distance([[0.1, 0.1, 0.02], [0.0, 0.0, -3.0]]).round(9).tolist()
    [-0.02, 3.0]
    """

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, *, layout: Layout | None = None
    ) -> None:
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        self.vertices, self.faces = vertices, faces
        self.layout = _layout(vertices, faces) if layout is None else layout
        self.order = self.layout.order
        self.starts = self.layout.starts
        self.across = self.layout.across
        self.records = np.empty((len(faces), WIDTH))
        self.boxes = np.empty((2 * len(self.starts) - 2, 6))
        fill_records(vertices, faces, self.order, self.records)
        _box_loop(vertices, faces, self.order, self.starts, self.boxes)

    @cached_property
    def pseudonormals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pseudonormals of the faces' edges (m, 3, 3) and of the vertices (n, 3)."""
        return pseudonormals(self.vertices, self.faces, self.across)

    @property
    def tree(self) -> Tree:
        """The arrays that :func:`nearest_triangle` takes."""
        return Tree(self.boxes, self.starts, self.records, self.order)

    def signed_distance(self, points: ArrayLike, *, reach: float = np.inf) -> NDArray[np.float64]:
        """Signed distance (n,) of points (n, 3) [unit of the mesh], negative inside.

        Distances beyond ``reach`` are not looked for, which is much faster, and come out as
        ``reach``.
        """
        return self.nearest(points, reach=reach)[0]

    def nearest(
        self, points: ArrayLike, *, reach: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Signed distance (n,), nearest point (n, 3), nearest face (n,) and the sign's pseudonormal
        (n, 3).

        Where the mesh is further away than ``reach`` these are ``reach``, the point itself, -1 and
        zero.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if not reach > 0.0:
            raise ValueError(f"reach must be above zero, got {reach}")
        count = len(points)
        distance, closest = np.empty(count), np.empty((count, 3))
        face, normal = np.empty(count, dtype=np.int64), np.empty((count, 3))
        normals = (*self.pseudonormals, self.faces, self.order)

        def work(a, b):
            out = (distance[a:b], closest[a:b], face[a:b], normal[a:b])
            _nearest_loop(points[a:b], float(reach), self.tree, normals, out)

        in_chunks(count, work)
        return distance, closest, face, normal


def _layout(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Layout:
    order = np.arange(len(faces))
    depth = max(0, int(np.ceil(np.log2(len(faces) / LEAF))))
    starts = np.zeros((1 << depth) + 1, dtype=np.int64)
    # One corner after another, which takes a third of the time of a mean over all.
    middle = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3.0
    _order_loop(middle, order, depth, starts)
    return Layout(order, starts, faces_across(faces))


def faces_across(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Face across edge k (corner k to k + 1) of each face, (m, 3).

    -1 where the edge has no other face, -2 where it has several, or one that runs the same way.
    """
    opposite = opposite_half_edges(faces)
    return np.where(opposite < 0, opposite, opposite // 3).reshape(-1, 3)


@loop
def _order_loop(centres, order, depth, starts):
    """Order triangles so that each node of the heap holds a range, halved along its longest
    extent.
    """
    count = len(order)
    leaves = 1 << depth
    for leaf in range(leaves + 1):
        starts[leaf] = count * leaf // leaves
    for level in range(depth):
        step = leaves >> level
        for node in range(1 << level):
            low, high = starts[node * step], starts[(node + 1) * step]
            middle = starts[node * step + step // 2]
            axis = _longest_axis(centres, order, low, high)
            _select(centres[:, axis], order, low, high - 1, middle)


@loop
def _longest_axis(centres, order, low, high):
    longest, axis = -1.0, 0
    for k in range(3):
        least, most = np.inf, -np.inf
        for n in range(low, high):
            value = centres[order[n], k]
            least, most = min(least, value), max(most, value)
        if most - least > longest:
            longest, axis = most - least, k
    return axis


@loop
def _select(keys, order, left, right, middle):
    """Hoare's selection: afterwards no key before ``middle`` is greater than one after it."""
    while left < right:
        pivot = keys[order[(left + right) // 2]]
        i, j = left, right
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@loop
def _box_loop(vertices, faces, order, starts, boxes):
    """Boxes of all nodes, from the leaves up; a leaf without triangles keeps an empty box."""
    leaves = len(starts) - 1
    for leaf in range(leaves):
        box = boxes[leaves + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for n in range(starts[leaf], starts[leaf + 1]):
            for k in range(3):
                for j in range(3):
                    value = vertices[faces[order[n], k], j]
                    box[j], box[3 + j] = min(box[j], value), max(box[3 + j], value)
    for node in range(leaves - 1, 0, -1):
        for j in range(3):
            boxes[node, j] = min(boxes[2 * node, j], boxes[2 * node + 1, j])
            boxes[node, 3 + j] = max(boxes[2 * node, 3 + j], boxes[2 * node + 1, 3 + j])


@loop
def _box_square(boxes, node, x, y, z):
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@loop
def record_square(records, n, x, y, z):
    """Squared distance from a point to the triangle of record n."""
    qx = x - records[n, 0]
    qy = y - records[n, 1]
    qz = z - records[n, 2]
    u = qx * records[n, 3] + qy * records[n, 4] + qz * records[n, 5]
    v = qx * records[n, 6] + qy * records[n, 7] + qz * records[n, 8]
    w = qx * records[n, 9] + qy * records[n, 10] + qz * records[n, 11]
    du, dv, _ = nearest_in_frame(
        records[n, BX],
        records[n, CX],
        records[n, CY],
        records[n, INVERSE_BC],
        records[n, INVERSE_CA],
        u,
        v,
    )
    return du * du + dv * dv + w * w


@loop
def nearest_triangle(tree, at, best, square, slack, stack):
    """Record of the triangle of a `Tree` nearest to a point ``at``, and the squared distance.

    ``best`` and ``square`` are a record known to be as near as that, or -1 and the squared reach.
    Of triangles whose squared distances differ by a smaller share than ``slack`` that of the least
    face number is taken, so that rounding and the order of the questions decide nothing. ``stack``
    is two (STACK,) arrays to work in, of int64 and float64.
    """
    boxes, starts, records, order = tree
    x, y, z = at
    nodes, squares = stack
    leaves = len(starts) - 1
    top = 0
    nodes[0], squares[0] = 1, _box_square(boxes, 1, x, y, z)
    while top >= 0:
        node = nodes[top]
        top -= 1
        if squares[top + 1] > square * (1.0 + slack):
            continue
        while node < leaves:
            left = _box_square(boxes, 2 * node, x, y, z)
            right = _box_square(boxes, 2 * node + 1, x, y, z)
            node = 2 * node
            far, other = right, node + 1
            if right < left:
                far, other = left, node
                node += 1
            if far <= square * (1.0 + slack):
                top += 1
                nodes[top], squares[top] = other, far
            if min(left, right) > square * (1.0 + slack):
                break
        if node < leaves:
            continue
        for n in range(starts[node - leaves], starts[node - leaves + 1]):
            d = record_square(records, n, x, y, z)
            if d < square * (1.0 - slack):
                best, square = n, d
            elif d <= square * (1.0 + slack) and best >= 0 and order[n] < order[best]:
                best, square = n, min(d, square)
    return best, square


@loop
def _nearest_loop(points, reach, tree, normals, out):
    records, order = tree.records, tree.order
    distance, closest, face, normal = out
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    best = np.int64(-1)
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        square = reach * reach
        if best >= 0:
            # The last answer bounds the next one where points come in order.
            d = record_square(records, best, x, y, z)
            if d < square:
                square = d
            else:
                best = -1
        best, square = nearest_triangle(tree, (x, y, z), best, square, 0.0, stack)
        if best < 0:
            distance[i], face[i] = reach, -1
            for k in range(3):
                closest[i, k], normal[i, k] = points[i, k], 0.0
            continue
        face[i] = order[best]
        side = signed_side(records[best], order[best], points[i], normals, closest[i], normal[i])
        distance[i] = np.sqrt(square) if side >= 0.0 else -np.sqrt(square)


@loop
def signed_side(record, face, point, normals, closest, normal):
    """Fill the nearest point of a triangle and its pseudonormal; return the offset's part along it.

    ``normals`` holds the edge normals, the vertex normals, the faces and their order.
    """
    edge_normals, vertex_normals, faces, _ = normals
    feature = closest_in_record(record, point, closest)
    _pseudonormal(record, feature, face, edge_normals, vertex_normals, faces, normal)
    side = 0.0
    for k in range(3):
        side += (point[k] - closest[k]) * normal[k]
    return side


@loop
def closest_in_record(record, point, closest):
    """Fill the point of one triangle that is nearest to a point; return its feature."""
    u = 0.0
    v = 0.0
    w = 0.0
    for k in range(3):
        u += (point[k] - record[k]) * record[3 + k]
        v += (point[k] - record[k]) * record[6 + k]
        w += (point[k] - record[k]) * record[9 + k]
    du, dv, feature = nearest_in_frame(
        record[BX], record[CX], record[CY], record[INVERSE_BC], record[INVERSE_CA], u, v
    )
    for k in range(3):
        closest[k] = record[k] + (u - du) * record[3 + k] + (v - dv) * record[6 + k]
    return feature


@loop
def _pseudonormal(record, feature, face, edge_normals, vertex_normals, faces, normal):
    """Fill the direction that signs the distance to one feature of a face."""
    first = int(record[FIRST])
    for k in range(3):
        if feature == FACE:
            normal[k] = record[9 + k]
        elif feature < CORNER:
            normal[k] = edge_normals[face, (first + feature - EDGE) % 3, k]
        else:
            normal[k] = vertex_normals[faces[face, (first + feature - CORNER) % 3], k]
