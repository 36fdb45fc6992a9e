"""A mesh muscle on its way to rest, among those that it touches: a sweep in each iteration.

A contact with a neighbour is a constraint as others of PBD are: it moves a vertex by its inverse
mass, and the corners of the triangle that it meets by theirs. The neighbour's signed distance is
that to its mesh as it moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import nearest_weights
from rbfmuscle.geometry.frames import cross, divided, dot, minus, plus, row_of
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.geometry.mesh_distance import HERE, Columns
from rbfmuscle.geometry.surfaces import farthest_move, touching_balls, vertex_normals
from rbfmuscle.loops import loop
from rbfmuscle.simulation.touching import NOTHING, Wanted

# Greatest thickness of a muscle, relative to rest.
DEEPER = 1.5
# Least cosine between the surface normal and the direction to a point for which the normal is used.
RIM = 0.7
# Depth, in mean edges, beyond which a point is inside only where its winding number says so.
FOLDED = 0.3


class MovingSurface:
    """Signed distance to a mesh whose vertices move, for points near it.

    The nearest point of the surface lies in one of the triangles around the nearest vertex, up to
    the square of an edge over the radius of curvature. Directions are interpolated vertex normals,
    or, around a rim, the direction to the point. The sign is that of the triangles that meet at the
    nearest point.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        At rest.
    faces : (m, 3) ndarray
    reach : float
        Greatest distance that will be asked for [scene unit].

    Attributes
    ----------
    vertices : (n, 3) ndarray
    deepest : (n,) ndarray
        How deep a point whose nearest vertex is this one may be.
    """

    def __init__(self, vertices: Floats, faces: Integers, reach: float) -> None:
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        corner = self.faces.ravel()
        order = np.argsort(corner, kind="stable")
        self.ring = order // 3
        self.start = np.searchsorted(corner[order], np.arange(len(vertices) + 1))
        sides = vertices[self.faces] - vertices[np.roll(self.faces, 1, axis=1)]
        self.edge = float(np.linalg.norm(sides, axis=2).mean())
        self.reach = float(reach)
        rest, balls = np.ascontiguousarray(vertices, dtype=np.float64), np.empty((2, len(vertices)))
        touching_balls(rest, vertex_normals(rest, self.faces), balls, np.empty(len(rest)))
        self.deepest = DEEPER * np.minimum(balls[1], self.reach) + self.edge
        self.move(rest)

    def move(self, vertices: Floats) -> None:
        """Take the present vertices (n, 3)."""
        self.vertices = vertices
        self.normals = vertex_normals(vertices, self.faces)

    def ask(
        self, points: Floats, nearest: Integers, columns: Integers, shares: Floats, normal: Floats
    ) -> Floats:
        """Distances (n,) of points (n, 3), negative inside, infinite beyond the reach.

        ``nearest`` (n,) are vertices from which the nearest ones are found over edges, and which
        these replace. The corners of the triangle that is nearest, and their shares, are filled
        into ``columns`` and ``shares`` (n, 3), the outward normals into ``normal`` (n, 3).
        """
        skin = self.vertices, self.faces, self.start, self.ring
        away, distance = np.empty(len(points)), np.empty(len(points))
        _walk_loop(points, skin, nearest, away)
        _distance_loop(points, nearest, skin, self.normals, columns, shares, distance, normal)
        # Beyond a sharp rim the normals of its sides disagree: no point is deeper than the muscle
        # is thick.
        distance[(away > self.reach + self.edge) | (distance < -self.deepest[nearest])] = np.inf
        # A folded triangle at a rim may give a point far outside a large depth.
        deep = np.flatnonzero(distance < -FOLDED * self.edge)
        if len(deep):
            inside = Columns(self.vertices, self.faces).inside(points[deep], HERE)
            distance[deep[~inside]] = np.inf
        return distance


@loop
def _walk_loop(points, skin, nearest, away):
    """From vertices over edges to the nearest ones, and how far away these are.

    The ``skin`` is vertices, faces, and the faces around vertex v, ring[start[v] : start[v + 1]].
    """
    vertices, faces, start, ring = skin
    for q in range(len(points)):
        at = row_of(points, q)
        here = nearest[q]
        least = np.inf
        last = -1
        while here != last:
            last = here
            for r in range(start[last], start[last + 1]):
                for corner in range(3):
                    v = faces[ring[r], corner]
                    way = minus(row_of(vertices, v), at)
                    square = dot(way, way)
                    if square < least:
                        least, here = square, v
        nearest[q], away[q] = here, np.sqrt(least)


@loop
def _distance_loop(points, nearest, skin, normals, columns, shares, distance, normal):
    """Fill distances, normals and the corners and shares of the nearest places."""
    for q in range(len(points)):
        least, face, weights, way, true = _find_foot(row_of(points, q), nearest[q], skin)
        one, two, three = row_of(skin[1], face)
        columns[q, 0] = one
        columns[q, 1] = two
        columns[q, 2] = three
        for k in range(3):
            shares[q, k] = weights[k]
            normal[q, k] = (
                weights[0] * normals[one, k]
                + weights[1] * normals[two, k]
                + weights[2] * normals[three, k]
            )
        mean = row_of(normal, q)
        length, size = np.sqrt(least), max(np.sqrt(dot(mean, mean)), 1e-300)
        sign = 1.0 if dot(true, way) >= 0.0 else -1.0
        # Around a rim normals vary fast: the direction from the nearest point is better.
        along = sign * dot(mean, way) < RIM * size * length
        for k in range(3):
            normal[q, k] = sign * way[k] / length if along else mean[k] / size
        distance[q] = sign * length


@loop
def _find_foot(point, vertex, skin):
    """The place nearest to a point on the triangles about a vertex: its squared distance, its
    triangle, the weights of the corners of this, the way from there to the point, and the sum of
    the unit normals of the triangles that meet there.
    """
    vertices, faces, start, ring = skin
    least, face = np.inf, -1
    best = 0.0, 0.0, 0.0
    way = 0.0, 0.0, 0.0
    true = 0.0, 0.0, 0.0
    for r in range(start[vertex], start[vertex + 1]):
        f = ring[r]
        a = row_of(vertices, faces[f, 0])
        b = row_of(vertices, faces[f, 1])
        c = row_of(vertices, faces[f, 2])
        weights = nearest_weights(point, a, b, c)
        here = (
            point[0] - weights[0] * a[0] - weights[1] * b[0] - weights[2] * c[0],
            point[1] - weights[0] * a[1] - weights[1] * b[1] - weights[2] * c[1],
            point[2] - weights[0] * a[2] - weights[1] * b[2] - weights[2] * c[2],
        )
        squared = dot(here, here)
        # The triangles that meet at the nearest point decide the side together.
        same = squared <= least * (1.0 + 1e-9) and squared >= least * (1.0 - 1e-9)
        if squared < least or same:
            outward = cross(minus(b, a), minus(c, a))
            outward = divided(outward, max(np.sqrt(dot(outward, outward)), 1e-300))
            true = plus(true, outward) if same else outward
        if squared < least:
            least, face = squared, f
            best = weights
            way = here
    return least, face, best, way, true


class MeshRows(NamedTuple):
    """What unit forces at w contacts do to n vertices."""

    places: Embedding
    normal: Floats  # (w, 3)
    inverse_mass: Floats  # (n,)
    delassus: Floats  # (w, w)

    def motion(self, force: Floats) -> Floats:
        """Motion (n, 3) of the vertices by contact forces (w,)."""
        out = np.zeros((len(self.inverse_mass), 3))
        columns, shares = self.places
        along = shares[:, :, None] * (force[:, None] * self.normal)[:, None]
        np.add.at(out, columns, along)
        return out * self.inverse_mass[:, None]


class MeshSettling:
    """One mesh muscle on its way to rest; implements ``rbfmuscle.simulation.touching.Moving``.

    ``points`` (n, 3) are moved in place, by ``sweep``, which is called with the number of each
    sweep: ``most`` times, or until no vertex moves by as much as ``still`` [scene unit].
    ``surface`` is what others meet, None where none do.
    """

    def __init__(
        self,
        points: Floats,
        inverse_mass: Floats,
        size: float,
        sweep: Callable[[int], None],
        *,
        most: int,
        still: float = 0.0,
        surface: MovingSurface | None = None,
    ) -> None:
        self.size = size
        self.nodes = points
        self.step = np.zeros_like(points)
        self.asleep = False
        self.forces_capped = False
        self.iterations = 0
        self.moved = np.inf
        self.inverse_mass = inverse_mass
        self.sweep = sweep
        self.most = most
        self.still = still
        self.surface = surface

    def free_step(self) -> None:
        """One sweep, with bones and the volume; none where it sleeps."""
        if self.asleep:
            self.step[:] = 0.0
            return
        before = self.nodes.copy()
        self.sweep(self.iterations)
        self.step = self.nodes - before
        self.nodes[:] = before

    def meet(self) -> Wanted:
        """Nothing: a sweep meets bones itself."""
        return NOTHING

    def feet_of(self, points: Integers) -> Embedding:
        """Vertices (w,), each alone."""
        return Embedding(
            points[:, None].repeat(3, axis=1), np.tile([1.0, 0.0, 0.0], (len(points), 1))
        )

    def rows_of(self, points: Integers, normal: Floats, feet: Embedding | None) -> MeshRows:
        """What unit forces along ``normal`` (w, 3) at vertices, and behind them at ``feet``, do."""
        columns, shares = self.feet_of(points)
        if feet is not None:
            columns = np.concatenate([columns, feet.columns])
            shares = np.concatenate([shares, feet.shares])
        # Only the vertices that are met matter.
        met, place = np.unique(columns, return_inverse=True)
        dense = np.zeros((len(columns), len(met)))
        np.add.at(dense, (np.arange(len(columns))[:, None], place.reshape(columns.shape)), shares)
        delassus = (normal @ normal.T) * (dense * self.inverse_mass[met] @ dense.T)
        return MeshRows(Embedding(columns, shares), normal, self.inverse_mass, delassus)

    def push(self, motion: Floats | None, rows: MeshRows, force: Floats, asked: Wanted) -> None:
        """Add the motion (n, 3) by contact forces to the step."""
        if motion is not None:
            self.step += motion

    def advance(self) -> None:
        """Take the step; asleep after the last sweep, or one that moved nothing any more."""
        if self.asleep:
            return
        before = self.nodes.copy()
        self.nodes += self.step
        self.iterations += 1
        self.moved = farthest_move(before, self.nodes)
        if self.surface is not None:
            self.surface.move(self.nodes)
        self.asleep = self.moved < self.still or self.iterations >= self.most

    def ask(self, points: Floats, place: Integers) -> tuple[Floats, Floats, Embedding]:
        """Gaps (k,) of points (k, 3) to this muscle, their normals (k, 3) and feet; the search
        begins at vertices ``place`` (k,), which are brought up to date.
        """
        assert self.surface is not None
        count = len(points)
        normal = np.empty((count, 3))
        feet = Embedding(np.empty((count, 3), dtype=np.int64), np.empty((count, 3)))
        gap = self.surface.ask(points, place, *feet, normal)
        return gap, normal, feet

    def contact_law(self, points: Integers, area: Floats) -> tuple[Floats, Floats]:
        """No greatest force, and hard contacts."""
        return np.full(len(points), np.inf), np.zeros(len(points))
