"""A mesh with few triangles, to be looked at: vertices in one cell of a grid become one."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers

# Cells along the longest side, and vertices at most.
_CELLS, _MOST_VERTICES = 64, 800


def light_mesh(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Vertices (n, 3) and faces (m, 3) of a mesh of at most 800 vertices; a smaller one as it is.

    Nothing is promised but its look: it may have holes and touch itself.
    """
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    low = vertices.min(axis=0)
    size = float(np.ptp(vertices, axis=0).max())
    cells, cell = _CELLS, np.arange(len(vertices))
    count = len(vertices)
    while count > _MOST_VERTICES:
        places = np.floor((vertices - low) * (cells / size)).astype(np.int64)
        key = places @ np.array([1, 4 * cells, 16 * cells * cells])
        cell = np.unique(key, return_inverse=True)[1].ravel()
        count, cells = int(cell.max()) + 1, int(0.9 * cells)
    weight = np.bincount(cell, minlength=count)[:, None]
    points = np.stack([np.bincount(cell, column, minlength=count) for column in vertices.T], axis=1) / weight
    corners = cell[faces]
    kept = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    _, first = np.unique(np.sort(corners[kept], axis=1), axis=0, return_index=True)
    return points, corners[kept][np.sort(first)]
