"""Points that hang on nodes: each is a sum of some of them."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.loops import loop


class Embedding(NamedTuple):
    """Points (n,) as sums of k nodes each."""

    columns: Integers  # (n, k)
    shares: Floats  # (n, k)

    def of(self, values: Floats) -> Floats:
        """Sums (n, 3) of values (N, 3) at the nodes."""
        out = np.empty((len(self.columns), 3))
        carry(self.columns, self.shares, values, out)
        return out

    def some(self, chosen: Integers) -> "Embedding":
        """Those of some of the points."""
        return Embedding(self.columns[chosen], self.shares[chosen])


@loop(fastmath={"contract"})
def carry(columns, shares, nodes, out):
    """Fill the places (n, 3) of points that are sums of nodes, Σ_k shares_k nodes_k."""
    for i in range(len(columns)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(columns.shape[1]):
            share = shares[i, k]
            n = columns[i, k]
            x += share * nodes[n, 0]
            y += share * nodes[n, 1]
            z += share * nodes[n, 2]
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z
