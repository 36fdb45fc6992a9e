"""A muscle's surface as its neighbours see it: its carried mesh, whose search structure is refitted."""

import numba
import numpy as np
from scipy.spatial import cKDTree


class Skin:
    """Signed distance to a model's carried mesh.

    The nearest vertex is found by a tree over the vertices now; the nearest point of the surface lies in one
    of the triangles around it, up to the square of an edge over the radius of curvature. Signs and directions
    come from vertex normals, interpolated, so that they vary smoothly.

    Parameters
    ----------
    model : MuscleModel
        In its rest state.

    Attributes
    ----------
    vertices : (n, 3) ndarray
    fixed : (n,) ndarray of bool
        Vertices that a bone holds.
    box : (2, 3) ndarray
    """

    def __init__(self, model):
        self.model = model
        vertices, faces = model.carried_mesh()
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        corner = self.faces.ravel()
        order = np.argsort(corner, kind="stable")
        self.ring = order // 3
        self.start = np.searchsorted(corner[order], np.arange(len(vertices) + 1))
        nearest = cKDTree(model.contact_points()).query(vertices)[1]
        self.fixed = np.asarray(model.contact_bone)[nearest] >= 0
        self.refresh()

    def refresh(self):
        """Take over where the model is now."""
        self.vertices = np.ascontiguousarray(self.model.carried_mesh()[0], dtype=np.float64)
        self.normals = np.zeros_like(self.vertices)
        _normals_loop(self.vertices, self.faces, self.normals)
        self.box = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        # A tree that is not balanced builds three times as fast and answers as quickly on a surface.
        self.tree = cKDTree(self.vertices, leafsize=24, balanced_tree=False, compact_nodes=False)

    def query(self, points, reach):
        """Distances of the points nearer to a vertex than ``reach`` and an edge.

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
        if len(points) == 0:
            return np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64)
        nearest = self.tree.query(points, distance_upper_bound=1.5 * reach)[1]
        index = np.flatnonzero(nearest < len(self.vertices))
        nearest = nearest[index]
        distance, normal = np.empty(len(index)), np.empty((len(index), 3))
        _distance_loop(
            points[index],
            nearest,
            self.vertices,
            self.normals,
            self.faces,
            self.start,
            self.ring,
            distance,
            normal,
        )
        near = distance < reach
        return index[near], distance[near], normal[near], nearest[near]


@numba.njit(cache=True, nogil=True)
def _normals_loop(vertices, faces, normals):
    """Area-weighted vertex normals of unit length."""
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            area = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
            for corner in range(3):
                normals[faces[f, corner], k] += area
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        for k in range(3):
            normals[v, k] /= max(length, 1e-300)


@numba.njit(cache=True, nogil=True)
def _distance_loop(points, nearest, vertices, normals, faces, start, ring, distance, normal):
    weights, best = np.empty(3), np.empty(3)
    for p in range(len(points)):
        least, face = np.inf, -1
        for r in range(start[nearest[p]], start[nearest[p] + 1]):
            f = ring[r]
            _closest(points[p], vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]], weights)
            squared = 0.0
            for k in range(3):
                at = 0.0
                for corner in range(3):
                    at += weights[corner] * vertices[faces[f, corner], k]
                squared += (points[p, k] - at) ** 2
            if squared < least:
                least, face = squared, f
                best[:] = weights
        size, side = 0.0, 0.0
        for k in range(3):
            n, at = 0.0, 0.0
            for corner in range(3):
                n += best[corner] * normals[faces[face, corner], k]
                at += best[corner] * vertices[faces[face, corner], k]
            normal[p, k] = n
            size += n * n
            side += n * (points[p, k] - at)
        for k in range(3):
            normal[p, k] /= max(np.sqrt(size), 1e-300)
        distance[p] = np.sqrt(least) if side >= 0.0 else -np.sqrt(least)


@numba.njit(cache=True, nogil=True)
def _closest(p, a, b, c, weights):
    """Barycentric weights of the point of a triangle nearest to p (Ericson 2005, section 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    weights[:] = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        weights[0] = 1.0
        return
    bp = p - b
    d3, d4 = ab @ bp, ac @ bp
    if d3 >= 0.0 and d4 <= d3:
        weights[1] = 1.0
        return
    cp = p - c
    d5, d6 = ab @ cp, ac @ cp
    if d6 >= 0.0 and d5 <= d6:
        weights[2] = 1.0
        return
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        weights[1] = d1 / (d1 - d3)
        weights[0] = 1.0 - weights[1]
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        weights[2] = d2 / (d2 - d6)
        weights[0] = 1.0 - weights[2]
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        weights[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        weights[1] = 1.0 - weights[2]
    else:
        whole = va + vb + vc
        weights[1], weights[2] = vb / whole, vc / whole
        weights[0] = 1.0 - weights[1] - weights[2]
