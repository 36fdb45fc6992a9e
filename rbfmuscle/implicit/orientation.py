"""Normals of points that have none, by the energy of the field itself (variational implicit surfaces).

Huang, Carr and Ju (2019): among the Hermite fields with f = 0 and a unit gradient at every point the one of least
energy is taken. With all gradients g free the energy is g^T H g, H the block of the inverted Hermite matrix of the
gradients; it is made small over unit vectors from the smallest eigenvectors of H on. No neighbours are asked, so that
thin sheets and sparse points are oriented where planes through neighbours fail.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg
from scipy.optimize import minimize
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import Basis, factorise, raise_if_singular
from rbfmuscle.implicit.fit.systems import frame
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.partition import split_points
from rbfmuscle.validation import UsageError, check_points

# The kernel whose energy is made small, and that whose energy settles directions: normals at thin rims turn by less.
KERNEL, SMOOTHER = "cubic", "septic"
# Points that are oriented together; a matrix of (4 x 2,000)^2 numbers takes 0.5 GB.
TOGETHER, FEWEST = 2000, 10
# Eigenvectors from which the energy is made small, and points up to which more than one is.
STARTS, SEVERAL = 3, 700
ITERATIONS = 300
# Larger sets: points of the skeleton that is oriented together, and of each part with what overlaps.
SKELETON, PART, AROUND = 1000, 150, 300


def orient_points(
    points: ArrayLike, *, together: int = TOGETHER, progress: Callable[[int, int], None] | None = None
) -> Floats:
    """Unit normals, outward, of points of a closed surface.

    Parameters
    ----------
    points : (n, 3) array_like
        At least 10, no two of them the same [length].
    together : int
        Points that are oriented as one. Larger sets are by parts: some points spread over all of them first, then the
        others with their neighbours from where the field through those points says.
    progress : callable, optional
        Called as ``progress(done, total)`` with parts.

    Returns
    -------
    (n, 3) ndarray

    Raises
    ------
    UsageError
        For too few points.
    numpy.linalg.LinAlgError
        If points coincide or lie in a plane.
    """
    points = check_points(points)
    if len(points) < FEWEST:
        raise UsageError(f"at least {FEWEST} points are needed to tell a closed surface, got {len(points)}")
    if len(points) <= together:
        return _outward(points, _least_energy(points, None))
    return _by_parts(points, min(SKELETON, together), progress)


def energy_matrix(points: Floats, kernel: str = KERNEL) -> Floats:
    """H (3n, 3n) of the energy g^T H g, gradients by coordinates: (x of all, y of all, z of all).

    Parameters
    ----------
    points : (n, 3) ndarray
    kernel : str
        One without a shape parameter.
    """
    origin, scale = frame(points)
    chosen = get_kernel(kernel)
    basis = Basis((points - origin) / scale, chosen, 1.0, chosen.degree, kind="gradient")
    factor = factorise(basis)
    if factor is None:
        raise_if_singular(basis)
        raise np.linalg.LinAlgError("the points all but coincide; thin them out")
    n = len(points)
    # with the values first, the last block of the inverse is that of the last block of the factor alone
    block, failed = linalg.lapack.dpotri(np.asfortranarray(factor.lower[n:, n:]), lower=1, overwrite_c=1)
    if failed:
        raise np.linalg.LinAlgError("the points all but coincide; thin them out")
    directions, gamma = np.asfortranarray(factor.directions[n:]), factor.gamma
    del factor
    block = linalg.blas.dsyrk(-1.0 / gamma, directions, beta=1.0, c=block, lower=1, overwrite_c=1)
    return np.tril(block)  # above the diagonal stands whatever was in memory


def _least_energy(points: Floats, start: Floats | None) -> Floats:
    """Unit vectors (n, 3) of least energy, from the given ones or from the smallest eigenvectors."""
    lower = energy_matrix(points)
    starts = [start] if start is not None else _eigenvectors(lower, STARTS if len(points) <= SEVERAL else 1)
    found = min((_descend(lower, vectors) for vectors in starts), key=lambda pair: pair[0])[1]
    del lower  # a second matrix of the size
    try:
        return _descend(energy_matrix(points, SMOOTHER), found)[1]
    except np.linalg.LinAlgError:
        # Of higher degree, which points on a quadric or in a part of a plane do not determine.
        return found


def _eigenvectors(lower: Floats, count: int) -> list[Floats]:
    """The smallest eigenvectors of H, as vectors (n, 3)."""
    size = len(lower)
    shifted = lower.copy(order="F")
    shifted[np.diag_indices(size)] += 1e-10 * np.trace(lower) / size
    factor = linalg.cho_factor(shifted, lower=True, overwrite_a=True, check_finite=False)
    inverse = LinearOperator(
        (size, size), matvec=lambda v: linalg.cho_solve(factor, v, check_finite=False), dtype=float
    )
    rng = np.random.default_rng(0)
    _, vectors = eigsh(inverse, k=count, which="LA", v0=rng.normal(size=size), tol=1e-4)
    return [vectors[:, k].reshape(3, -1).T for k in range(count - 1, -1, -1)]


def _descend(lower: Floats, vectors: Floats) -> tuple[float, Floats]:
    """Energy and unit vectors at a minimum."""
    n = len(vectors)

    def energy(flat: Floats) -> tuple[float, Floats]:
        u = flat.reshape(n, 3)
        length = np.maximum(np.linalg.norm(u, axis=1), 1e-12)
        g = u / length[:, None]
        pull = linalg.blas.dsymv(1.0, lower, g.T.ravel(), lower=1).reshape(3, n).T
        slope = 2.0 * (pull - (pull * g).sum(axis=1)[:, None] * g) / length[:, None]
        return float((g * pull).sum()), slope.ravel()

    length = np.linalg.norm(vectors, axis=1)
    # short ones keep a length of their own, so that the first steps turn them more than the others
    begin = vectors / np.maximum(length, 0.1 * np.median(length))[:, None]
    found = minimize(
        energy, begin.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS, "maxcor": 12}
    )
    u = found.x.reshape(n, 3)
    return float(found.fun), u / np.linalg.norm(u, axis=1)[:, None]


def _outward(points: Floats, normals: Floats) -> Floats:
    """All normals turned if the field through some of the points is negative far outside."""
    few = np.linspace(0, len(points) - 1, min(len(points), SKELETON)).astype(int)
    field = RBFField.fit_hermite(points[few], normals[few], kernel=KERNEL)
    origin, scale = frame(points)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    around = origin + 2.0 * scale / math.sqrt(3.0) * np.concatenate([corners, np.eye(3), -np.eye(3)])
    return normals if np.median(field(around)) > 0.0 else -normals


def _by_parts(points: Floats, skeleton: int, progress: Any) -> Floats:
    """A skeleton together, then parts with their neighbours from the gradient of the skeleton's field."""
    few = _spread(points, skeleton)
    normals = _outward(points[few], _least_energy(points[few], None))
    guess = RBFField.fit_hermite(points[few], normals, kernel=KERNEL).gradient(points)
    guess /= np.maximum(np.linalg.norm(guess, axis=1), 1e-12)[:, None]
    guess[few] = normals
    tree, out = cKDTree(points), guess.copy()
    parts = split_points(points, PART)
    for number, part in enumerate(parts):
        around = tree.query(points[part].mean(axis=0), k=min(AROUND, len(points)))[1]
        some = np.union1d(part, around)
        better = _least_energy(points[some], guess[some])
        better *= np.where((better * guess[some]).sum() < 0.0, -1.0, 1.0)
        out[part] = better[np.searchsorted(some, part)]
        if progress is not None:
            progress(number + 1, len(parts))
    return out


def _spread(points: Floats, count: int) -> Integers:
    """Farthest points, one after another: (count,)."""
    chosen = np.zeros(count, dtype=np.int64)
    distance = ((points - points[0]) ** 2).sum(axis=1)
    for k in range(1, count):
        chosen[k] = int(np.argmax(distance))
        distance = np.minimum(distance, ((points - points[chosen[k]]) ** 2).sum(axis=1))
    return chosen
