"""Points that go with the nodes of a lattice, all those of a cell together."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.jit import compiled


class Carrier:
    """Points as sums of their nodes, by ``columns`` (n, k) and shape functions ``shares`` (n, k).

    The points of a cell have the same nodes, so loops over them read memory in its order.
    """

    def __init__(self, columns: Integers, shares: Floats) -> None:
        self._nodes, cell = np.unique(columns, axis=0, return_inverse=True)
        cell = cell.ravel()
        self._order = np.argsort(cell, kind="stable")
        self._start = np.searchsorted(cell[self._order], np.arange(len(self._nodes) + 1))
        self._shares = np.ascontiguousarray(shares[self._order].T)

    def carry(self, y: Floats) -> Floats:
        """Places (n, 3) for nodes (N, 3)."""
        out = np.empty((len(self._order), 3))
        _cells_loop(y, self._start, self._nodes, self._shares, self._order, out)
        return out


@compiled(error_model="numpy", fastmath={"contract"})
def _cells_loop(y, start, nodes, shares, order, out):
    """Places of all points, cell by cell."""
    most = 0
    for c in range(len(nodes)):
        most = max(most, start[c + 1] - start[c])
    sums = np.empty((3, most))
    for c in range(len(nodes)):
        first, count = start[c], start[c + 1] - start[c]
        sums[:, :count] = 0.0
        for k in range(nodes.shape[1]):
            some, j = shares[k, first : first + count], nodes[c, k]
            for a in range(3):
                total, node = sums[a], y[j, a]
                for s in range(count):
                    total[s] += some[s] * node
        for s in range(count):
            for a in range(3):
                out[order[first + s], a] = sums[a, s]
