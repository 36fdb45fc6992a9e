"""Signed distance to a moving muscle's material mesh, for its neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.surfaces import touching_balls, vertex_normals
from rbfmuscle.geometry.triangles import nearest_weights, triangle_normal
from rbfmuscle.geometry.winding import wound_around
from rbfmuscle.jit import compiled
from rbfmuscle.simulation.neighbours.extrapolation import MotionExtrapolator

if TYPE_CHECKING:
    from rbfmuscle.simulation.frame import MuscleModel


# Greatest thickness of a muscle, relative to rest.
DEEPER = 1.5
# Least cosine between the surface normal and the direction to a point for which the normal is used.
RIM = 0.7
# Depth, in mean edges, beyond which a point is inside only where its winding number says so.
FOLDED = 0.3


class Cells(NamedTuple):
    """Vertices sorted by the cells of a grid: its box, edge and shape; those of cell c are
    members[first[c] : first[c + 1]].
    """

    box: np.ndarray
    edge: float
    shape: np.ndarray
    first: np.ndarray
    members: np.ndarray


class Skin(NamedTuple):
    """Vertices, their normals, faces, and the faces around vertex v, ring[start[v] : start[v + 1]]."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    ring: np.ndarray


class NeighbourSurface:
    """Signed distance to a model's material mesh, for points near it.

    The nearest vertex is found through a uniform grid of cells as wide as the reach; the nearest point of the
    surface lies in one of the triangles around it, up to the square of an edge over the radius of curvature.
    Directions are interpolated vertex normals, or, around a rim, the direction to the point. The sign is that of the
    triangles that meet at the nearest point.

    Parameters
    ----------
    model : MuscleModel
        In its rest state.
    reach : float
        Greatest distance that will be asked for [scene unit].

    Attributes
    ----------
    points : (c, 3) ndarray
        The model's contact points.
    vertices : (n, 3) ndarray
    fixed : (n,) ndarray of bool
        Vertices that a bone holds.
    contact : (n,) ndarray of int
        Contact point that a vertex is, or is nearest to.
    deepest : (n,) ndarray
        How deep a point whose nearest vertex is this one may be.
    box, reach_box : (2, 3) ndarray
        About the surface, and about the model's contact points.
    field : Field or None
        The field whose zero set is shown, for models that have one.
    """

    def __init__(self, model: MuscleModel, reach: float) -> None:
        self.model, self.field = model, None
        vertices, faces = model.material_mesh()
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        corner = self.faces.ravel()
        order = np.argsort(corner, kind="stable")
        self.ring = order // 3
        self.start = np.searchsorted(corner[order], np.arange(len(vertices) + 1))
        sides = vertices[self.faces] - vertices[np.roll(self.faces, 1, axis=1)]
        self.edge = float(np.linalg.norm(sides, axis=2).mean())
        self.cell = float(reach) + self.edge
        rest, balls = np.ascontiguousarray(vertices, dtype=np.float64), np.empty((2, len(vertices)))
        touching_balls(rest, vertex_normals(rest, self.faces), balls, np.empty(len(rest)))
        self.deepest = DEEPER * np.minimum(balls[1], float(reach)) + self.edge
        self.contact = cKDTree(model.contact_points()).query(vertices)[1]
        self.fixed = np.asarray(model.contact_bone)[self.contact] >= 0
        #: Extrapolates the model's prediction.
        self.extrapolator = MotionExtrapolator()
        self.refresh()

    def refresh(self, way: Mapping[str, float] | None = None) -> None:
        """Update from the model's present state, extrapolated by the change ``way`` of the coordinates where given."""
        self._predicted = [np.array(self.model.contact_points()), np.array(self.model.material_mesh()[0])]
        self.points, self.vertices = (
            self._predicted if way is None else self.extrapolator.ahead(self._predicted, way)
        )
        self.vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        self.normals = vertex_normals(self.vertices, self.faces)
        self.box = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        #: Box of the contact points.
        self.reach_box = np.array([self.points.min(axis=0), self.points.max(axis=0)])
        shape = (np.ceil((self.box[1] - self.box[0]) / self.cell).astype(np.int64) + 1).clip(1)
        first = np.zeros(int(np.prod(shape)) + 1, dtype=np.int64)
        self.cells = Cells(self.box, self.cell, shape, first, np.empty(len(self.vertices), dtype=np.int64))
        _fill_loop(self.vertices, self.cells)

    def settled(self, way: Mapping[str, float]) -> None:
        """Record how far the solve moved the model from its prediction, for a change ``way`` of the coordinates."""
        self.extrapolator.learn(
            way, self._predicted, [self.model.contact_points(), self.model.material_mesh()[0]]
        )

    def apart(self, other: NeighbourSurface, reach: float) -> bool:
        """Whether no point of the other muscle can be nearer than ``reach`` to this surface, by their boxes."""
        return bool(
            np.any(other.reach_box[0] > self.box[1] + reach)
            or np.any(other.reach_box[1] < self.box[0] - reach)
        )

    def query(self, points: Floats, which: Booleans, reach: float) -> Any:
        """Distances of those points that are nearer than ``reach``.

        Parameters
        ----------
        points : (n, 3) ndarray
        which : (n,) ndarray of bool
            Points that are asked for.
        reach : float

        Returns
        -------
        index : (c,) ndarray of int
            Which points.
        distance : (c,) ndarray
            Negative inside.
        normal : (c, 3) ndarray
            Unit, outward.
        nearest : (c,) ndarray of int
            Nearest vertex.
        """
        index, nearest = np.empty(len(points), dtype=np.int64), np.empty(len(points), dtype=np.int64)
        bound = min(reach + self.edge, self.cell)
        count = _nearest_loop(points, which, self.vertices, self.cells, bound, index, nearest)
        index, nearest = index[:count], nearest[:count]
        distance, normal = np.empty(count), np.empty((count, 3))
        skin = Skin(self.vertices, self.normals, self.faces, self.start, self.ring)
        _distance_loop(points, index, nearest, skin, distance, normal)
        # Beyond a sharp rim the normals of its sides disagree: no point is deeper than the muscle is thick.
        near = (distance < reach) & (distance >= -self.deepest[nearest])
        # A folded triangle at a rim may give a point far outside a large depth.
        deep = np.flatnonzero(near & (distance < -FOLDED * self.edge))
        if len(deep):
            inside = np.empty(len(deep), dtype=np.bool_)
            wound_around(points[index[deep]], self.vertices, self.faces, inside)
            near[deep] = inside
        return index[near], distance[near], normal[near], nearest[near]


@compiled
def _fill_loop(vertices, cells):
    """Sort the vertices by cell."""
    box, cell, shape, first, members = cells
    where = np.empty(len(vertices), dtype=np.int64)
    for v in range(len(vertices)):
        c = 0
        for k in range(3):
            c = c * shape[k] + int((vertices[v, k] - box[0, k]) / cell)
        where[v] = c
        first[c + 1] += 1
    for c in range(len(first) - 1):
        first[c + 1] += first[c]
    filled = first[:-1].copy()
    for v in range(len(vertices)):
        members[filled[where[v]]] = v
        filled[where[v]] += 1


@compiled
def _nearest_loop(points, which, vertices, cells, bound, index, nearest):
    """Nearest vertex within ``bound``, at most a cell, of each selected point; return how many have one."""
    box, cell, shape, first, members = cells
    count = 0
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for p in range(len(points)):
        if not which[p]:
            continue
        outside = False
        for k in range(3):
            outside = outside or points[p, k] < box[0, k] - bound or points[p, k] > box[1, k] + bound
            c = int(np.floor((points[p, k] - box[0, k]) / cell))
            low[k], high[k] = max(c - 1, 0), min(c + 2, shape[k])
        if outside:
            continue
        least, best = bound * bound, -1
        for a in range(low[0], high[0]):
            for b in range(low[1], high[1]):
                row = (a * shape[1] + b) * shape[2]
                for m in range(first[row + low[2]], first[row + max(high[2], low[2])]):
                    v = members[m]
                    squared = 0.0
                    for k in range(3):
                        squared += (points[p, k] - vertices[v, k]) ** 2
                    if squared < least:
                        least, best = squared, v
        if best >= 0:
            index[count], nearest[count] = p, best
            count += 1
    return count


@compiled
def _distance_loop(points, index, nearest, skin, distance, normal):
    vertices, normals, faces, start, ring = skin
    weights, best, at, way, true = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for q in range(len(index)):
        p = index[q]
        least, face = np.inf, -1
        for r in range(start[nearest[q]], start[nearest[q] + 1]):
            f = ring[r]
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            nearest_weights(points[p], a, b, c, weights)
            squared = 0.0
            for k in range(3):
                here = points[p, k]
                for corner in range(3):
                    here -= weights[corner] * vertices[faces[f, corner], k]
                squared += here * here
                at[k] = here
            # The triangles that meet at the nearest point decide the side together.
            same = squared <= least * (1.0 + 1e-9) and squared >= least * (1.0 - 1e-9)
            if squared < least or same:
                if not same:
                    true[:] = 0.0
                _add_unit_normal(vertices, faces, f, true)
            if squared < least:
                least, face = squared, f
                best[:], way[:] = weights, at
        size, side, agree = 0.0, 0.0, 0.0
        for k in range(3):
            n = 0.0
            for corner in range(3):
                n += best[corner] * normals[faces[face, corner], k]
            normal[q, k] = n
            size += n * n
            side += true[k] * way[k]
            agree += n * way[k]
        length, size = np.sqrt(least), max(np.sqrt(size), 1e-300)
        sign = 1.0 if side >= 0.0 else -1.0
        # Around a rim normals vary fast: the direction from the nearest point is better.
        along = sign * agree < RIM * size * length
        for k in range(3):
            normal[q, k] = sign * way[k] / length if along else normal[q, k] / size
        distance[q] = sign * length


@compiled
def _add_unit_normal(vertices, faces, f, total):
    """Add the unit normal of a triangle."""
    x, y, z = triangle_normal(vertices, faces, f)
    size = max(np.sqrt(x * x + y * y + z * z), 1e-300)
    total[0] += x / size
    total[1] += y / size
    total[2] += z / size
