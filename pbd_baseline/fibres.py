"""Softness of edges along the fibres, and thickness of the muscle."""

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.harmonic import cotangent_laplacian
from rbfmuscle.geometry.surfaces import vertex_areas

# Distance over which the thickness is smoothed, and falls to 0 at held vertices, as a share of the
# diagonal.
SMOOTHING = 0.04


def edge_stiffness(
    vertices: Floats, edges: Integers, directions: Floats, exponent: float
) -> Floats:
    """k = (1 - |cos(edge, fibre)|)^a, (e,): edges along the fibres are soft (Cervenka and Kohout, a
    = 0.5).
    """
    if exponent == 0.0:
        return np.ones(len(edges))
    along = _normalised(vertices[edges[:, 1]] - vertices[edges[:, 0]])
    fibre = directions[edges[:, 0]]
    other = directions[edges[:, 1]]
    fibre = _normalised(
        fibre + np.where(np.einsum("ij,ij->i", fibre, other) < 0, -1, 1)[:, None] * other
    )
    aligned = np.abs(np.einsum("ij,ij->i", along, fibre))
    return np.clip(1.0 - aligned, 0.0, 1.0) ** exponent


def swelling_room(vertices: Floats, faces: Integers, normals: Floats, held: Booleans) -> Floats:
    """How far the surface moves at each vertex when the muscle swells: its local half thickness
    (n,).

    Smooth, [unit of the vertices], 0 at held vertices.
    """
    radius = _inner_balls(vertices, normals)
    reach = SMOOTHING * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    area = vertex_areas(vertices, faces)
    free = np.flatnonzero(~held)
    room = np.zeros(len(vertices))
    if len(free):
        mass = area / reach**2
        matrix = (cotangent_laplacian(vertices, faces) + sparse.diags(mass)).tocsc()
        room[free] = spsolve(matrix[free][:, free], (mass * radius)[free])
    return np.maximum(room, 0.0)


def _inner_balls(vertices, normals):
    """Radius of the largest inner ball that touches the surface at each vertex (shrinking balls, Ma
    2012): no vertex is in it but at a right angle or more.
    """
    tree = cKDTree(vertices)
    radius = np.full(len(vertices), 0.5 * float(np.ptp(vertices, axis=0).max()))
    # A ball becomes smaller each time, through another vertex: this ends.
    while True:
        distance, index = tree.query(vertices - radius[:, None] * normals)
        offset = vertices - vertices[index]
        height = np.einsum("ij,ij->i", offset, normals)
        square = np.einsum("ij,ij->i", offset, offset)
        # a neighbour at a right angle says nothing: the ball would shrink to the sampling
        inside = (distance < radius * (1 - 1e-6)) & (height > 0.3 * np.sqrt(square))
        if not inside.any():
            return radius
        radius[inside] = np.minimum(radius[inside], square[inside] / (2.0 * height[inside]))


def _normalised(vectors):
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-12)
