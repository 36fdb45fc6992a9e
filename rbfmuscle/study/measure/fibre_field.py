"""The harmonic field inside a muscle whose streamlines are its fibres.

Flux enters evenly over the origin, leaves evenly over the insertion, and none passes through the rest of the
surface (Choi and Blemker 2013, "Skeletal muscle fascicle arrangements can be reconstructed using a Laplacian
vector field simulation"). Values given on the attachments instead would draw all fibres to their nearest rims.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import map_coordinates
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.validation import SolveError

# Nodes inside a muscle: 1 to 2.5 mm apart in the muscles of the hip.
NODES = 60_000
# Layers by which the field is continued beyond the surface, for gradients there.
_LAYERS = 3
_RESIDUAL, _MOST_ITERATIONS = 1e-7, 4000


class FibreField:
    """Harmonic field of one muscle on a regular grid.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        Closed, outward mesh [scene unit].
    sides : pair of (points, areas)
        Points (k, 3) spread over the attachment of the origin and of the insertion, and the area (k,) of each.
    nodes : int
        About this many grid nodes lie inside.

    Attributes
    ----------
    spacing : float
        Edge of a grid cell [scene unit].
    values : (nx, ny, nz) ndarray
        The field [1 / scene unit], for a total flux of one; continued a little beyond the surface.
    distance : (nx, ny, nz) ndarray
        Signed distance to the surface, negative inside, cut off a few cells outside.

    Raises
    ------
    SolveError
        If origin and insertion are not joined by the inside of the mesh.

    Notes
    -----
    Links between nodes are weighted by the open share of the face between them (Ng, Min and Gibou 2009), so
    that a wall that crosses the grid obliquely keeps fibres along it.
    """

    def __init__(
        self, vertices: Floats, faces: Integers, sides: list[tuple[Floats, Floats]], *, nodes: int = NODES
    ) -> None:
        exact = ExactDistance(vertices, faces)
        self.spacing = _spacing(vertices, faces, nodes)
        low = vertices.min(axis=0) - (_LAYERS + 1) * self.spacing
        shape = np.ceil((np.ptp(vertices, axis=0)) / self.spacing).astype(int) + 2 * (_LAYERS + 1) + 1
        self.origin, self.shape = low, tuple(shape)
        axes = [low[k] + self.spacing * np.arange(shape[k]) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        depth = exact.signed_distance(grid)
        self.distance = np.minimum(depth, (_LAYERS + 1) * self.spacing).reshape(self.shape)
        links = _links(self.distance, self.spacing)
        entering, leaving = (_shares(grid, depth, side) for side in sides)
        self.values = self._solve(links, leaving - entering).reshape(self.shape)
        self._slope = np.gradient(self.values, self.spacing)
        self._outward = np.gradient(self.distance, self.spacing)

    def value(self, points: Floats) -> Any:
        """Field at points (n, 3), (n,)."""
        return self._read(self.values, points)

    def depth(self, points: Floats) -> Floats:
        """Signed distance at points, negative inside, to about a tenth of a cell."""
        return self._read(self.distance, points)

    def gradient(self, points: Floats) -> Floats:
        """Gradient of the field at points, (n, 3)."""
        return np.stack([self._read(part, points) for part in self._slope], axis=1)

    def outward(self, points: Floats) -> Floats:
        """Unit direction out of the muscle at points, (n, 3)."""
        way = np.stack([self._read(part, points) for part in self._outward], axis=1)
        return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)

    def _read(self, part, points):
        return map_coordinates(part, ((points - self.origin) / self.spacing).T, order=1, mode="nearest")

    def _solve(self, links, flux):
        """Field at all nodes: solved where links lead, continued outward from there."""
        total = np.asarray(links.sum(axis=1)).ravel()
        part = connected_components(links, directed=False)[1]
        used = part == part[np.argmax(np.abs(flux))]
        if abs(flux[used].sum()) > 0.5 * np.abs(flux).max() or not (flux[used] > 0).any():
            raise SolveError("no way leads from the origin to the insertion inside the muscle")
        inner = (sparse.diags(total) - links)[used][:, used].tocsr()
        right = (flux[used] - flux[used].mean()) / self.spacing
        scale = sparse.diags(1.0 / inner.diagonal())
        found, failed = cg(inner, right, rtol=_RESIDUAL, maxiter=_MOST_ITERATIONS, M=scale)
        if failed:
            raise SolveError("the harmonic field of the fibres did not converge; check the muscle's mesh")
        values = np.full(len(flux), np.nan)
        values[used] = found
        return _continued(values.reshape(self.shape))


def attachment_points(
    vertices: Floats, faces: Integers, attached: Integers, spacing: float
) -> tuple[Floats, Floats]:
    """Points spread over the triangles whose corners are all attached.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
    attached : (k,) ndarray of int
    spacing : float
        Points are at most about this far apart [scene unit].

    Returns
    -------
    points : (p, 3) ndarray
        The attached vertices themselves where they span no triangle.
    areas : (p,) ndarray
        The part of the surface that each stands for.
    """
    chosen = np.zeros(len(vertices), dtype=bool)
    chosen[attached] = True
    corners = vertices[faces[chosen[faces].all(axis=1)]]
    if not len(corners):
        return vertices[attached], np.ones(len(attached))
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    count = min(8, max(1, int(np.ceil(longest / spacing))))
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # The middles of the upright ones of count^2 smaller triangles.
    shares = [(i + 1 / 3, j + 1 / 3, count - i - j - 2 / 3) for i in range(count) for j in range(count - i)]
    points = np.concatenate([np.einsum("k,tkc->tc", np.array(share) / count, corners) for share in shares])
    return points, np.tile(area / len(shares), len(shares))


def _spacing(vertices, faces, nodes):
    return (mesh_volume(vertices, faces) / nodes) ** (1.0 / 3.0)


def _links(distance, spacing):
    """Symmetric sparse weights between neighbouring nodes: the open share of the face between them."""
    number = np.arange(distance.size).reshape(distance.shape)
    rows, cols, values = [], [], []
    for axis in range(3):
        a = np.moveaxis(number, axis, 0)[:-1].ravel()
        b = np.moveaxis(number, axis, 0)[1:].ravel()
        depth = distance.ravel()
        open_share = np.clip(0.5 - 0.5 * (depth[a] + depth[b]) / spacing, 0.0, 1.0)
        used = open_share > 1e-3
        rows += [a[used], b[used]]
        cols += [b[used], a[used]]
        values += [open_share[used]] * 2
    rows, cols, values = map(np.concatenate, (rows, cols, values))
    return sparse.csr_matrix((values, (rows, cols)), shape=(distance.size, distance.size))


def _shares(grid, depth, side):
    """Share of an attachment's area that enters or leaves at each node: that of the points nearest to it."""
    points, areas = side
    inside = np.flatnonzero(depth < 0)
    nearest = inside[cKDTree(grid[inside]).query(points)[1]]
    return np.bincount(nearest, weights=areas / areas.sum(), minlength=len(grid))


def _continued(values):
    """Values beyond the known nodes: means of the neighbours known so far, layer by layer, then the nearest."""
    for _ in range(_LAYERS):
        known = np.isfinite(values)
        total, count = np.zeros(values.shape), np.zeros(values.shape)
        for axis in range(3):
            for shift in (1, -1):
                seen = np.roll(known, shift, axis)
                total += np.where(seen, np.roll(np.where(known, values, 0.0), shift, axis), 0.0)
                count += seen
        values = np.where(known | (count == 0), values, total / np.maximum(count, 1))
    return np.where(np.isfinite(values), values, np.nanmean(values))
