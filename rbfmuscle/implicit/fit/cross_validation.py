"""Errors of a fit at points it has not seen, in closed form.

Rippa (1999): leaving condition k out changes the prediction there by w_k / (F^-1)_kk with F the full
augmented matrix. For a Hermite fit a centre is left out with all its conditions, and w_k / (F^-1)_kk becomes
a small block solve. The blocks are products of columns of the inverted Cholesky factor, whose inversion takes as many
operations as the factorisation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg
from scipy.spatial import cKDTree

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit import fitting
from rbfmuscle.implicit.fit.lapack import invert_factor
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.implicit.fit.fitting import Basis


# Of the spacing: what an error of one in the left-out normal counts when smoothing is chosen. With less, noisy points
# are best met by smoothing all away, as f = 0 meets them too; with more, the smoothing suits the normals alone.
_SLOPE_SHARE = 0.5


@dataclass(frozen=True)
class Residuals:
    """What leaving each centre out costs.

    Attributes
    ----------
    values : (K,) ndarray
        Predicted minus given value at each left-out centre has this size, in units of the right side.
    slopes : (K, d) ndarray
        Of a Hermite fit, the same for its d derivatives; d = 0 for a fit to values.
    gcv : float
        Generalised cross-validation, n |w|^2 / (tr F^-1)^2.
    averaged : (K, 1 + d) ndarray
        Values and slopes with the mean of all blocks in place of each centre's own: what GCV is made of.
    condition : float
    """

    values: np.ndarray
    slopes: np.ndarray
    gcv: float
    averaged: np.ndarray
    condition: float

    def score(self, criterion: str, lever: float = 0.0) -> float:
        """Root mean square of value and lever times slope, left out ("loo") or averaged ("gcv")."""
        if criterion == "gcv":
            missed, turned = self.averaged[:, 0], self.averaged[:, 1:]
        else:
            missed, turned = self.values, self.slopes
        return math.sqrt((missed**2).mean() + lever**2 * (turned**2).sum(axis=1).mean())


def leave_one_out(basis: Basis, right: Floats, *, smoothing: float = 0.0) -> Residuals:
    """Leave-one-out residuals of a fit, for about the time of two.

    Parameters
    ----------
    basis : fitting.Basis
    right : (size,) ndarray
    smoothing : float

    Returns
    -------
    Residuals
        For Hermite fits each centre is left out with all its conditions.
    """
    factor = fitting.factorise(basis, smoothing)
    solved = factor.solve(right) if factor is not None else None
    if factor is None or solved is None or solved[2] > fitting.DOUBTFUL:
        return _from_eigenvectors(basis, right, smoothing)
    weights, _, condition = solved
    count = len(basis.points)
    invert_factor(factor.lower)
    blocks = np.empty((count, basis.size // count, basis.size // count))
    _blocks_loop(factor.lower.T, blocks)
    if len(basis.powers):  # F^-1 = M^-1 - Q Q^T / gamma
        parts = factor.directions.reshape(-1, count, len(basis.powers))
        blocks -= np.einsum("akq,bkq->kab", parts, parts) / factor.gamma
    return _residuals(blocks, weights, count, condition)


@compiled(fastmath={"reassoc", "contract"})
def _blocks_loop(columns, blocks):
    """blocks[k] = (G^T G) at the conditions of centre k, with row i of columns the i-th column of the lower G."""
    count, kinds = blocks.shape[0], blocks.shape[1]
    for k in range(count):
        for b in range(kinds):
            j = b * count + k
            second = columns[j, j:]
            for a in range(b + 1):
                first = columns[a * count + k, j:]
                total = 0.0
                for m in range(first.size):
                    total += first[m] * second[m]
                blocks[k, a, b] = total
                blocks[k, b, a] = total


def _residuals(blocks: Floats, weights: Floats, count: int, condition: float) -> Residuals:
    per_centre = weights.reshape(-1, count).T
    residuals = np.linalg.solve(blocks, per_centre[:, :, None])[:, :, 0]
    averaged = np.linalg.solve(blocks.mean(axis=0), per_centre.T).T
    trace = np.trace(blocks, axis1=1, axis2=2).sum()
    gcv = weights.size * float(weights @ weights) / trace**2
    return Residuals(residuals[:, 0], residuals[:, 1:], gcv, averaged, condition)


def _from_eigenvectors(basis: Basis, right: Floats, smoothing: float) -> Residuals:
    """The same where Cholesky fails: F^-1 without its smallest eigenvalues."""
    count, size = len(basis.points), basis.size
    values, vectors = linalg.eigh(basis.full_matrix(smoothing), driver="evd")
    sizes = np.abs(values)
    keep = sizes > 1e-14 * sizes.max()
    rows = vectors[:size, keep]
    weights = rows @ ((rows.T @ right) / values[keep])
    parts = rows.T.reshape(rows.shape[1], -1, count)
    blocks = np.einsum("mak,m,mbk->kab", parts, 1 / values[keep], parts, optimize=True)
    # a truncated inverse can lose a block: keep it invertible
    blocks += np.eye(blocks.shape[1]) * np.abs(blocks).max() * 1e-15
    return _residuals(blocks, weights, count, sizes.max() / max(sizes.min(), 1e-300))


class LeastSquaresPath:
    """Residuals of a truncated least-squares fit for any Tikhonov term, by one singular value decomposition.

    Parameters
    ----------
    matrix : (n, m) ndarray
        Collocation matrix, n > m.
    right : (n,) ndarray
    cutoff : float
        Share of the greatest singular value below which one is left out.

    Attributes
    ----------
    span : (float, float)
        Smoothing below which rounding rules and above which nothing is left to fit.
    lever : float
        Weight of slopes among the residuals: there are none.
    """

    lever = 0.0

    def __init__(self, matrix: Floats, right: Floats, *, cutoff: float = 1e-14) -> None:
        left, values, _ = linalg.svd(matrix, full_matrices=False)
        keep = values > cutoff * values[0]
        self._left, self._squares, self._right = left[:, keep], values[keep] ** 2, right
        self._along = self._left.T @ right
        self.condition = float(values[0] / max(values[-1], 1e-300))
        self.span = 1e-28 * self._squares[0], self._squares[0]

    def residuals(self, smoothing: float) -> Residuals:
        """Leave-one-out residuals (y - Hy)_k / (1 - H_kk) and GCV with a Tikhonov term (`solve_least_squares`)."""
        damp = self._squares / (self._squares + smoothing)
        residual = self._right - self._left @ (damp * self._along)
        rest = np.maximum(1 - (self._left * self._left) @ damp, np.finfo(float).eps)
        mean = rest.mean()
        gcv = float(residual @ residual) / (len(residual) * mean**2)
        empty = np.zeros((len(residual), 0))
        return Residuals(residual / rest, empty, gcv, (residual / mean)[:, None], self.condition)


class SmoothingPath:
    """Residuals of a fit for any smoothing, by one eigen-decomposition.

    With Z a basis of the weights that annihilate polynomials and Z^T A Z = U diag(e) U^T, the block of the augmented
    inverse that belongs to the weights is V diag(1 / (e + smoothing)) V^T, V = Z U.

    Parameters
    ----------
    basis : fitting.Basis
    right : (size,) ndarray

    Attributes
    ----------
    span : (float, float)
        As in `LeastSquaresPath`.
    lever : float
        Weight of slopes among the residuals, 0 for a fit to values.
    """

    def __init__(self, basis: Basis, right: Floats) -> None:
        count, size, q = len(basis.points), basis.size, len(basis.powers)
        if size == q:
            raise UsageError(
                f"{size} conditions and {q} polynomial terms leave nothing to smooth; set smoothing to 0"
            )
        full = basis.full_matrix()[:size, :size]
        null = linalg.qr(basis.polynomials.T)[0][:, q:] if q else np.eye(size)
        values, vectors = linalg.eigh(null.T @ full @ null, driver="evd")
        self._values, self._vectors = np.maximum(values, 0.0), null @ vectors
        self._along = self._vectors.T @ right
        self._parts = self._vectors.T.reshape(len(values), -1, count)
        self.span = 1e-14 * values[-1], values[-1]
        self.lever = 0.0
        if basis.kind != "value" and count > 1:
            self.lever = _SLOPE_SHARE * cKDTree(basis.points).query(basis.points, k=2)[0][:, 1].mean()

    def residuals(self, smoothing: float) -> Residuals:
        """`Residuals` with a given smoothing above 0."""
        damp = 1.0 / (self._values + smoothing)
        weights = self._vectors @ (damp * self._along)
        rows = range(self._parts.shape[1])
        damped = self._parts * damp[:, None, None]
        blocks = [[np.einsum("mk,mk->k", damped[:, a], self._parts[:, b]) for b in rows] for a in rows]
        condition = float((self._values[-1] + smoothing) / (self._values[0] + smoothing))
        return _residuals(np.array(blocks).transpose(2, 0, 1), weights, self._parts.shape[2], condition)
