"""Harmonic weights on a closed mesh: how much of each bone's motion a surface point takes over."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.geometry.frames import cross, dot, row_of
from rbfmuscle.geometry.surfaces import face_normals
from rbfmuscle.loops import loop


def cotangent_laplacian(vertices: Floats, faces: Integers) -> sparse.csc_matrix:
    """Positive semi-definite cotangent Laplacian (n, n) with weights clamped from below.

    Negative cotangents (22 % on a long muscle mesh) would break the maximum principle, so that
    weights would leave [0, 1]; they are raised to a small positive share of the mean weight.
    """
    # The ends of the edge opposite to each corner of the faces.
    i = np.roll(faces, -1, axis=1)
    j = np.roll(faces, -2, axis=1)
    u, v = vertices[i] - vertices[faces], vertices[j] - vertices[faces]
    twice_area = np.linalg.norm(np.cross(u, v), axis=2)
    cotangent = 0.5 * np.einsum("fki,fki->fk", u, v) / np.maximum(twice_area, 1e-300)
    count = len(vertices)
    ends = i.T.ravel(), j.T.ravel()
    half = sparse.coo_matrix((cotangent.T.ravel(), ends), shape=(count, count)).tocsr()
    edges = sparse.triu(half + half.T, format="coo")
    weights = np.clip(edges.data, 1e-3 * np.median(np.abs(edges.data)), 1e3)
    return graph_laplacian(edges.row, edges.col, weights, count)


def graph_laplacian(
    first: Integers, second: Integers, weights: Floats, count: int
) -> sparse.csc_matrix:
    """Laplacian (count, count) of edges between vertices; the weights of an edge that is given
    twice are added.
    """
    half = sparse.csr_matrix((weights, (first, second)), shape=(count, count))
    links = half + half.T
    return (sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links).tocsc()


def harmonic_weights(vertices: Floats, faces: Integers, groups: Sequence[Integers]) -> Floats:
    """Weights (n, groups) in [0, 1] that sum to one, by Laplace's equation on the surface for each
    group.

    Group g has weight 1 on its own vertices and 0 on the others'; groups are disjoint. Raises
    LinAlgError if a part of the surface has no fixed vertex.
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
    total = weights.sum(axis=1, keepdims=True)
    if not (total > 0.0).all():
        raise np.linalg.LinAlgError("a part of the surface has no fixed vertex, or no area")
    return weights / total


def surface_gradient(vertices: Floats, faces: Array, values: Floats) -> Floats:
    """Area-weighted tangential gradient (n, 3) of a piecewise linear function at the vertices of a
    surface.
    """
    a = vertices[faces[:, 0]]
    b = vertices[faces[:, 1]]
    c = vertices[faces[:, 2]]
    normal = 2.0 * face_normals(vertices, faces)
    squared = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-300)[:, None]
    fa, fb, fc = (values[faces[:, k]][:, None] for k in range(3))
    gradient = np.cross(normal, fa * (c - b) + fb * (a - c) + fc * (b - a)) / squared
    area = 0.5 * np.sqrt(squared)
    total, weight = np.zeros_like(vertices), np.zeros((len(vertices), 1))
    for k in range(3):
        np.add.at(total, faces[:, k], area * gradient)
        np.add.at(weight, faces[:, k], area)
    return total / np.maximum(weight, 1e-300)


def blended_motion(points: Floats, weights: Floats, motions: Floats) -> Floats:
    """Move each point (n, 3) by a mean of rigid motions (b, 4, 4) with weights (n, b) that sum to
    one.

    The motions' twists (logarithms in se(3)) are averaged with the point's weights and
    exponentiated, so a motion that all bones share moves every point rigidly, and a weight of one
    gives that bone's motion exactly.
    """
    out = np.empty((len(points), 3))
    exponential_loop(np.asarray(points, dtype=np.float64), weights @ _twists(motions), out)
    return out


def _twists(motions: Floats) -> Floats:
    """Twists (b, 6), each omega and velocity, of rigid motions (b, 4, 4)."""
    omega = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    shift = motions[:, :3, 3]
    # Of smaller angles the factor is the same but for rounding.
    half = np.maximum(0.5 * np.linalg.norm(omega, axis=1, keepdims=True), 5e-5)
    factor = 0.25 * (1.0 - half / np.tan(half)) / half**2
    turned = np.cross(omega, shift)
    velocity = shift - 0.5 * turned + factor * np.cross(omega, turned)
    return np.hstack([omega, velocity])


@loop
def exponential_loop(points, twists, out):
    """Move each point by the exponential of its twist (omega, velocity)."""
    for n in range(len(points)):
        point = row_of(points, n)
        omega = twists[n, 0], twists[n, 1], twists[n, 2]
        velocity = twists[n, 3], twists[n, 4], twists[n, 5]
        square = dot(omega, omega)
        angle = np.sqrt(square)
        if angle < 1e-6:  # further terms are below rounding
            first, second, third = 1.0, 0.5, 1.0 / 6.0
        else:
            first, half = np.sin(angle) / angle, np.sin(0.5 * angle) / angle
            second = 2.0 * half * half
            third = (1.0 - first) / square
        turned = cross(omega, point)
        swept = cross(omega, velocity)
        twice = cross(omega, turned)
        swept_twice = cross(omega, swept)
        for a in range(3):
            out[n, a] = point[a] + velocity[a] + first * turned[a]
            out[n, a] += second * (twice[a] + swept[a])
            out[n, a] += third * swept_twice[a]
