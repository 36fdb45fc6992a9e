"""What gives space a value by a mesh: fields that others draw or cut by, winding numbers, and exact
distances that are sure of their side where a mesh is folded or open.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, to_world
from rbfmuscle.geometry.exact_distance import FACE, ExactDistance, Layout, offset_in_frame
from rbfmuscle.geometry.frames import cross, dot, row_of
from rbfmuscle.loops import loop


class Field(Protocol):
    """A scalar field: its values, and its values with their gradients."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3)."""

    def value_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) at points (n, 3)."""


# Of points (n, 3) and a limit, a number or (n,): signed distances (n,) to what cuts a surface,
# negative inside it, and their gradients (n, 3). Beyond the limit these are only lower bounds above
# it. No distance changes by more than one for each unit of way, so that answers bound those nearby.
Cut = Callable[[Floats, Floats | float], tuple[Floats, Floats]]


def winding_numbers(vertices: Floats, faces: Integers) -> Callable[[Floats], Floats]:
    """``winding(points) -> (n,)``: fast generalised winding numbers (Barill 2018) of a mesh, which
    may have holes.

    They are computed about the middle of the mesh, as igl's tree has single precision.
    """
    import igl

    middle = vertices.mean(axis=0)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.ascontiguousarray(vertices - middle), np.ascontiguousarray(faces, np.int64), 2)

    def winding(points: Floats) -> Floats:
        return np.asarray(tree.winding_number(np.ascontiguousarray(points - middle)))

    return winding


def inside_test(
    vertices: Floats, faces: Integers, *, least: float = 0.5
) -> Callable[[Floats], Booleans]:
    """``inside(points) -> (n,) bool`` by winding numbers above ``least``, for meshes with holes
    too.
    """
    winding = winding_numbers(vertices, faces)
    return lambda points: winding(points) > least


@loop
def half_solid_angle(a, b, c):
    """Half the solid angle of a triangle as seen from the origin (Van Oosterom & Strackee 1983,
    "The solid angle of a plane triangle").
    """
    x = np.sqrt(dot(a, a))
    y = np.sqrt(dot(b, b))
    z = np.sqrt(dot(c, c))
    below = x * y * z + dot(a, b) * z + dot(b, c) * x + dot(c, a) * y
    return np.arctan2(dot(a, cross(b, c)), below)


# Cells along the longer side, at most; below that the square root of the number of triangles.
_MOST_CELLS = 512
HERE = np.eye(4)


class Columns:
    """Counts how often a closed, consistently oriented mesh winds around points, along a line from
    each of them.

    A triangle that the line leaves the mesh through counts one, one that it enters by minus one;
    the sum is the winding number, exact also where the mesh is folded on itself. Edges are half
    open, so that a line through an edge or a vertex is counted once. The line runs along the
    shortest side of the mesh's box.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.vertices, self.faces = vertices, faces
        # Column by column, which takes a tenth of the time of all at once.
        low, high = (np.array([end(column) for column in vertices.T]) for end in (np.min, np.max))
        along = int(np.argmin(high - low))
        axes = (along + 1) % 3, (along + 2) % 3, along  # a right-handed turn of x, y, z
        cells = min(max(int(len(faces) ** 0.5), 1), _MOST_CELLS)
        fine = cells / max(float((high - low).max()), 1e-300)
        width, height = (int((high[k] - low[k]) * fine) + 1 for k in axes[:2])
        self._place = axes, low, high, fine, width
        # Triangles whose boxes meet each cell c of the plane across the columns,
        # items[starts[c] : starts[c + 1]], which lie between heights ends[c].
        starts = np.zeros(width * height + 1, dtype=np.int64)
        ends = np.repeat([[np.inf, -np.inf]], width * height, axis=0)
        covered = np.empty((len(faces), 4), dtype=np.int64)
        _count_loop(vertices, faces, self._place, covered, starts, ends)
        np.cumsum(starts, out=starts)
        items = np.empty(starts[-1], dtype=np.int64)
        _sort_loop(covered, width, starts, items)
        self._cells = starts, items, ends

    def inside(self, points: Floats, pose: Floats) -> Booleans:
        """Mask (n,) of the points (n, 3) that lie inside once a pose (4, 4) has carried them."""
        out = np.zeros(len(points), dtype=np.bool_)
        _inside_loop(points, pose, self.vertices, self.faces, self._place, self._cells, out)
        return out


@loop
def _count_loop(vertices, faces, place, covered, starts, ends):
    """Cells that each triangle's box covers, by column and row, in ``starts`` how many triangles
    each cell has, and in ``ends`` between which heights.

    The ``place`` of the grid is axes, x and y of the plane and z along the columns, the corners of
    the mesh's box, cells for each unit of length, and the number of cells along x.
    """
    (u, v, w), low, _, fine, width = place
    x = low[u]
    y = low[v]
    for f in range(len(faces)):
        a, b, c = row_of(faces, f)
        covered[f, 0] = int((min(vertices[a, u], vertices[b, u], vertices[c, u]) - x) * fine)
        covered[f, 1] = int((max(vertices[a, u], vertices[b, u], vertices[c, u]) - x) * fine)
        covered[f, 2] = int((min(vertices[a, v], vertices[b, v], vertices[c, v]) - y) * fine)
        covered[f, 3] = int((max(vertices[a, v], vertices[b, v], vertices[c, v]) - y) * fine)
        bottom = min(vertices[a, w], vertices[b, w], vertices[c, w])
        top = max(vertices[a, w], vertices[b, w], vertices[c, w])
        for j in range(covered[f, 2], covered[f, 3] + 1):
            for cell in range(j * width + covered[f, 0], j * width + covered[f, 1] + 1):
                starts[cell] += 1
                ends[cell, 0] = min(ends[cell, 0], bottom)
                ends[cell, 1] = max(ends[cell, 1], top)


@loop
def _sort_loop(covered, width, starts, items):
    """Put the triangles into their cells, each cell's from its end on."""
    for f in range(len(covered)):
        for j in range(covered[f, 2], covered[f, 3] + 1):
            for cell in range(j * width + covered[f, 0], j * width + covered[f, 1] + 1):
                starts[cell] -= 1
                items[starts[cell]] = f


@loop
def _inside_loop(points, pose, vertices, faces, place, cells, out):
    axes, low, high, fine, width = place
    starts, items, ends = cells
    u, v, w = axes
    at = np.empty(3)
    for n in range(len(points)):
        x, y, z = row_of(points, n)
        outside = False
        for k in range(3):
            at[k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
            outside |= not (low[k] <= at[k] <= high[k])
        if outside:
            continue
        i, j = int((at[u] - low[u]) * fine), int((at[v] - low[v]) * fine)
        cell, count = j * width + i, 0
        if not (ends[cell, 0] <= at[w] <= ends[cell, 1]):
            continue
        for m in range(starts[cell], starts[cell + 1]):
            count += _above(at, vertices, faces, items[m], axes)
        out[n] = count > 0


@loop
def _above(at, vertices, faces, f, axes):
    """1 where a triangle lies above a point and looks up, -1 where it looks down, else 0."""
    u, v, w = axes
    x = at[u]
    y = at[v]
    z = at[w]
    if max(vertices[faces[f, 0], w], vertices[faces[f, 1], w], vertices[faces[f, 2], w]) <= z:
        return 0
    found = 0
    west = 0.0, 0.0, False
    east = west
    for k in range(3):
        a, b = faces[f, k], faces[f, (k + 1) % 3]
        if (vertices[a, v] <= y) == (vertices[b, v] <= y):
            continue
        west = east
        east = _met(vertices, a, b, y, axes)
        found += 1
    if found < 2:
        return 0
    if east[0] < west[0]:
        west, east = east, west
    if not (west[0] <= x < east[0]):
        return 0
    if west[1] + (x - west[0]) / (east[0] - west[0]) * (east[1] - west[1]) <= z:
        return 0
    return 1 if west[2] else -1


@loop
def _met(vertices, a, b, y, axes):
    """Where the edge from a to b meets a line along the first axis: the place on it, the height,
    and whether the edge falls, all in the order of ``axes``.
    """
    u, v, w = axes
    # Computed alike for both triangles of the edge, so that both find the same place.
    p, q = min(a, b), max(a, b)
    t = (y - vertices[p, v]) / (vertices[q, v] - vertices[p, v])
    place = vertices[p, u] + t * (vertices[q, u] - vertices[p, u])
    height = vertices[p, w] + t * (vertices[q, w] - vertices[p, w])
    return place, height, vertices[a, v] > vertices[b, v]


def _as_points(points: ArrayLike) -> Floats:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)


class MeshDistance:
    """Exact distance of points to an outward mesh (vertices (n, 3) [scene unit], faces (m, 3));
    negative inside.

    A point is inside where the mesh winds around it: counted exactly for closed meshes (`Columns`);
    for those with holes the winding number exceeds one half (Jacobson et al. 2013; Barill et al.
    2018). The trees are built at the first call and kept, so that a bone's are built once, in the
    bone's own coordinates. ``layout`` is that of the same faces at another moment, as
    `ExactDistance` takes it.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        closed: bool = True,
        layout: Layout | None = None,
    ) -> None:
        self.closed = closed
        self.vertices = _as_points(vertices)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        self._known_layout = layout

    @cached_property
    def _exact(self) -> ExactDistance:
        return ExactDistance(self.vertices, self.faces, layout=self._known_layout)

    @cached_property
    def _inside(self) -> Callable[[Floats, Floats], Booleans]:
        if self.closed:
            return Columns(self.vertices, self.faces).inside
        wound = inside_test(self.vertices, self.faces)
        return lambda points, pose: wound(to_world(points, pose))

    @property
    def layout(self) -> Layout | None:
        """For the same faces at a later moment; None before the first distance."""
        return self._exact.layout if "_exact" in self.__dict__ else self._known_layout

    def inside(self, points: ArrayLike, *, pose: Floats = HERE) -> Booleans:
        """Which points (n, 3) lie inside, (n,), once a pose (4, 4) has carried them into the mesh's
        coordinates.
        """
        return self._inside(_as_points(points), pose)

    def unsigned(self, points: ArrayLike, *, near: Integers | None = None) -> Floats:
        """Distance (n,) of points (n, 3) to the surface [scene unit].

        ``near`` (n,) holds the place in the tree of a triangle near each point, -1 where none is
        known; afterwards that of the nearest one, for the next call with a mesh of the same layout.
        """
        points = _as_points(points)
        return self._exact.unsigned(points, np.full(len(points), -1) if near is None else near)

    def signed(
        self, points: ArrayLike, *, near: Integers | None = None, simple: bool = False
    ) -> Floats:
        """Distance to the surface, negative inside; as `unsigned`.

        Of a ``simple`` surface, one closed piece that nowhere crosses itself, the nearest triangle
        tells the side of a point that is before or behind it, which is much faster.
        """
        points = _as_points(points)
        near = np.full(len(points), -1) if near is None else near
        distance, side = self.unsigned(points, near=near), np.zeros(len(points))
        if simple:
            _side_loop(points, self._exact.tree.records, near, side)
        unsure = side == 0.0
        side[unsure] = np.where(self.inside(points[unsure]), -1.0, 1.0)
        return side * distance

    def nearest(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance (n,) on the side of the nearest face, nearest point (n, 3) and outward
        pseudonormal there (n, 3).
        """
        distance, closest, _, normal = self._exact.nearest(points)
        return distance, closest, normal

    def depth(self, points: ArrayLike, *, pose: Floats = HERE) -> Floats:
        """How deep points (n, 3) lie inside, (n,) [scene unit], 0 where outside; the pose is as for
        `inside`.
        """
        points = _as_points(points)
        out, inside = np.zeros(len(points)), self.inside(points, pose=pose)
        if inside.any():
            out[inside] = self.unsigned(to_world(points[inside], pose))
        return out


@loop
def _side_loop(points, records, near, side):
    """1 before and -1 behind the triangle nearest to each point, where it projects into that
    triangle.
    """
    for i in range(len(points)):
        x, y, z = row_of(points, i)
        _, (_, _, before), feature = offset_in_frame(records, near[i], x, y, z)
        if feature == FACE:
            side[i] = 1.0 if before >= 0.0 else -1.0
