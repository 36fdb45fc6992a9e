"""A sparse symmetric factor that solves three right sides at once, outside Python's lock."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse.linalg import splu

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled


class SymmetricFactor:
    """L D L^T of a sparse symmetric positive definite matrix, found once.

    Parameters
    ----------
    matrix : (n, n) sparse matrix

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite, as when nothing of the mesh is held.
    """

    def __init__(self, matrix: Any) -> None:
        try:
            lu = splu(
                matrix.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(f"Laplacian is singular ({error}); hold some vertices") from None
        pivots = lu.U.diagonal()
        if not np.array_equal(lu.perm_r, lu.perm_c) or pivots.min() <= 0.0:
            raise np.linalg.LinAlgError("Laplacian is not positive definite; are its weights positive?")
        lower = lu.L.tocsc()
        lower.sort_indices()
        self.start, self.rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
        self.values = lower.data
        self.inverse_pivots = 1.0 / pivots
        self.place = np.asarray(lu.perm_c, dtype=np.int64)

    def solve(self, right: Floats) -> Floats:
        """Solution (n, 3) of matrix @ x = right (n, 3)."""
        out = np.empty_like(right)
        work = np.empty_like(right)
        _solve_loop(self.start, self.rows, self.values, self.inverse_pivots, self.place, right, work, out)
        return out


@compiled
def _solve_loop(start, rows, values, inverse_pivots, place, right, work, out):
    count = len(place)
    for i in range(count):
        work[place[i]] = right[i]
    for j in range(count):
        x, y, z = work[j, 0], work[j, 1], work[j, 2]
        for p in range(start[j], start[j + 1]):
            i = rows[p]
            if i > j:
                work[i, 0] -= values[p] * x
                work[i, 1] -= values[p] * y
                work[i, 2] -= values[p] * z
    for j in range(count - 1, -1, -1):
        x, y, z = (
            work[j, 0] * inverse_pivots[j],
            work[j, 1] * inverse_pivots[j],
            work[j, 2] * inverse_pivots[j],
        )
        for p in range(start[j], start[j + 1]):
            i = rows[p]
            if i > j:
                x -= values[p] * work[i, 0]
                y -= values[p] * work[i, 1]
                z -= values[p] * work[i, 2]
        work[j, 0], work[j, 1], work[j, 2] = x, y, z
    for i in range(count):
        out[i] = work[place[i]]
