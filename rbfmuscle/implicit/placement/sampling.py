"""Centres on a closed mesh: even cover, normals, areas, and the control triangulation over them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry import surfaces
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import nearest_weights
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.clustering import FineMesh, cluster_mesh, refine_mesh
from rbfmuscle.loops import loop
from rbfmuscle.validation import MeshError, check_mesh

# Densities stay within this ratio, so that no part of the surface is left without centres that
# carry it.
LARGEST_DENSITY = 30.0
# Trial fits of greedy placement, and centres beyond which they cost seconds: more of them follow
# the curvature alone.
GREEDY_ROUNDS, GREEDY_LARGEST = 5, 1000
# Weight of the cell's mean normal beside the normal at its point: 0 lets rims bulge, more blunts
# them.
CELL_SHARE = 0.5
PLACEMENTS = ("even", "adaptive", "greedy")


@dataclass(frozen=True)
class SurfaceSample:
    """Points (K, 3) [scene unit] on a closed mesh, unit outward normals, a closed, outward
    triangulation of them.
    """

    points: np.ndarray
    normals: np.ndarray
    control_faces: np.ndarray


def sample_surface(
    vertices: ArrayLike, faces: ArrayLike, count: int, *, seed: int = 0, placement: str = "adaptive"
) -> SurfaceSample:
    """Cover a closed, outward mesh (vertices (n, 3) [scene unit], faces (m, 3)) with ``count``
    points.

    The mesh is split into ``count`` connected cells of equal size (farthest points by distance
    along the surface, then clustering as in Valette & Chassery 2004); each cell gives one point.
    Cells never reach through a thin sheet, as distance and connection are those of the surface.
    ``count`` is at least 4 for each connected component; ``seed`` chooses the first point, the rest
    follows.

    ``placement`` is "even" (cells of equal size), "adaptive" (smaller where the surface bends) or
    "greedy" (smaller where a cubic Hermite fit misses the mesh: the most accurate, at 0.1 to 0.5 s;
    beyond 1000 points as adaptive). MeshError if the mesh is not a closed 2-manifold, or its
    topology needs more points; ValueError if ``count`` or ``placement`` is not allowed.
    """
    vertices, faces = check_mesh(vertices, faces)
    count = int(count)
    if count < 4:
        raise ValueError(f"count must be at least 4, got {count}")
    if placement not in PLACEMENTS:
        raise ValueError(f"placement must be one of {', '.join(PLACEMENTS)}, got {placement!r}")
    if (surfaces.opposite_half_edges(faces) < 0).any():
        raise MeshError("mesh must be a closed, consistently oriented 2-manifold; repair it first")
    fine = refine_mesh(*surfaces.split_pinched_vertices(vertices, faces), count)
    if placement == "greedy" and count <= GREEDY_LARGEST:
        return _greedy_sample(fine, count, seed)
    density = np.ones(len(fine.vertices)) if placement == "even" else curvature_density(fine, count)
    return _gather(fine, count, *cluster_mesh(fine, density, count, seed))


def _greedy_sample(fine: FineMesh, count: int, seed: int) -> SurfaceSample:
    """Cells made smaller, round by round, where a cubic Hermite fit misses the mesh.

    The first cells are those of `curvature_density`; each round raises the density of a cell by how
    much worse |f| at the mesh's vertices is there than elsewhere. Of all rounds, that with the
    smallest sum of root mean square and a fifth of the largest miss is returned.
    """
    best: SurfaceSample | None = None
    least = np.inf
    density = curvature_density(fine, count)
    for _ in range(GREEDY_ROUNDS):
        labels, control = cluster_mesh(fine, density, count, seed)
        sample = _gather(fine, count, labels, control)
        miss = np.abs(RBFField.fit_hermite(sample.points, sample.normals)(fine.vertices))
        rms = np.sqrt((miss**2).mean())
        if rms + 0.2 * miss.max() < least:
            best, least = sample, rms + 0.2 * miss.max()
        worst = np.zeros(count)
        np.maximum.at(worst, labels, miss)
        factor = np.clip(worst / (3 * rms), 0.7, 2.5)
        density = np.clip(density * factor[labels], 1, LARGEST_DENSITY)
    if best is None:
        raise MeshError(
            "no field fits centres on this mesh: every fit was NaN; try placement = 'even'"
        )
    return best


def curvature_density(fine: FineMesh, count: int) -> Floats:
    """Density of centres at the fine mesh's vertices (n,), 1 or more: how much the surface bends
    across one cell.

    The mean squared turn of the normal along edges, per length squared, smoothed over a cell: it is
    the sum of the squared principal curvatures up to a factor. The density is 1 + 4 (curvature x
    cell size)^2, so that flat parts keep their even cover.
    """
    area = np.linalg.norm(surfaces.face_normals(fine.vertices, fine.faces), axis=1)
    normals = surfaces.vertex_normals(fine.vertices, fine.faces)
    i, j = fine.edges.T
    length = np.linalg.norm(fine.vertices[i] - fine.vertices[j], axis=1)
    turn = ((normals[i] - normals[j]) ** 2).sum(axis=1)
    size = len(fine.vertices)
    square = _edge_sum(i, j, turn, size) / np.maximum(
        _edge_sum(i, j, length**2, size), np.finfo(float).tiny
    )
    cell = area.sum() / count
    density = 1 + 4 * cell * square
    rounds = int(np.ceil(0.25 * cell / np.mean(length) ** 2))
    valence = np.maximum(_edge_sum(i, j, np.ones(len(i)), size), 1)
    for _ in range(rounds):
        beside = np.bincount(i, density[j], size) + np.bincount(j, density[i], size)
        density = 0.5 * density + 0.5 * beside / valence
    return np.clip(density, 1, LARGEST_DENSITY)


def _edge_sum(i: Integers, j: Integers, values: Floats, size: int) -> Floats:
    return np.asarray(np.bincount(i, values, size) + np.bincount(j, values, size), dtype=np.float64)


def spread_points(
    vertices: Floats, faces: Integers, count: int, *, seed: int = 0
) -> tuple[Floats, Integers]:
    """Points (count, 3) on a mesh, one in each strip of equal area, and the triangle (count,) that
    holds each.
    """
    vertices, faces = check_mesh(vertices, faces)
    rng = np.random.default_rng(seed)
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    strip = (np.arange(count) + rng.uniform(size=count)) / count
    which = np.searchsorted(np.cumsum(area) / area.sum(), strip).clip(max=len(faces) - 1)
    return np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), count), corners[which]), which


def _gather(fine: FineMesh, count: int, labels: Integers, control: Integers) -> SurfaceSample:
    """Points and normals of the cells."""
    third = np.linalg.norm(surfaces.face_normals(fine.vertices, fine.faces), axis=1) / 3
    corner = labels[fine.faces]
    areas = np.bincount(corner.ravel(), np.repeat(third, 3), count)
    middle = fine.vertices[fine.faces].mean(axis=1)
    moments = [
        np.bincount(corner.ravel(), np.repeat(third * middle[:, k], 3), count) for k in range(3)
    ]
    centroid = np.stack(moments, axis=1) / np.maximum(areas, np.finfo(float).tiny)[:, None]
    # The nearest point of the cell itself, not of the mesh: that could lie on the other side of a
    # thin sheet.
    points = np.zeros((count, 3))
    piece = np.zeros(count, dtype=np.int64)
    distance = np.full(count, np.inf)
    _nearest_in_cell_loop(fine.vertices, fine.faces, corner, centroid, points, piece, distance)
    for k in np.flatnonzero(
        np.isinf(distance)
    ):  # a cell without a triangle of its own gives a vertex
        places = np.flatnonzero(corner == k)
        its = fine.vertices[fine.faces.ravel()[places]]
        nearest = int(np.argmin(((its - centroid[k]) ** 2).sum(axis=1)))
        points[k], piece[k] = its[nearest], places[nearest] // 3
    normals = _normals_at(fine, points, piece, corner)
    return SurfaceSample(points, normals, control)


def _normals_at(fine: FineMesh, points: Floats, piece: Integers, corner: Integers) -> Floats:
    """Normals in triangles ``piece``, drawn towards the mean of each point's cell."""
    corners = fine.faces[piece]
    weights = surfaces.barycentric_weights(points, fine.vertices[corners])
    here = np.einsum(
        "kc,kcd->kd", weights, surfaces.vertex_normals(fine.vertices, fine.faces)[corners]
    )
    vectors = surfaces.face_normals(fine.vertices, fine.faces)
    sums = [np.bincount(corner.ravel(), np.repeat(vectors[:, k], 3), len(points)) for k in range(3)]
    mean: Floats = np.stack(sums, axis=1).astype(np.float64)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), np.finfo(float).tiny)[:, None]
    normals = here + CELL_SHARE * mean
    cancelled = np.linalg.norm(normals, axis=1) < 1e-6
    normals[cancelled] = vectors[piece[cancelled]]
    return normals / np.linalg.norm(normals, axis=1)[:, None]


@loop
def _nearest_in_cell_loop(vertices, faces, corner, target, points, face, distance):
    """Point nearest to target[k] of the triangles wholly in cell k: at a thin rim two would else
    take the same.
    """
    q, share = np.empty(3), np.empty(3)
    for f in range(len(faces)):
        k = corner[f, 0]
        if corner[f, 1] != k or corner[f, 2] != k:
            continue
        a = vertices[faces[f, 0]]
        b = vertices[faces[f, 1]]
        d = vertices[faces[f, 2]]
        nearest_weights(target[k], a, b, d, share)
        square = 0.0
        for c in range(3):
            q[c] = a[c] + share[1] * (b[c] - a[c]) + share[2] * (d[c] - a[c])
            square += (target[k, c] - q[c]) ** 2
        if square < distance[k]:
            distance[k] = square
            face[k] = f
            for c in range(3):
                points[k, c] = q[c]
