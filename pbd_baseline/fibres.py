"""Which way fibres run at an edge, how soft that makes it, and how thick the muscle is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.harmonic import cotangent_laplacian

# Pieces of polyline that speak for one place.
NEAREST = 6


def fibre_directions(
    points: np.ndarray, along: np.ndarray, fibres: Sequence[np.ndarray] | None
) -> np.ndarray:
    """Unit direction of the fibres at each point.

    Parameters
    ----------
    points : (n, 3) ndarray
    along : (n, 3) ndarray
        Gradient of the last bone's harmonic weight: the fibres follow it where none are given.
    fibres : list of (k, 3) ndarray, or None
        Polylines.

    Returns
    -------
    (n, 3) ndarray
        Zero where no direction can be told.
    """
    if not fibres:
        return _normalised(along)
    middles = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
    tangents = _normalised(np.concatenate([np.diff(line, axis=0) for line in fibres]))
    count = min(NEAREST, len(middles))
    distance, index = cKDTree(middles).query(points, k=count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    nearest = tangents[index[:, :1]]
    signs = np.sign(np.einsum("nkd,nkd->nk", tangents[index], np.broadcast_to(nearest, (*index.shape, 3))))
    share = signs / np.maximum(distance, 1e-9 * np.ptp(points, axis=0).max()) ** 2
    return _normalised(np.einsum("nk,nkd->nd", share, tangents[index]))


def edge_stiffness(vertices: Floats, edges: Integers, directions: Floats, exponent: float) -> Floats:
    """k = (1 - |cos(edge, fibre)|)^a: edges along the fibres are soft (Cervenka and Kohout, a = 0.5).

    Returns
    -------
    (e,) ndarray
        In [0, 1]; 1 everywhere for exponent 0.
    """
    if exponent == 0.0:
        return np.ones(len(edges))
    along = _normalised(vertices[edges[:, 1]] - vertices[edges[:, 0]])
    fibre = directions[edges[:, 0]]
    other = directions[edges[:, 1]]
    fibre = _normalised(fibre + np.where(np.einsum("ij,ij->i", fibre, other) < 0, -1, 1)[:, None] * other)
    aligned = np.abs(np.einsum("ij,ij->i", along, fibre))
    return np.clip(1.0 - aligned, 0.0, 1.0) ** exponent


def swelling_room(vertices: Floats, faces: Integers, normals: Floats, held: Booleans, share: float) -> Any:
    """How far the surface moves at each vertex when the muscle swells: its local half thickness.

    A uniform offset would turn thin rims inside out; in proportion to the thickness it is a change of
    thickness by the same factor everywhere, as an incompressible body would thin when it is stretched.

    Parameters
    ----------
    vertices, faces, normals : ndarray
    held : (n,) ndarray of bool
        Vertices that do not move.
    share : float
        Distance over which the thickness is smoothed, and falls to 0 at held vertices, as a share of the diagonal.

    Returns
    -------
    (n,) ndarray
        Smooth, [unit of the vertices], 0 at held vertices.
    """
    radius = _inner_balls(vertices, normals)
    reach = share * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    area = vertex_areas(vertices, faces)
    free = np.flatnonzero(~held)
    room = np.zeros(len(vertices))
    if len(free):
        mass = area / reach**2
        matrix = (cotangent_laplacian(vertices, faces) + sparse.diags(mass)).tocsc()
        room[free] = spsolve(matrix[free][:, free], (mass * radius)[free])
    return np.maximum(room, 0.0)


def vertex_areas(vertices: Floats, faces: Integers) -> Floats:
    """A third of the area of the faces around each vertex, (n,)."""
    area = np.zeros(len(vertices))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.add.at(area, faces, np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None] / 6.0)
    return area


def _inner_balls(vertices, normals, rounds=12):
    """Radius of the largest inner ball that touches the surface at each vertex (shrinking balls, Ma 2012)."""
    tree = cKDTree(vertices)
    radius = np.full(len(vertices), 0.5 * float(np.ptp(vertices, axis=0).max()))
    for _ in range(rounds):
        distance, index = tree.query(vertices - radius[:, None] * normals)
        offset = vertices - vertices[index]
        height = np.einsum("ij,ij->i", offset, normals)
        square = np.einsum("ij,ij->i", offset, offset)
        # a neighbour at a right angle says nothing: the ball would shrink to the sampling
        inside = (distance < radius * (1 - 1e-6)) & (height > 0.3 * np.sqrt(square))
        if not inside.any():
            break
        radius[inside] = np.minimum(radius[inside], square[inside] / (2.0 * height[inside]))
    return radius


def _normalised(vectors):
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-12)
