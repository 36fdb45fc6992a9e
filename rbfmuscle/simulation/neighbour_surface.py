"""Signed distance to a moving muscle's material mesh, for its neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import touching_balls, vertex_normals
from rbfmuscle.geometry.triangles import nearest_weights, triangle_normal
from rbfmuscle.geometry.winding import winding_loop
from rbfmuscle.loops import loop

if TYPE_CHECKING:
    from rbfmuscle.simulation.frame import Mesh, MuscleModel

# Index, distance, outward normal and nearest vertex of the points that are near a surface.
Found = tuple[Integers, Floats, Floats, Integers]
# Share of a muscle's last corrections that is expected again, and that of the earlier ones in their
# mean. With all of the last one alone neighbours that push each other oscillate; with none they
# answer to a surface that lies a millimetre or two from the equilibrium, and may pass each other.
MOMENTUM, MEMORY = 0.75, 0.5
# Greatest thickness of a muscle, relative to rest.
DEEPER = 1.5
# Least cosine between the surface normal and the direction to a point for which the normal is used.
RIM = 0.7
# Depth, in mean edges, beyond which a point is inside only where its winding number says so.
FOLDED = 0.3


class Skin(NamedTuple):
    """Vertices, their normals, faces, and the faces around vertex v, ring[start[v] : start[v
    + 1]].
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    ring: np.ndarray


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
    box : (2, 3) ndarray
        About the surface.
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
        self.box = np.array([vertices.min(axis=0), vertices.max(axis=0)])
        self._tree: cKDTree | None = None

    def nearest(self, points: Floats, reach: float) -> Integers:
        """Nearest vertex (n,) of points (n, 3); as many as there are vertices where none is within
        ``reach``.
        """
        found, near = (
            np.full(len(points), len(self.vertices)),
            np.flatnonzero(self.boxed(points, reach)),
        )
        if len(near):
            if self._tree is None:
                self._tree = cKDTree(self.vertices, balanced_tree=False, compact_nodes=False)
            found[near] = self._tree.query(points[near], distance_upper_bound=reach)[1]
        return found

    def boxed(self, points: Floats, reach: float) -> Booleans:
        """Whether points (n, 3) are within ``reach`` of the box about the surface."""
        (low, high), near = (
            (self.box[0] - reach, self.box[1] + reach),
            np.ones(len(points), dtype=np.bool_),
        )
        for a in range(3):
            near &= (points[:, a] > low[a]) & (points[:, a] < high[a])
        return near

    def query(self, points: Floats, reach: Floats | float, start: Integers | None = None) -> Found:
        """Distances of those points that are nearer than ``reach``.

        Parameters
        ----------
        points : (n, 3) ndarray
        reach : float or (n,) ndarray
        start : (n,) ndarray of int, optional
            Vertices that were `nearest` not long ago, from which the nearest now is found over
            edges.

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
        reach = np.broadcast_to(reach, len(points))
        if start is None:
            start = self.nearest(points, min(float(reach.max(initial=0.0)), self.reach) + self.edge)
        skin = Skin(self.vertices, self.normals, self.faces, self.start, self.ring)
        index = np.flatnonzero(start < len(self.vertices))
        nearest, away = start[index], np.empty(len(index))
        _walk_loop(points, index, skin, nearest, away)
        near = away < reach[index] + self.edge
        index, nearest = index[near], nearest[near]
        distance, normal = np.empty(len(index)), np.empty((len(index), 3))
        _distance_loop(points, index, nearest, skin, distance, normal)
        # Beyond a sharp rim the normals of its sides disagree: no point is deeper than the muscle
        # is thick.
        near = (distance < reach[index]) & (distance >= -self.deepest[nearest])
        # A folded triangle at a rim may give a point far outside a large depth.
        deep = np.flatnonzero(near & (distance < -FOLDED * self.edge))
        if len(deep):
            winding = np.empty(len(deep))
            winding_loop(self.vertices, self.faces, points[index[deep]], winding)
            near[deep] = winding > 0.5
        return index[near], distance[near], normal[near], nearest[near]


class NeighbourState(NamedTuple):
    """What a `NeighbourSurface` keeps from sub-step to sub-step; nothing is changed in place."""

    change: dict[str, float]  # of the coordinates in the last sub-step
    # Mean of how far solves moved contact points and vertices; empty before the first.
    correction: list[Floats]


class NeighbourSurface(MovingSurface):
    """Signed distance to a model's material mesh, and to the mesh that shows it.

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
    fixed : (n,) ndarray of bool
        Vertices that a bone holds.
    contact : (n,) ndarray of int
        Contact point that a vertex is, or is nearest to.
    reach_box : (2, 3) ndarray
        About the model's contact points.
    shown : MovingSurface
        The mesh that is shown, where the material takes it.
    """

    def __init__(self, model: MuscleModel, reach: float) -> None:
        self.model = model
        super().__init__(*model.material_mesh(), reach)
        self.shown: MovingSurface = self
        self.contact = cKDTree(model.contact_points()).query(self.vertices)[1]
        self.fixed = np.asarray(model.attached_bone)[self.contact] >= 0
        self.state = NeighbourState({}, [])
        self.refresh()

    def snapshot(self) -> tuple[NeighbourState, MovingSurface, Floats]:
        """The state and the surface that is shown, for :meth:`restore`."""
        return self.state, self.shown, self.shown.vertices

    def restore(self, state: tuple[NeighbourState, MovingSurface, Floats]) -> None:
        """Return to a snapshot; the model has."""
        self.state, self.shown, vertices = state
        self.refresh()
        if self.shown is not self:
            self.shown.move(vertices)

    def show(self, mesh: Mesh) -> None:
        """Take the vertices and faces of the mesh that is shown."""
        if self.shown is self:
            self.shown = MovingSurface(*mesh, self.reach)
        else:
            self.shown.move(mesh[0])

    def refresh(self, *path: Mapping[str, float]) -> None:
        """Update from the model's present state.

        For a path from coordinates to others the prediction is extrapolated by the last
        corrections.
        """
        self._predicted, correction = self._present(), self.state.correction
        share = MOMENTUM * self._share(_change(*path)) if path and correction else 0.0
        ahead = [here + share * moved for here, moved in zip(self._predicted, correction)]
        self.points, vertices = map(np.ascontiguousarray, ahead if share else self._predicted)
        self.move(vertices)
        #: Box of the contact points.
        self.reach_box = np.array([self.points.min(axis=0), self.points.max(axis=0)])

    def learn(self, *path: Mapping[str, float]) -> None:
        """Record how far the solve moved the model from its prediction, for a path from coordinates
        to others.
        """
        change = _change(*path)
        found = [solved - predicted for solved, predicted in zip(self._present(), self._predicted)]
        if self.state.correction:
            old = MEMORY * self._share(change)
            found = [
                (1.0 - MEMORY) * new + old * before
                for new, before in zip(found, self.state.correction)
            ]
        self.state = NeighbourState(change, found)

    def _present(self) -> list[Floats]:
        """Contact points and vertices now."""
        return [np.array(self.model.contact_points()), np.array(self.model.material_mesh()[0])]

    def _share(self, change: dict[str, float]) -> float:
        """Share of the last correction in another change of coordinates: 1 for the same, 0 across
        or back.
        """
        last = self.state.change
        square = sum(value**2 for value in last.values())
        along = sum(value * last.get(name, 0.0) for name, value in change.items())
        return min(max(along / square, 0.0), 1.0) if square else 0.0

    def apart(self, other: NeighbourSurface, reach: float) -> bool:
        """Whether no point of the other muscle can be nearer than ``reach`` to this surface, by
        their boxes.
        """
        return bool(
            np.any(other.reach_box[0] > self.box[1] + reach)
            or np.any(other.reach_box[1] < self.box[0] - reach)
        )

    def is_near(self, other: NeighbourSurface, reach: float) -> bool:
        """Whether a contact point of the other muscle is nearer than ``reach`` to this surface."""
        if self.apart(other, reach):
            return False
        return len(self.query(other.points, reach)[0]) > 0


def _change(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Change of each coordinate."""
    return {name: value - before.get(name, 0.0) for name, value in after.items()}


@loop
def _walk_loop(points, index, skin, nearest, away):
    """From vertices over edges to the nearest ones, and how far away these are."""
    vertices, _, faces, start, ring = skin
    for q in range(len(index)):
        here = nearest[q]
        least = np.inf
        last = -1
        while here != last:
            last = here
            for r in range(start[last], start[last + 1]):
                for corner in range(3):
                    v, square = faces[ring[r], corner], 0.0
                    for k in range(3):
                        square += (vertices[v, k] - points[index[q], k]) ** 2
                    if square < least:
                        least, here = square, v
        nearest[q], away[q] = here, np.sqrt(least)


class _Foot(NamedTuple):
    """The place of a surface that is nearest to a point."""

    weights: np.ndarray  # (3,) of the corners of its triangle
    way: np.ndarray  # (3,) from there to the point
    true: np.ndarray  # (3,) sum of the unit normals of the triangles that meet there


@loop
def _distance_loop(points, index, nearest, skin, distance, normal):
    foot = _Foot(np.empty(3), np.empty(3), np.empty(3))
    at, weights = np.empty(3), np.empty(3)
    for q in range(len(index)):
        least, face = _find_foot(points[index[q]], nearest[q], skin, weights, at, foot)
        size = 0.0
        side = 0.0
        agree = 0.0
        for k in range(3):
            n = 0.0
            for corner in range(3):
                n += foot.weights[corner] * skin[1][skin[2][face, corner], k]
            normal[q, k] = n
            size += n * n
            side += foot.true[k] * foot.way[k]
            agree += n * foot.way[k]
        length, size = np.sqrt(least), max(np.sqrt(size), 1e-300)
        sign = 1.0 if side >= 0.0 else -1.0
        # Around a rim normals vary fast: the direction from the nearest point is better.
        along = sign * agree < RIM * size * length
        for k in range(3):
            normal[q, k] = sign * foot.way[k] / length if along else normal[q, k] / size
        distance[q] = sign * length


@loop()
def _find_foot(point, vertex, skin, weights, at, foot):
    """Squared distance of a point from the triangles about a vertex, and the nearest of these;
    fills the foot. ``weights`` and ``at`` (3,) are room for those of one triangle.
    """
    vertices, _, faces, start, ring = skin
    least, face = np.inf, -1
    for r in range(start[vertex], start[vertex + 1]):
        f = ring[r]
        nearest_weights(
            point, vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]], weights
        )
        squared = 0.0
        for k in range(3):
            here = point[k]
            for corner in range(3):
                here -= weights[corner] * vertices[faces[f, corner], k]
            squared += here * here
            at[k] = here
        # The triangles that meet at the nearest point decide the side together.
        same = squared <= least * (1.0 + 1e-9) and squared >= least * (1.0 - 1e-9)
        if squared < least or same:
            if not same:
                foot.true[:] = 0.0
            _add_unit_normal(vertices, faces, f, foot.true)
        if squared < least:
            least, face = squared, f
            foot.weights[:], foot.way[:] = weights, at
    return least, face


@loop
def _add_unit_normal(vertices, faces, f, total):
    """Add the unit normal of a triangle."""
    x, y, z = triangle_normal(vertices, faces, f)
    size = max(np.sqrt(x * x + y * y + z * z), 1e-300)
    total[0] += x / size
    total[1] += y / size
    total[2] += z / size
