"""Distances that are measured: exact, and sure of their side where a mesh is folded on itself or open."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.exact_distance import ExactDistance, Layout
from rbfmuscle.geometry.winding import winding_number
from rbfmuscle.validation import check_mesh, check_points


class MeshDistance:
    """Exact distance of points to a closed, outward mesh; negative inside.

    The tree is built once and kept, so a bone is prepared once and asked in its own coordinates.

    Parameters
    ----------
    vertices : (n, 3) array_like
        [scene unit]
    faces : (m, 3) array_like of int
    closed : bool
        False for a mesh with holes.
    layout : Layout, optional
        Of the same faces at another moment, as `ExactDistance` takes it.

    Attributes
    ----------
    layout : Layout

    Notes
    -----
    The sign comes from the pseudonormal of the feature (face, edge or vertex) that holds the closest point
    (Baerentzen and Aanaes 2005), which is exact for closed, consistently oriented meshes. Where that normal
    is nearly square to the way to the point, as at a sliver folded on itself, and for meshes with holes, the
    winding number decides (Jacobson et al. 2013; Barill et al. 2018): inside where it exceeds one half.
    """

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, *, closed: bool = True, layout: Layout | None = None
    ) -> None:
        self.closed = closed
        self.vertices, self.faces = check_mesh(vertices, faces)
        self._exact = ExactDistance(self.vertices, self.faces, layout=layout)
        self.layout = self._exact.layout

    def unsigned(self, points: ArrayLike) -> Floats:
        """Distance to the surface.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        return np.abs(self._exact.signed_distance(check_points(points)))

    def signed(self, points: ArrayLike) -> Floats:
        """Distance to the surface, negative inside.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        points = check_points(points)
        if len(points) == 0:
            return np.zeros(0)
        if not self.closed:
            import igl

            inside = igl.fast_winding_number(self.vertices, self.faces, points) > 0.5
            return np.where(inside, -1.0, 1.0) * self.unsigned(points)
        out, closest, _, normal = self._exact.nearest(points)
        # At a face the normal points along the way; elsewhere it may be nearly square to it.
        unsure = np.abs(np.einsum("ij,ij->i", points - closest, normal)) < 0.1 * np.abs(out)
        for n in np.flatnonzero(unsure):
            inside = winding_number(points[n], self.vertices, self.faces) > 0.5
            out[n] = -abs(out[n]) if inside else abs(out[n])
        return out

    def depth(self, points: ArrayLike) -> Floats:
        """How deep points lie inside, 0 where outside.

        The deepest point is looked at again with the winding number, until one is inside for certain: where a
        mesh is folded on itself a sign can be wrong, and one wrong sign would decide the greatest depth.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        points = check_points(points)
        depth = np.maximum(-self.signed(points), 0.0)
        while depth.any():
            deepest = int(depth.argmax())
            if winding_number(points[deepest], self.vertices, self.faces) > 0.5:
                break
            depth[deepest] = 0.0
        return depth
