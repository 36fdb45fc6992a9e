"""Weights between the bones' motions that stretch the surface evenly: they minimise the integral of
|grad w|^4.

Harmonic weights (p = 2) are singular at the rim of a small patch that is held, and stretch edges
there fivefold.
"""

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.harmonic import graph_laplacian, harmonic_weights

POWER = 4.0  # p of the minimised integral of |grad w|^p: smoother at the ends than 2
# A choice and not an end at convergence: after these the weights are within 0.001 of their limit,
# and they only predict; what is solved does not depend on them.
ROUNDS = 8
# Faces whose gradient is below this share of the largest count as having this much.
LEAST_GRADIENT = 1e-3
COTANGENTS = 1e-3, 1e3
# Height of a triangle over its longest side below which its gradient is that of this height.
FLATTEST = 1e-6


def even_weights(vertices: Floats, faces: Integers, groups: list[Integers]) -> Floats:
    """Weights (n, groups) in [0, 1] that sum to one, 1 on a group's own vertices, by re-weighted
    Laplace solves.
    """
    weights = harmonic_weights(vertices, faces, groups)
    held = np.zeros(len(vertices), dtype=bool)
    for group in groups:
        held[group] = True
    free, fixed = np.flatnonzero(~held), np.flatnonzero(held)
    if len(free) == 0 or len(groups) < 2:
        return weights
    cotangents, gradients = _face_operators(vertices, faces)
    first, second = (np.roll(faces, -shift, axis=1).T.ravel() for shift in (1, 2))
    for _ in range(ROUNDS):
        size = np.sqrt(sum(((gradient @ weights) ** 2).sum(axis=1) for gradient in gradients))
        conductance = np.maximum(size / size.max(), LEAST_GRADIENT) ** (POWER - 2.0)
        laplacian = graph_laplacian(
            first, second, (cotangents * conductance[:, None]).T.ravel(), len(vertices)
        )[free]
        solved = splu(laplacian[:, free].tocsc()).solve(-(laplacian[:, fixed] @ weights[fixed]))
        # a full step oscillates for p > 3; this one is Newton's where the direction of the gradient
        # stays
        weights[free] += (solved - weights[free]) / (POWER - 1.0)
    weights = np.clip(weights, 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _face_operators(vertices, faces):
    """Half cotangents (m, 3) opposite to each corner's edge, and three (m, n) gradient matrices."""
    corners = [vertices[faces[:, k]] for k in range(3)]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    sides = [corners[k - 1] - corners[k] for k in range(3)]
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in sides], axis=0)
    square = np.maximum(np.einsum("ij,ij->i", normal, normal), (FLATTEST * longest) ** 2 + 1e-300)
    cotangents, slopes = np.empty((len(faces), 3)), []
    for k in range(3):
        one, two = corners[(k + 1) % 3], corners[(k + 2) % 3]
        dot = np.einsum("ij,ij->i", one - corners[k], two - corners[k])
        cotangents[:, k] = np.clip(0.5 * dot / np.sqrt(square), *COTANGENTS)
        slopes.append(np.cross(normal, two - one) / square[:, None])
    rows = np.tile(np.arange(len(faces)), 3)
    shape = (len(faces), len(vertices))
    columns = faces.T.ravel()
    matrices = [
        sparse.csr_matrix(
            (np.concatenate([slope[:, d] for slope in slopes]), (rows, columns)), shape=shape
        )
        for d in range(3)
    ]
    return cotangents, matrices
