"""Triangles of a surface that go through others of the same surface."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.frames import cross as cross_product
from rbfmuscle.geometry.frames import dot, row_of
from rbfmuscle.geometry.surfaces import corner_from, opposite_half_edges, six_volumes
from rbfmuscle.loops import loop

# Triangles in a leaf of the tree, and bits of their places along each axis by which they are
# sorted.
LEAF, BITS = 4, 10
# Pairs of nodes that wait at a time: less than four for each level of the tree.
WAITING = 512
# Pairs of leaves looked into at a time.
STAGE = 64


def morton_order(points: Floats) -> Integers:
    """Order (n,) of points (n, 3) in which near ones are mostly near each other: by Morton code."""
    low = points.min(axis=0)
    size = max(float((points.max(axis=0) - low).max()), np.finfo(float).tiny)
    cell = np.minimum((points - low) * ((1 << BITS) / size), (1 << BITS) - 1).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


class FaceTree:
    """Boxes around the triangles of a mesh, by nearness at one moment; good for later ones with the
    same faces.

    Attributes
    ----------
    faces : (m, 3) ndarray
    rings : tuple of ndarray, optional
        `vertex_rings`, of a closed mesh: every edge has two triangles that agree on their outside.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        middle = (
            vertices[self.faces[:, 0]] + vertices[self.faces[:, 1]] + vertices[self.faces[:, 2]]
        ) / 3.0
        self._order = morton_order(middle)
        self._corners = self.faces[self._order]
        self._leaves = 1 << max(int(np.ceil(len(self.faces) / LEAF)) - 1, 0).bit_length()
        self._boxes: tuple[Floats, Floats] | None = None
        opposite = opposite_half_edges(self.faces)
        closed = (opposite >= 0).all()
        self.rings = vertex_rings(self.faces, opposite, len(vertices)) if closed else None

    def crossing(self, vertices: Floats) -> Booleans:
        """Which triangles cross others, as `crossing_faces` says, for places of the vertices (n, 3)
        now.
        """
        found = np.zeros(len(self.faces), dtype=np.bool_)
        found[self.pairs(vertices)] = True
        return found

    def pairs(
        self,
        vertices: Floats,
        among: Booleans | None = None,
        *,
        folds: bool = True,
        again: bool = False,
    ) -> Integers:
        """Pairs of triangles (k, 2) that cross.

        With ``among`` (n,) only those of a triangle with one of these corners or, with ``folds``,
        one whose triangles do not lie side by side. ``again`` says that no other vertices moved
        since the last call, whose other boxes are still right.
        """
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        marked = np.ones(len(vertices), dtype=np.bool_) if among is None else among
        plain = np.zeros(len(vertices), dtype=np.bool_)
        if folds and self.rings is not None:
            plain_loop(vertices, *self.rings, plain)
            marked = marked | ~plain
        if not marked.any():
            return np.zeros((0, 2), dtype=np.int64)
        asked = np.zeros(LEAF * self._leaves, dtype=np.bool_)
        wanted = np.zeros(2 * self._leaves, dtype=np.bool_)
        _asked_loop(self._corners, marked, asked, wanted)
        whole = self._boxes is None or not again
        if self._boxes is None:
            self._boxes = np.empty((self._leaves, 6, LEAF)), np.empty((2 * self._leaves, 6))
        face, node = self._boxes
        _boxes_loop(vertices, self._corners, face, node, wanted, whole)
        near = np.empty((16 * self._leaves, 2), dtype=np.int64)
        met = _pairs_loop(node, wanted, near)
        if met > len(near):
            near = np.empty((met, 2), dtype=np.int64)
            _pairs_loop(node, wanted, near)
        crossed = np.empty((len(self.faces), 2), dtype=np.int64)
        count = _cross_loop(vertices, self._corners, near[:met], face, asked, plain, crossed)
        if count > len(crossed):
            crossed = np.empty((count, 2), dtype=np.int64)
            _cross_loop(vertices, self._corners, near[:met], face, asked, plain, crossed)
        return self._order[crossed[:count]]


def crossing_faces(vertices: Floats, faces: Integers) -> Booleans:
    """Which triangles (m,) cross others of the same surface.

    An edge crosses a triangle where its ends lie on either side of it and its line passes through
    the inside. Triangles that share an edge are never counted, those that share a corner are where
    the far edge of one goes through the other. Triangles that lie in one plane and only overlap do
    not cross.
    """
    if len(faces) == 0:
        return np.zeros(0, dtype=bool)
    vertices = np.asarray(vertices, dtype=np.float64)
    return FaceTree(vertices, faces).crossing(vertices)


@loop
def _asked_loop(faces, marked, asked, wanted):
    """Mark the triangles that have a ``marked`` (n,) corner, which are asked for, and the leaves of
    a tree that hold one.
    """
    leaves = len(wanted) // 2
    for f in range(len(faces)):
        asked[f] = marked[faces[f, 0]] | marked[faces[f, 1]] | marked[faces[f, 2]]
        wanted[leaves + f // LEAF] |= asked[f]


@loop
def _boxes_loop(vertices, faces, face, node, wanted, whole):
    """Make the boxes of the triangles, leaf by leaf, (leaves, 6, LEAF), and of the tree's nodes
    (2 * leaves, 6): node k holds those of 2k and 2k + 1. Lower corner, then upper corner.

    Marks the nodes (2 * leaves,) that hold a leaf that is ``wanted``; boxes of other leaves stay
    unless ``whole``.
    """
    leaves = len(face)
    for leaf in range(leaves):
        if not (whole or wanted[leaves + leaf]):
            continue
        for a in range(3):
            least = np.inf
            most = -np.inf
            for place in range(LEAF):
                f = LEAF * leaf + place
                low = np.inf
                high = -np.inf
                if f < len(faces):
                    i, j, k = row_of(faces, f)
                    low = min(vertices[i, a], vertices[j, a], vertices[k, a])
                    high = max(vertices[i, a], vertices[j, a], vertices[k, a])
                face[leaf, a, place] = low
                face[leaf, 3 + a, place] = high
                least, most = min(least, low), max(most, high)
            node[leaves + leaf, a] = least
            node[leaves + leaf, 3 + a] = most
    for k in range(leaves - 1, 0, -1):
        wanted[k] = wanted[2 * k] or wanted[2 * k + 1]
        for a in range(3):
            node[k, a] = min(node[2 * k, a], node[2 * k + 1, a])
            node[k, 3 + a] = max(node[2 * k, 3 + a], node[2 * k + 1, 3 + a])


@loop
def _apart(one, i, other, j):
    """Whether two boxes do not touch."""
    # All six are compared: which of them tells cannot be foreseen, and a wrong guess costs more
    # than the rest.
    return (
        (one[i, 0] > other[j, 3])
        | (other[j, 0] > one[i, 3])
        | (one[i, 1] > other[j, 4])
        | (other[j, 1] > one[i, 4])
        | (one[i, 2] > other[j, 5])
        | (other[j, 2] > one[i, 5])
    )


@loop
def _pairs_loop(node, wanted, pairs):
    """Pairs of leaves whose boxes touch, from the root down; how many there are, also beyond the
    room for them.
    """
    leaves = len(node) // 2
    waiting = np.empty((WAITING, 2), dtype=np.int64)
    waiting[0, 0], waiting[0, 1] = 1, 1
    count, met = 1, 0
    while count > 0:
        count -= 1
        i, j = waiting[count, 0], waiting[count, 1]
        if i >= leaves:
            if met < len(pairs):
                pairs[met, 0], pairs[met, 1] = i - leaves, j - leaves
            met += 1
            continue
        # Nodes of a pair are of one level.
        for p in range(2 * i, 2 * i + 2):
            for q in range(2 * j, 2 * j + 2):
                if p > q or _apart(node, p, node, q) or not (wanted[p] or wanted[q]):
                    continue
                waiting[count, 0], waiting[count, 1] = p, q
                count += 1
    return met


@loop
def _cross_loop(vertices, faces, pairs, box, among, plain, crossed):
    """The triangles of pairs of leaves: which of them touch by their boxes, then which of these
    cross. How many pairs do, also beyond what ``crossed`` (k, 2) holds.
    """
    some = np.empty((STAGE * LEAF * LEAF, 2), np.int64)
    found = 0
    for start in range(0, len(pairs), STAGE):
        near = _near_loop(pairs[start : start + STAGE], box, among, some)
        # Nearly all that touch share a corner: those that do not are put in front.
        count = 0
        for k in range(near):
            f, g = some[k, 0], some[k, 1]
            some[count, 0] = f
            some[count, 1] = g
            count += _meet(faces, f, g, plain)
        for k in range(count):
            f, g = some[k, 0], some[k, 1]
            if cross(vertices, faces, f, g):
                if found < len(crossed):
                    crossed[found, 0] = f
                    crossed[found, 1] = g
                found += 1
    return found


@loop
def _near_loop(pairs, box, among, some):
    """Fill ``some`` with the triangles of pairs of leaves whose boxes touch, one of them marked;
    how many there are.
    """
    # Without branches, as which of them touch is a toss-up.
    near, count = np.empty(LEAF, np.bool_), 0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        for m in range(LEAF):
            for n in range(LEAF):
                near[n] = (
                    (box[i, 0, m] <= box[j, 3, n])
                    & (box[j, 0, n] <= box[i, 3, m])
                    & (box[i, 1, m] <= box[j, 4, n])
                    & (box[j, 1, n] <= box[i, 4, m])
                    & (box[i, 2, m] <= box[j, 5, n])
                    & (box[j, 2, n] <= box[i, 5, m])
                )
            for n in range(LEAF):
                some[count, 0] = LEAF * i + m
                some[count, 1] = LEAF * j + n
                asked = among[LEAF * i + m] | among[LEAF * j + n]
                count += near[n] & asked & ((i != j) | (n > m))
    return count


@loop
def _meet(faces, f, g, plain):
    """Whether two triangles can cross: not if they share an edge, or a corner around which none
    covers another.
    """
    # Without branches: nearly all pairs that touch share a corner, and which one cannot be
    # foreseen.
    p, q, r = row_of(faces, f)
    a, b, c = row_of(faces, g)
    first = (p == a) | (p == b) | (p == c)
    second = (q == a) | (q == b) | (q == c)
    third = (r == a) | (r == b) | (r == c)
    shared = np.int64(first) + np.int64(second) + np.int64(third)
    ringed = (first & plain[p]) | (second & plain[q]) | (third & plain[r])
    return (shared == 0) | ((shared == 1) & (not ringed))


@loop
def cross(vertices, faces, f, g):
    """Whether an edge of one triangle goes through the inside of the other."""
    if not (_straddles(vertices, faces, f, g) and _straddles(vertices, faces, g, f)):
        return False
    return _edges_cross(vertices, faces, f, g) or _edges_cross(vertices, faces, g, f)


@loop
def _straddles(vertices, faces, f, g):
    """Whether f has corners on both sides of the plane of g; those that they share lie in it."""
    a, b, c = row_of(faces, g)
    above, below = False, False
    for k in range(3):
        p = faces[f, k]
        if p in (a, b, c):
            continue
        side = _side(vertices, a, b, c, p)
        above |= side > 0.0
        below |= side < 0.0
    return above and below


@loop
def _edges_cross(vertices, faces, f, g):
    """Whether an edge of f goes through the inside of g."""
    a, b, c = row_of(faces, g)
    for k in range(3):
        p, q = faces[f, k], faces[f, (k + 1) % 3]
        if p in (a, b, c) or q in (a, b, c):
            continue
        if _side(vertices, a, b, c, p) * _side(vertices, a, b, c, q) >= 0.0:
            continue
        one = _side(vertices, p, q, a, b)
        two = _side(vertices, p, q, b, c)
        three = _side(vertices, p, q, c, a)
        if (one > 0.0 and two > 0.0 and three > 0.0) or (one < 0.0 and two < 0.0 and three < 0.0):
            return True
    return False


@loop
def _side(vertices, a, b, c, d):
    """Six times the signed volume of a tetrahedron: which side of the triangle abc the point d lies
    on.
    """
    at = row_of(vertices, a)
    to_b = corner_from(vertices, b, at)
    to_c = corner_from(vertices, c, at)
    return six_volumes(to_b, to_c, corner_from(vertices, d, at))


def vertex_rings(faces: Integers, opposite: Integers, count: int) -> tuple[Integers, Integers]:
    """Neighbours of each of ``count`` vertices of a closed surface in the order of the triangles
    between them: those of vertex v are ``other[start[v] : start[v + 1]]``.

    ``opposite`` are the opposite half-edges (3m,). A vertex at which several rings meet has none.
    """
    tail = faces.ravel()
    # From a half-edge to the next one that begins at the same vertex.
    half_edges = np.arange(len(tail))
    beside = opposite[half_edges - half_edges % 3 + (half_edges + 2) % 3]
    first = np.full(count, -1)
    first[tail] = half_edges
    walks, used = np.flatnonzero(first >= 0), np.bincount(tail, minlength=count)
    now = first[walks]
    rows, steps = [], []
    while len(walks):
        rows.append(walks)
        steps.append(now)
        now = beside[now]
        going = now != first[walks]
        walks, now = walks[going], now[going]
    row = np.concatenate(rows)
    step = np.concatenate(steps)
    whole = (np.bincount(row, minlength=count) == used)[row]
    row, step = row[whole], step[whole]
    order = np.argsort(row, kind="stable")
    start = np.searchsorted(row[order], np.arange(count + 1))
    return start, np.roll(faces, -1, axis=1).ravel()[step[order]]


@loop
def plain_loop(vertices, start, other, plain):
    """Mark (n,) the vertices whose triangles lie side by side when seen along the mean normal
    there; ``start`` and ``other`` are `vertex_rings`.

    Where all triangles of a ring are seen from outside and the ring goes round once, none covers
    another, so no two of them cross.
    """
    most = 0
    for v in range(len(plain)):
        most = max(most, start[v + 1] - start[v])
    sides, normals = np.empty((3, most)), np.empty((3, most))
    for v in range(len(plain)):
        plain[v] = start[v] < start[v + 1] and _side_by_side(
            vertices, v, other[start[v] : start[v + 1]], sides, normals
        )


@loop
def _side_by_side(vertices, v, ring, sides, normals):
    """Whether the triangles between a vertex and the ring around it go round once, all seen from
    outside; ``sides`` and ``normals`` are arrays to work in.
    """
    x = 0.0
    y = 0.0
    z = 0.0
    at = row_of(vertices, v)
    last = corner_from(vertices, ring[-1], at)
    side = last
    for k in range(len(ring)):
        before = side
        side = corner_from(vertices, ring[k], at)
        normal = cross_product(before, side)
        x += normal[0]
        y += normal[1]
        z += normal[2]
        for a in range(3):
            sides[a, k] = side[a]
            normals[a, k] = normal[a]
    # A vector at a right angle to the mean normal: the ring goes from below to above it once.
    least = min(abs(x), abs(y), abs(z))
    across = y, -x, 0.0
    if abs(x) == least:
        across = 0.0, z, -y
    elif abs(y) == least:
        across = -z, 0.0, x
    square = 1e-12 * (x * x + y * y + z * z)
    turns = 0
    outside = True
    above = dot(across, last) >= 0.0
    for k in range(len(ring)):
        normal = normals[0, k], normals[1, k], normals[2, k]
        along = dot(normal, (x, y, z))
        outside &= (along > 0.0) & (along * along > square * dot(normal, normal))
        below = not above
        above = dot(across, (sides[0, k], sides[1, k], sides[2, k])) >= 0.0
        turns += below & above
    return outside & (turns == 1)
