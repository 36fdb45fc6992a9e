"""A closed triangulation that goes with the material: its topology, its edges, the neighbours of its vertices."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.jit import compiled


class MaterialMesh:
    """A closed triangulation of fixed topology: vertices (n, 3) at rest, outward faces (m, 3).

    Attributes
    ----------
    start, other : CSR lists of neighbours.
    slope : (n,) ndarray or None
        The field's slope at the vertices at rest; where it sinks, sheets have met and the field is not to be trusted.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.slope: Floats | None = None
        self.tree = FaceTree(vertices, faces)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        ends = np.concatenate([self.faces[:, :2], self.faces[:, 1:], self.faces[:, ::2]])
        pairs = np.unique(np.concatenate([ends @ (len(vertices), 1), ends @ (1, len(vertices))]))
        self.other = pairs % len(vertices)
        self.start = np.searchsorted(pairs, len(vertices) * np.arange(len(vertices) + 1))

    def edge(self, vertices: Floats) -> float:
        """Mean length of an edge [scene unit]."""
        return _edges_loop(vertices, self.faces)[0]

    def longest(self, vertices: Floats) -> float:
        """Greatest length of an edge [scene unit]."""
        return _edges_loop(vertices, self.faces)[1]

    def smooth(self, vertices: Floats, rows: Integers, sweeps: int) -> None:
        """Move vertices towards the mean of their neighbours, in place, so many times."""
        for _ in range(sweeps):
            _smooth_loop(vertices, rows, self.start, self.other)

    def around(self, marked: Booleans, rings: int) -> Booleans:
        """Mask (n,) of the vertices within some rings of marked ones."""
        for _ in range(rings):
            grown = marked.copy()
            grown[self.other[np.repeat(marked, np.diff(self.start))]] = True
            marked = grown
        return marked


@compiled(error_model="numpy")
def _edges_loop(vertices, faces):
    """Mean and greatest length of the edges."""
    total, greatest = 0.0, 0.0
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            square = 0.0
            for d in range(3):
                square += (vertices[a, d] - vertices[b, d]) ** 2
            length = np.sqrt(square)
            total += length
            greatest = max(greatest, length)
    return total / (3.0 * len(faces)), greatest


@compiled(error_model="numpy")
def _smooth_loop(vertices, rows, start, other):
    """Half the way to the mean of the neighbours, one vertex after the other."""
    for v in rows:
        x, y, z = 0.0, 0.0, 0.0
        for n in range(start[v], start[v + 1]):
            x += vertices[other[n], 0]
            y += vertices[other[n], 1]
            z += vertices[other[n], 2]
        count = start[v + 1] - start[v]
        vertices[v, 0] = 0.5 * (vertices[v, 0] + x / count)
        vertices[v, 1] = 0.5 * (vertices[v, 1] + y / count)
        vertices[v, 2] = 0.5 * (vertices[v, 2] + z / count)
