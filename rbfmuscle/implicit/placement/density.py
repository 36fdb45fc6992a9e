"""How densely centres lie: evenly, more of them where the surface bends, or where a trial fit misses it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import face_normals, unique_edges, vertex_normals
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.clustering import cluster_mesh
from rbfmuscle.validation import MeshError

if TYPE_CHECKING:
    from rbfmuscle.implicit.placement.clustering import FineMesh
    from rbfmuscle.implicit.placement.sampling import SurfaceSample


# Densities stay within this ratio, so that no part of the surface is left without centres that carry it.
LARGEST_DENSITY = 30.0
GREEDY_ROUNDS = 10
# Centres beyond which a round costs seconds: more of them follow the curvature alone.
GREEDY_LARGEST = 1000


def curvature_density(fine: FineMesh, count: int) -> Floats:
    """Density of centres from how much the surface bends across one cell.

    The mean squared turn of the normal along edges, per length squared, smoothed over a cell: it is the sum
    of the squared principal curvatures up to a factor. The density is 1 + 4 (curvature x cell size)^2, so
    that flat parts keep their even cover.

    Parameters
    ----------
    fine : FineMesh
    count : int

    Returns
    -------
    (n,) ndarray
        At the fine mesh's vertices, 1 or more.
    """
    area = np.linalg.norm(face_normals(fine.vertices, fine.faces), axis=1)
    normals = vertex_normals(fine.vertices, fine.faces)
    i, j = unique_edges(fine.faces).T
    length = np.linalg.norm(fine.vertices[i] - fine.vertices[j], axis=1)
    turn = ((normals[i] - normals[j]) ** 2).sum(axis=1)
    size = len(fine.vertices)
    square = _edge_sum(i, j, turn, size) / np.maximum(_edge_sum(i, j, length**2, size), np.finfo(float).tiny)
    cell = area.sum() / count
    density = 1 + 4 * cell * square
    rounds = int(np.ceil(0.25 * cell / np.mean(length) ** 2))
    valence = np.maximum(_edge_sum(i, j, np.ones(len(i)), size), 1)
    for _ in range(rounds):
        density = (
            0.5 * density
            + 0.5 * (np.bincount(i, density[j], size) + np.bincount(j, density[i], size)) / valence
        )
    return np.clip(density, 1, LARGEST_DENSITY)


def _edge_sum(i: Integers, j: Integers, values: Floats, size: int) -> Floats:
    return np.asarray(np.bincount(i, values, size) + np.bincount(j, values, size), dtype=np.float64)


def greedy_sample(
    fine: FineMesh, count: int, seed: int, gather: Callable[[Integers, Integers], SurfaceSample]
) -> SurfaceSample:
    """Cells made smaller, round by round, where a cubic Hermite fit misses the mesh.

    Each round fits the field to the centres, takes |f| at the mesh's vertices as the distance missed, and
    raises the density of a cell by how much worse it is than the rest. Of all rounds, that with the smallest
    sum of root mean square and a fifth of the largest miss is returned.

    Parameters
    ----------
    fine : FineMesh
    count, seed : int
    gather : callable
        ``(labels, control) -> SurfaceSample``.

    Returns
    -------
    SurfaceSample
    """
    if count > GREEDY_LARGEST:
        return gather(*cluster_mesh(fine, curvature_density(fine, count), count, seed))
    best: SurfaceSample | None = None
    least = np.inf
    for density in (np.ones(len(fine.vertices)), curvature_density(fine, count)):
        for _ in range(GREEDY_ROUNDS // 2):
            labels, control = cluster_mesh(fine, density, count, seed)
            sample = gather(labels, control)
            miss = np.abs(RBFField.fit_hermite(sample.points, sample.normals)(fine.vertices))
            rms = np.sqrt((miss**2).mean())
            if rms + 0.2 * miss.max() < least:
                best, least = sample, rms + 0.2 * miss.max()
            worst = np.zeros(count)
            np.maximum.at(worst, labels, miss)
            factor = np.clip(worst / (3 * rms), 0.7, 2.5)
            np.clip(density * factor[labels], 1, LARGEST_DENSITY, out=density)
    if best is None:
        raise MeshError(
            "no field fits centres placed on this mesh: every fit was NaN; try placement = 'even'"
        )
    return best
