"""Harmonic weights on a closed mesh: how much of each bone's motion a surface point takes over."""

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu


def cotangent_laplacian(vertices, faces):
    """Positive semi-definite cotangent Laplacian with weights clamped from below.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int

    Returns
    -------
    (n, n) scipy.sparse.csc_matrix

    Notes
    -----
    Negative cotangents (22 % on a long muscle mesh) would break the maximum principle, so that weights would
    leave [0, 1]; they are raised to a small positive share of the mean weight.
    """
    rows, cols, values = [], [], []
    for k in range(3):
        i, j, o = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3], faces[:, k]
        u, v = vertices[i] - vertices[o], vertices[j] - vertices[o]
        twice_area = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = 0.5 * np.einsum("ij,ij->i", u, v) / np.maximum(twice_area, 1e-300)
        rows.append(i)
        cols.append(j)
        values.append(cotangent)
    rows, cols, values = map(np.concatenate, (rows, cols, values))
    count = len(vertices)
    half = sparse.coo_matrix((values, (rows, cols)), shape=(count, count)).tocsr()
    weights = (half + half.T).tocoo()
    positive = np.clip(weights.data, 1e-3 * np.median(np.abs(weights.data)), 1e3)
    weights = sparse.csr_matrix((positive, (weights.row, weights.col)), shape=(count, count))
    return (sparse.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights).tocsc()


def harmonic_weights(vertices, faces, groups):
    """Solve Laplace's equation on the surface once for each group of fixed vertices.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    groups : list of (k_g,) int arrays
        Disjoint vertex indices; group g has weight 1 on its own vertices and 0 on the others'.

    Returns
    -------
    (n, len(groups)) ndarray
        Weights in [0, 1] that sum to one in each row.
    """
    count = len(vertices)
    weights = np.zeros((count, len(groups)))
    fixed = np.zeros(count, dtype=bool)
    for g, group in enumerate(groups):
        weights[group, g] = 1.0
        fixed[group] = True
    laplacian = cotangent_laplacian(vertices, faces)
    free = ~fixed
    if free.any():
        right = -(laplacian[free][:, fixed] @ weights[fixed])
        weights[free] = splu(laplacian[free][:, free].tocsc()).solve(right)
    weights = np.clip(weights, 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)


def surface_gradient(vertices, faces, values):
    """Area-weighted gradient of a piecewise linear function at each vertex of a surface.

    Returns
    -------
    (n, 3) ndarray
        Tangential gradient [1 / length unit of the vertices].
    """
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normal = np.cross(b - a, c - a)
    squared = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-300)[:, None]
    fa, fb, fc = (values[faces[:, k]][:, None] for k in range(3))
    gradient = np.cross(normal, fa * (c - b) + fb * (a - c) + fc * (b - a)) / squared
    area = 0.5 * np.sqrt(squared)
    total, weight = np.zeros_like(vertices), np.zeros((len(vertices), 1))
    for k in range(3):
        np.add.at(total, faces[:, k], area * gradient)
        np.add.at(weight, faces[:, k], area)
    return total / np.maximum(weight, 1e-300)
