"""Mean value coordinates: points inside a closed mesh as weighted means of its vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.jit import compiled

# A triangle whose plane the point lies in, seen from outside it, adds nothing.
_FLAT = 1e-12
_LEAST_SHARE = 16
# Weights must give a point back to this share of the mesh's size.
_EXACT = 1e-8


def mean_value_weights(points: ArrayLike, vertices: ArrayLike, faces: ArrayLike) -> Floats:
    """Weights of a mesh's vertices that give back each point.

    They are smooth inside, sum to one and reproduce every affine motion of the vertices exactly.

    Parameters
    ----------
    points : (n, 3) array_like
        Inside the mesh, off its triangles.
    vertices : (v, 3) array_like
    faces : (m, 3) array_like of int
        Closed, outward.

    Returns
    -------
    (n, v) ndarray
        Each row sums to one; weights may be negative where the mesh is hollow.

    Raises
    ------
    ValueError
        If the weights do not give a point back, as on a vertex of the mesh.

    Notes
    -----
    Ju, Schaefer and Warren 2005, "Mean value coordinates for closed triangular meshes", in the form of the mean
    vector of a spherical triangle: m = sum of (angle of an edge / 2) times the unit normal of its plane
    through the point, and w_i = m . (v_j x v_k) / det(v_i, v_j, v_k).
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    weights = np.zeros((len(points), len(vertices)))

    def work(a, b):
        _weights_loop(points[a:b], vertices, faces, weights[a:b])

    in_chunks(len(points), work, least=_LEAST_SHARE)
    total = weights.sum(axis=1)
    weights /= np.where(total > 0, total, 1.0)[:, None]
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    wrong = ~(np.linalg.norm(weights @ vertices - points, axis=1) < _EXACT * size)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"point {row} at {points[row]} does not lie inside the mesh, off its vertices")
    return weights


@compiled
def _weights_loop(points, vertices, faces, out):
    v = np.empty((3, 3))
    n = np.empty((3, 3))
    size = np.empty(3)
    for p in range(len(points)):
        for t in range(len(faces)):
            for i in range(3):
                for k in range(3):
                    v[i, k] = vertices[faces[t, i], k] - points[p, k]
                size[i] = np.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
            for i in range(3):
                _cross(v[(i + 1) % 3], v[(i + 2) % 3], n[i])
            det = v[0, 0] * n[0, 0] + v[0, 1] * n[0, 1] + v[0, 2] * n[0, 2]
            if abs(det) <= _FLAT * size[0] * size[1] * size[2]:
                continue
            mx = my = mz = 0.0
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                across = np.sqrt(n[i, 0] ** 2 + n[i, 1] ** 2 + n[i, 2] ** 2)
                if across <= 0.0:
                    continue
                along = v[j, 0] * v[k, 0] + v[j, 1] * v[k, 1] + v[j, 2] * v[k, 2]
                half = 0.5 * np.arctan2(across, along) / across
                mx += half * n[i, 0]
                my += half * n[i, 1]
                mz += half * n[i, 2]
            for i in range(3):
                out[p, faces[t, i]] += (mx * n[i, 0] + my * n[i, 1] + mz * n[i, 2]) / det


@compiled
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
