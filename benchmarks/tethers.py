"""How near to each other muscles can come that bones carry apart: what their held parts leave them, by length alone."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

TETHERS = 80  # held vertices of a muscle that are looked at, spread over what is held


class Tethered:
    """A muscle whose vertices hang on its held ones by the shortest ways over its surface at rest.

    Parameters
    ----------
    vertices, faces : arrays
        At rest.
    holder : (n,) ndarray
        Name of the bone that holds a vertex, empty where none does.
    """

    def __init__(self, vertices, faces, holder):
        self.vertices, faces = vertices, np.asarray(faces)
        one, other = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
        sides = np.linalg.norm(vertices[one] - vertices[other], axis=1)
        edges = coo_matrix((sides, (one, other)), shape=(len(vertices),) * 2).tocsr()
        self.ends = _spread(vertices, np.flatnonzero(holder != ""))
        self.bones = holder[self.ends]
        self.ways = dijkstra(edges, directed=False, indices=self.ends)

    def carried(self, poses):
        """Where bones have taken the held ends, (e, 3)."""
        turned = np.array([poses[bone] for bone in self.bones])
        return np.einsum("eab,eb->ea", turned[:, :3, :3], self.vertices[self.ends]) + turned[:, :3, 3]


def _spread(vertices, held):
    found = [held[0]]
    away = np.linalg.norm(vertices[held] - vertices[held[0]], axis=1)
    for _ in range(min(TETHERS, len(held)) - 1):
        found.append(held[int(away.argmax())])
        away = np.minimum(away, np.linalg.norm(vertices[held] - vertices[found[-1]], axis=1))
    return np.array(found)


def least_gap(one, other, index, poses, stretch):
    """Distance (n,) from vertices ``index`` of one muscle to any vertex of the other that bones leave at least.

    Between a held end of the one and a held end of the other lie the way to the vertex, the gap, and the way from what
    is met there: where both ways are stretched by the share ``stretch`` and straight, the rest is gap.
    """
    between = np.linalg.norm(one.carried(poses)[:, None] - other.carried(poses)[None], axis=2)
    left = (between[:, :, None] - (1.0 + stretch) * one.ways[:, None, index]).max(axis=0)
    reached = (1.0 + stretch) * other.ways
    return np.array([max((row[:, None] - reached).max(axis=0).min(), 0.0) for row in left.T])
