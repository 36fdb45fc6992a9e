"""Fits with compactly supported kernels whose centres have few neighbours in reach.

The centres are numbered so that neighbours are close in number (reverse Cuthill and McKee 1969), all conditions of a
centre side by side. The matrix is then a band, and its Cholesky factorisation takes (unknowns) (width)^2 operations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.fit.condition import largest_eigenvalue, probe

if TYPE_CHECKING:
    from rbfmuscle.implicit.fit.fitting import Basis


_FEWEST = {"value": 800, "normal": 300, "gradient": 300}
_NEIGHBOURS = {"value": 0.04, "normal": 0.08, "gradient": 0.12}
"""Neighbours in reach, as a share of the centres, up to which a band is faster (`benchmarks/interpolation.py`)."""
_WIDTH = 0.45
"""The same of the width of the band, in centres."""


@dataclass(frozen=True)
class BandFactor:
    """Cholesky factor of a band matrix.

    Attributes
    ----------
    band : (width + 1, size) ndarray
        LAPACK's lower band storage.
    order : (size,) ndarray
        Unknown of the basis at each place of the band.
    norm : float
        Estimate of the largest eigenvalue of the matrix.
    """

    band: np.ndarray
    order: np.ndarray
    norm: float

    def solve(self, right: Floats) -> tuple[Floats, Floats, float]:
        """Weights (size,), no coefficients (0,), and an estimate of the condition."""
        block = np.empty((len(right), 2), order="F")
        block[:, 0] = right[self.order]
        block[:, 1] = probe(self.band[0])
        block, _ = lapack.dpbtrs(self.band, block, lower=1, overwrite_b=1)
        weights = np.empty(len(right))
        weights[self.order] = block[:, 0]
        return weights, np.zeros(0), self.norm * math.sqrt(block[:, 1] @ block[:, 1])


def factorise_band(basis: Basis, smoothing: float = 0.0) -> BandFactor | None:
    """Factor of A + smoothing I as a band, where that is faster than as a full matrix.

    Parameters
    ----------
    basis : fitting.Basis
    smoothing : float

    Returns
    -------
    BandFactor or None
        None where the kernel is not compact, a polynomial is added, too many centres are in reach of each
        other, or the matrix is not definite in floating-point numbers.
    """
    count = len(basis.points)
    if not basis.kernel.compact or len(basis.powers) or count < _FEWEST[basis.kind]:
        return None
    tree, reach = cKDTree(basis.points), 1.0 / basis.epsilon
    some = basis.points[:: max(1, count // 20)]
    if tree.query_ball_point(some, reach, return_length=True).mean() > _NEIGHBOURS[basis.kind] * count:
        return None
    pairs = tree.query_pairs(reach, output_type="ndarray")
    place = _places(pairs, count)
    width = int(np.abs(place[pairs[:, 0]] - place[pairs[:, 1]]).max(initial=0))
    if width > _WIDTH * count:
        return None
    band, order = _band(basis, pairs, place, width, smoothing)
    norm = largest_eigenvalue(
        basis.size, lambda vector: blas.dsbmv(len(band) - 1, 1.0, band, vector, lower=1)
    )
    band, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
    return None if info else BandFactor(band, order, norm)


def _places(pairs: Integers, count: int) -> Integers:
    """New number of each centre."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    graph = sparse.csr_array((np.ones(len(both), np.int8), (both[:, 0], both[:, 1])), shape=(count, count))
    place = np.empty(count, dtype=np.int64)
    place[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(count)
    return place


def _band(
    basis: Basis, pairs: Integers, place: Integers, width: int, smoothing: float
) -> tuple[Floats, Integers]:
    """Band storage ((width + 1) kinds, size) and the unknown at each place."""
    count = len(basis.points)
    kinds = basis.size // count
    band = np.zeros(((width + 1) * kinds, basis.size), order="F")
    swap = place[pairs[:, 0]] < place[pairs[:, 1]]
    late, early = np.where(swap[:, None], pairs[:, ::-1], pairs).T
    blocks = _pair_blocks(basis, late, early)
    for a in range(kinds):
        for b in range(kinds):
            row, column = kinds * place[late] + a, kinds * place[early] + b
            band[row - column, column] = blocks[a][b]
    own = _pair_blocks(basis, np.array([0]), np.array([0]))
    for a in range(kinds):
        band[0, a::kinds] = own[a][a] + smoothing
    order = np.empty(basis.size, dtype=np.int64)
    for a in range(kinds):
        order[kinds * place + a] = a * count + np.arange(count)
    return band, order


def _pair_blocks(basis: Basis, i: Integers, j: Integers) -> list[list[Floats]]:
    """Entries [a][b] (pairs,) between condition a of centre i and condition b of centre j; see `assembly`."""
    kernel, epsilon = basis.kernel, basis.epsilon
    d = (basis.points[i] - basis.points[j]).T
    r = np.sqrt((d * d).sum(axis=0))
    phi = kernel.phi(r, epsilon)
    if basis.kind == "value":
        return [[phi]]
    first = kernel.first(r, epsilon)
    second = np.zeros_like(r)
    second[r > 0] = kernel.second(r[r > 0], epsilon)
    if basis.kind == "normal":
        at, to = basis.normals[i].T, basis.normals[j].T
        out, back = (d * at).sum(axis=0), (d * to).sum(axis=0)
        return [[phi, -first * back], [first * out, -(first * (at * to).sum(axis=0) + second * out * back)]]
    rows = [[phi, *(-first * d)]]
    for c in range(3):
        slopes = [-((first if c == e else 0.0) + second * d[c] * d[e]) for e in range(3)]
        rows.append([first * d[c], *slopes])
    return rows
