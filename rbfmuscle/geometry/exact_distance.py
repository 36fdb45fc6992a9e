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
from rbfmuscle.geometry.frames import cross, divided, dot, minus, row_of
from rbfmuscle.geometry.surfaces import corner_from, opposite_half_edges
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
def _record_loop(vertices, faces, order, records):
    """Fill ``records`` (m, WIDTH) with the frames of the triangles ``faces[order]``; zero area is
    allowed.
    """
    square = np.empty(3)
    for n in range(len(order)):
        face = order[n]
        for k in range(3):
            one = row_of(vertices, faces[face, k])
            side = corner_from(vertices, faces[face, (k + 1) % 3], one)
            square[k] = dot(side, side)
        first = np.argmax(square)
        a = row_of(vertices, faces[face, first])
        to_b = corner_from(vertices, faces[face, (first + 1) % 3], a)
        to_c = corner_from(vertices, faces[face, (first + 2) % 3], a)
        bx = np.sqrt(square[first])
        x_axis = divided(to_b, bx) if bx > 0.0 else (1.0, 0.0, 0.0)
        cx = dot(to_c, x_axis)
        rise = minus(to_c, (cx * x_axis[0], cx * x_axis[1], cx * x_axis[2]))
        cy = np.sqrt(dot(rise, rise))
        if cy > 1e-14 * bx:
            y_axis = divided(rise, cy)
        else:
            cy = 0.0
            y_axis = _across(x_axis)
        normal = cross(x_axis, y_axis)
        for k in range(3):
            records[n, k] = a[k]
            records[n, 3 + k] = x_axis[k]
            records[n, 6 + k] = y_axis[k]
            records[n, 9 + k] = normal[k]
        bc, ca = (cx - bx) ** 2 + cy**2, cx**2 + cy**2
        records[n, BX] = bx
        records[n, CX] = cx
        records[n, CY] = cy
        records[n, INVERSE_BC] = 1.0 / bc if bc > 0.0 else 0.0
        records[n, INVERSE_CA] = 1.0 / ca if ca > 0.0 else 0.0
        records[n, FIRST] = first


@loop
def _across(axis):
    """A unit vector at a right angle to another, as near as may be to an axis of coordinates."""
    least = np.argmin(np.abs(np.array(axis)))
    scale = 1.0 / np.sqrt(1.0 - axis[least] ** 2)
    along = np.zeros(3)
    along[least] = 1.0
    return (
        scale * (along[0] - axis[least] * axis[0]),
        scale * (along[1] - axis[least] * axis[1]),
        scale * (along[2] - axis[least] * axis[2]),
    )


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


@loop
def nearest_weights(p, a, b, c):
    """Barycentric weights of the point of a triangle nearest to p (Ericson 2005, section 5.1.5)."""
    to_b = minus(b, a)
    to_c = minus(c, a)
    way = minus(p, a)
    d1, d2 = dot(to_b, way), dot(to_c, way)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    way = minus(p, b)
    d3, d4 = dot(to_b, way), dot(to_c, way)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    way = minus(p, c)
    d5, d6 = dot(to_b, way), dot(to_c, way)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        share = d1 / (d1 - d3)
        return 1.0 - share, share, 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        share = d2 / (d2 - d6)
        return 1.0 - share, 0.0, share
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        share = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - share, share
    # The whole is zero on a triangle without area, all of which its edges hold.
    whole = max(va + vb + vc, 1e-300)
    at_b, at_c = vb / whole, vc / whole
    return 1.0 - at_b - at_c, at_b, at_c


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


# What stays where vertices move: order of the triangles, starts of the leaves, faces across edges.
Layout = tuple[Integers, Integers, Integers]


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
        if layout is None:
            order = np.arange(len(faces))
            depth = max(0, int(np.ceil(np.log2(len(faces) / LEAF))))
            starts = np.zeros((1 << depth) + 1, dtype=np.int64)
            # One corner after another, which takes a third of the time of a mean over all.
            middle = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3.0
            _order_loop(middle, order, depth, starts)
            layout = order, starts, faces_across(faces)
        self.layout = layout
        order, starts, _ = layout
        #: The arrays that :func:`nearest_triangle` takes.
        self.tree = Tree(
            np.empty((2 * len(starts) - 2, 6)), starts, np.empty((len(faces), WIDTH)), order
        )
        _record_loop(vertices, faces, order, self.tree.records)
        _box_loop(vertices, faces, order, starts, self.tree.boxes)

    @cached_property
    def pseudonormals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions that sign a distance, of the faces' edges (m, 3, 3) and of vertices (n, 3).

        Edge k of a face takes the sum of the unit normals of the face and of that across it, if
        there is one; a vertex takes the normals weighted by their angle. Faces without area have no
        normal.
        """
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        u, v = b - a, c - a
        normal = np.cross(u, v)
        area = np.sqrt(np.einsum("md,md->m", normal, normal))
        sized = area[:, None] > 0.0
        unit = np.divide(normal, area[:, None], out=np.zeros_like(normal), where=sized)
        at_a = np.arctan2(area, np.einsum("md,md->m", u, v))
        at_b = np.arctan2(area, -np.einsum("md,md->m", u, v - u))
        angles = np.column_stack([at_a, at_b, np.pi - at_a - at_b])
        of_vertices = np.zeros((len(self.vertices), 3))
        np.add.at(of_vertices, self.faces, angles[:, :, None] * unit[:, None])
        across = self.layout[2]
        other = np.where((across >= 0)[:, :, None], unit[across], 0.0)
        return unit[:, None] + other, of_vertices

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
        near = np.full(len(points), -1)
        distance = self.unsigned(points, near, reach)
        closest = np.empty_like(points)
        normal = np.empty_like(points)
        normals = (*self.pseudonormals, self.faces, self.tree.order)
        _side_loop(points, self.tree, normals, near, distance, closest, normal)
        return distance, closest, np.where(near < 0, -1, self.tree.order[near]), normal

    def unsigned(self, points: Floats, near: Integers, reach: float = np.inf) -> Floats:
        """Distance (n,) of points (n, 3), at most ``reach``.

        ``near`` (n,) holds the record of a triangle near each point, -1 where none is known;
        afterwards that of the nearest one, -1 beyond the reach.
        """
        distance = np.empty(len(points))

        def work(a: int, b: int) -> None:
            nearest_loop(points[a:b], float(reach), self.tree, near[a:b], distance[a:b])

        in_chunks(len(points), work)
        return distance


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
            longest, axis = -1.0, 0
            for k in range(3):
                least, most = np.inf, -np.inf
                for n in range(low, high):
                    value = centres[order[n], k]
                    least, most = min(least, value), max(most, value)
                if most - least > longest:
                    longest, axis = most - least, k
            _select(centres[:, axis], order, low, high - 1, middle)


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
def box_square(boxes, node, x, y, z):
    """Squared distance from a point to the box of a node."""
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@loop
def record_square(records, n, x, y, z):
    """Squared distance from a point to the triangle of record n."""
    _, (du, dv, w), _ = offset_in_frame(records, n, x, y, z)
    return du * du + dv * dv + w * w


@loop
def rectangle_square(records, n, x, y, z):
    """Squared distance from a point to the rectangle around the triangle of record n: a lower bound
    without branches.
    """
    away = x - records[n, 0], y - records[n, 1], z - records[n, 2]
    u = dot(away, (records[n, 3], records[n, 4], records[n, 5]))
    v = dot(away, (records[n, 6], records[n, 7], records[n, 8]))
    w = dot(away, (records[n, 9], records[n, 10], records[n, 11]))
    du = max(-u, u - records[n, BX], 0.0)
    dv = max(-v, v - records[n, CY], 0.0)
    return du * du + dv * dv + w * w


@loop
def offset_in_frame(records, n, x, y, z):
    """Place of a point in the frame of the triangle of record n, in its plane; the way to the point
    from the nearest place of the triangle; and the feature that this lies in.
    """
    away = x - records[n, 0], y - records[n, 1], z - records[n, 2]
    u = dot(away, (records[n, 3], records[n, 4], records[n, 5]))
    v = dot(away, (records[n, 6], records[n, 7], records[n, 8]))
    w = dot(away, (records[n, 9], records[n, 10], records[n, 11]))
    du, dv, feature = nearest_in_frame(
        records[n, BX],
        records[n, CX],
        records[n, CY],
        records[n, INVERSE_BC],
        records[n, INVERSE_CA],
        u,
        v,
    )
    return (u, v), (du, dv, w), feature


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
    nodes[0], squares[0] = 1, box_square(boxes, 1, x, y, z)
    while top >= 0:
        node = nodes[top]
        top -= 1
        if squares[top + 1] > square * (1.0 + slack):
            continue
        if node < leaves:
            left = box_square(boxes, 2 * node, x, y, z)
            right = box_square(boxes, 2 * node + 1, x, y, z)
            near = 2 * node + 1 if right < left else 2 * node
            nodes[top + 1], squares[top + 1] = 4 * node + 1 - near, max(left, right)
            nodes[top + 2], squares[top + 2] = near, min(left, right)
            top += 2
            continue
        for n in range(starts[node - leaves], starts[node - leaves + 1]):
            # Most triangles are too far away to be looked at closely.
            if rectangle_square(records, n, x, y, z) > square * (1.0 + slack):
                continue
            d = record_square(records, n, x, y, z)
            if d < square * (1.0 - slack):
                best, square = n, d
            elif d <= square * (1.0 + slack) and best >= 0 and order[n] < order[best]:
                best, square = n, min(d, square)
    return best, square


@loop
def nearest_loop(points, reach, tree, near, distance):
    """Fill the records of the triangles nearest to points (n, 3), -1 beyond ``reach``, and their
    distances (n,), at most the reach. A record that is in ``near`` (n,) already is where the search
    begins.
    """
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    best = np.int64(-1)
    for i in range(len(points)):
        x, y, z = row_of(points, i)
        # The last answer bounds the next one where points come in order.
        best = near[i] if near[i] >= 0 else best
        square = reach * reach
        if best >= 0:
            known = record_square(tree.records, best, x, y, z)
            best = best if known < square else np.int64(-1)
            square = min(known, square)
        best, square = nearest_triangle(tree, (x, y, z), best, square, 0.0, stack)
        near[i] = best
        distance[i] = np.sqrt(square) if best >= 0 else reach


@loop
def _side_loop(points, tree, normals, near, distance, closest, normal):
    """Give distances (n,) their signs, and fill the nearest points and pseudonormals (n, 3)."""
    closest[:] = points
    normal[:] = 0.0
    for i in range(len(points)):
        n = near[i]
        if n < 0:
            continue
        x, y, z = row_of(points, i)
        (u, v), (du, dv, _), feature = offset_in_frame(tree.records, n, x, y, z)
        outward = feature_normal(normals, tree.records, n, feature)
        record = tree.records[n]
        side = 0.0
        for k in range(3):
            closest[i, k] = record[k] + (u - du) * record[3 + k] + (v - dv) * record[6 + k]
            normal[i, k] = outward[k]
            side += (points[i, k] - closest[i, k]) * outward[k]
        if side < 0.0:
            distance[i] = -distance[i]


@loop
def feature_normal(normals, records, n, feature):
    """The direction that signs the distance to a feature of the triangle of record n; ``normals``
    are those of the edges and vertices, the faces, and the face of each record.
    """
    edge_normals, vertex_normals, faces, order = normals
    if feature == FACE:
        return records[n, 9], records[n, 10], records[n, 11]
    face = order[n]
    first = int(records[n, FIRST])
    if feature < CORNER:
        k = (first + feature - EDGE) % 3
        return edge_normals[face, k, 0], edge_normals[face, k, 1], edge_normals[face, k, 2]
    return row_of(vertex_normals, faces[face, (first + feature - CORNER) % 3])
