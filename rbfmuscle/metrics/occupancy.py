"""A coarse grid that says which points are certainly outside a closed mesh: few then need a distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_mesh, check_points

_UNKNOWN, _SURFACE, _OUTSIDE = 0, 1, 2


class OccupancyGrid:
    """Cells of a closed mesh that may hold a part of its inside.

    Cells met by a triangle are marked (plane against box, so never one too few), then a fill from the rim
    finds what is outside for certain. All other cells are candidates.

    Parameters
    ----------
    vertices : (n, 3) array_like
        Vertices of a closed mesh [scene unit].
    faces : (m, 3) array_like of int
    cells : int
        Cells along the longest side of the bounding box.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, *, cells: int = 64) -> None:
        vertices, faces = check_mesh(vertices, faces)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.spacing = max(float((high - low).max()), 1e-300) / cells
        shape = np.ceil((high - low) / self.spacing).astype(np.int64) + 3
        self.origin = low - 1.5 * self.spacing
        self.state = np.zeros(shape, dtype=np.uint8)
        _mark_loop(vertices, faces, self.origin, self.spacing, self.state)
        stack = np.empty((self.state.size, 3), dtype=np.int32)
        _fill_loop(self.state, stack)

    def candidates(self, points: ArrayLike) -> Integers:
        """Indices of the points that may lie inside the mesh.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (k,) ndarray of int
        """
        points = check_points(points)
        out = np.zeros(len(points), dtype=np.bool_)
        _lookup_loop(points, self.origin, self.spacing, self.state, out)
        return np.flatnonzero(out)


@compiled
def _mark_loop(vertices, faces, origin, spacing, state):
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    half = 0.5 * spacing * (1.0 + 1e-9)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        for k in range(3):
            least, most = min(a[k], b[k], c[k]), max(a[k], b[k], c[k])
            low[k] = max(int((least - origin[k]) / spacing - 1e-9), 0)
            high[k] = min(int((most - origin[k]) / spacing + 1e-9), state.shape[k] - 1)
        nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        reach = half * (abs(nx) + abs(ny) + abs(nz))
        for i in range(low[0], high[0] + 1):
            x = nx * (origin[0] + (i + 0.5) * spacing - a[0])
            for j in range(low[1], high[1] + 1):
                y = ny * (origin[1] + (j + 0.5) * spacing - a[1])
                for k in range(low[2], high[2] + 1):
                    z = nz * (origin[2] + (k + 0.5) * spacing - a[2])
                    if abs(x + y + z) <= reach:
                        state[i, j, k] = _SURFACE


@compiled
def _fill_loop(state, stack):
    state[0, 0, 0] = _OUTSIDE
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, 0
    count = 1
    while count > 0:
        count -= 1
        i, j, k = stack[count, 0], stack[count, 1], stack[count, 2]
        for side in range(6):
            step = 1 - 2 * (side % 2)
            p = i + step if side // 2 == 0 else i
            q = j + step if side // 2 == 1 else j
            r = k + step if side // 2 == 2 else k
            inside = 0 <= p < state.shape[0] and 0 <= q < state.shape[1] and 0 <= r < state.shape[2]
            if inside and state[p, q, r] == _UNKNOWN:
                state[p, q, r] = _OUTSIDE
                stack[count, 0], stack[count, 1], stack[count, 2] = p, q, r
                count += 1


@compiled
def _lookup_loop(points, origin, spacing, state, out):
    for n in range(len(points)):
        i = int(np.floor((points[n, 0] - origin[0]) / spacing))
        j = int(np.floor((points[n, 1] - origin[1]) / spacing))
        k = int(np.floor((points[n, 2] - origin[2]) / spacing))
        if 0 <= i < state.shape[0] and 0 <= j < state.shape[1] and 0 <= k < state.shape[2]:
            out[n] = state[i, j, k] != _OUTSIDE
