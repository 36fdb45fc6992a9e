"""The mesh that shows a muscle, with the field's value at rest.

The level set of some hundred centres departs from the scan by some tenths of a millimetre. So each
vertex X_i of the shown mesh keeps its place at rest and carries the value of the field there, its
level offset r_i = f_rest(X_i), with the material: what is shown is the surface f(x) - r(X) = s, at
rest the mesh itself.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.geometry.frames import RestFrame, principal_axes
from rbfmuscle.geometry.surfaces import (
    edge_lengths,
    face_normals,
    opposite_half_edges,
    vertex_normals,
)
from rbfmuscle.implicit.placement import cached_sample
from rbfmuscle.loops import loop
from rbfmuscle.scene.objects import Muscle

# Sweeps of smoothing for triangles that cross others at rest.
UNTANGLED = 24
# Cosine between the normals of two neighbours that lie on each other, which cross when they move;
# sweeps in which they are smoothed; and how far vertices may go for that, in mean edges: a scan's
# overlaps are small, and what is larger is the shape.
FOLDED = -np.sqrt(0.75)
UNFOLDED = 4
UNFOLD_WAY = 0.25
# Bounds on the vertices that are asked for by a resolution.
WANTED = (200, 12_000)
# Vertices of a triangulation on an area of one edge squared.
VERTICES_AN_EDGE = 1.15


def display_mesh(muscle: Muscle, resolution: int) -> tuple[Floats, Integers]:
    """Vertices (n, 3) and faces (m, 3) that show a muscle: its input mesh, or, with a
    ``resolution`` above 0, one on it with so many edges along the longest side.

    Triangles of a scan
    that lie on a neighbour are smoothed where that is a small change, and those that cross others
    until they do not, `UNTANGLED` times at most: what then crosses counts as ``self_crossings`` of
    every frame.
    """
    points, faces = _covering(muscle, resolution)
    tree, points = FaceTree(points, faces), points.copy()
    start, other = neighbour_lists(faces, len(points))
    _unfold(points, faces, start, other)
    for turn in range(UNTANGLED):
        crossing = tree.crossing(points)
        if not crossing.any():
            break
        marked = np.unique(faces[crossing])
        for _ in range(turn // 4):
            marked = np.unique(
                np.concatenate([marked, faces[np.isin(faces, marked).any(axis=1)].ravel()])
            )
        _smooth_loop(points, marked, start, other)
    return points, faces


def _unfold(points: Floats, faces: Integers, start: Integers, other: Integers) -> None:
    """Smooth, in place, triangles that lie folded on a neighbour, where that is a small change."""
    beside, smooth = opposite_half_edges(faces).reshape(-1, 3) // 3, points.copy()
    for _ in range(UNFOLDED):
        folded = _folded(smooth, faces, beside)
        if not folded.any():
            break
        _smooth_loop(smooth, np.unique(faces[folded]), start, other)
    way = np.linalg.norm(smooth - points, axis=1).max()
    if way < UNFOLD_WAY * edge_lengths(points, faces[:, :2]).mean():
        points[:] = smooth


def _folded(points: Floats, faces: Integers, beside: Integers) -> Booleans:
    """Which triangles (m,) are folded onto a neighbour, of those ``beside`` (m, 3) each, -1 for
    none.
    """
    normals = face_normals(points, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    cosine = np.einsum("mka,ma->mk", normals[beside], normals)
    folded: Booleans = ((cosine < FOLDED) & (beside >= 0)).any(axis=1)
    # Of a sharp rim both sides are seen from outside.
    along = np.einsum("mka,ma->mk", vertex_normals(points, faces)[faces], normals)
    folded &= (along < 0.0).any(axis=1)
    return folded


def _covering(muscle: Muscle, resolution: int) -> tuple[Floats, Integers]:
    """The input mesh, or with a resolution another one on it."""
    points = np.asarray(muscle.mesh.vertices, dtype=float)
    faces = np.ascontiguousarray(muscle.mesh.faces, dtype=np.int64)
    frame = RestFrame(points)
    if not resolution:
        # As the frame holds them, so that a scene that was moved is drawn alike to the last digit.
        return frame.points(frame.local), faces
    axes = principal_axes(points)
    edge = float(np.ptp(points @ axes.T, axis=0).max()) / resolution
    count = int(np.clip(VERTICES_AN_EDGE * float(muscle.mesh.area) / edge**2, *WANTED))
    sample = cached_sample(frame.local, faces, count, "adaptive")
    return frame.points(sample.points), np.ascontiguousarray(sample.control_faces, dtype=np.int64)


def neighbour_lists(faces: Integers, count: int) -> tuple[Integers, Integers]:
    """Neighbours of each of ``count`` vertices: those of vertex v are ``other[start[v] : start[v +
    1]]``.
    """
    ends = np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]])
    pairs = np.unique(np.concatenate([ends @ (count, 1), ends @ (1, count)]))
    return np.searchsorted(pairs, count * np.arange(count + 1)), pairs % count


@loop
def _smooth_loop(vertices, rows, start, other):
    """Half the way to the mean of the neighbours, one vertex after the other."""
    for v in rows:
        count = start[v + 1] - start[v]
        for a in range(3):
            total = 0.0
            for n in range(start[v], start[v + 1]):
                total += vertices[other[n], a]
            vertices[v, a] = 0.5 * (vertices[v, a] + total / count)
