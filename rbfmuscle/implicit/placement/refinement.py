"""Centres and normals that fit the whole surface in the least-squares sense, not only where the
centres lie.

A Hermite field is linear in the values v_j and gradients g_j asked for at its centres. Here these
are what makes the field smallest at many points of the surface; a centre of value v_j then moves by
-v_j along its normal, so that the field is still one of zeros and unit normals.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg
from scipy.spatial.distance import cdist

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.implicit.fit.assembly import Basis
from rbfmuscle.implicit.fit.fitting import bounding_ridge
from rbfmuscle.implicit.placement.sampling import SurfaceSample, spread_points
from rbfmuscle.implicit.selection import spacing, surface_error
from rbfmuscle.validation import UsageError

# Name of this placement of centres beside those of `sampling.PLACEMENTS`.
FITTED = "fitted"
# What moving a centre counts beside a miss of the same size at a sample, each on average over its
# kind; turning a normal by one counts as moving by the spacing. Half of it lets thin rims swell,
# more of it gives accuracy away.
STIFFNESS = 0.1
ROUNDS = 3
SAMPLES = 4000
_CHUNK = 1000


def fit_sample(
    sample: SurfaceSample, vertices: ArrayLike, faces: ArrayLike, *, fit: FieldFit, seed: int = 0
) -> SurfaceSample:
    """Centres moved along their normals, and normals turned, so that the field is small on the
    whole mesh.

    ``sample`` is one of the mesh (vertices (n, 3), faces (m, 3)) with unit normals, ``fit`` that of
    the field that will be fitted to it; ``seed`` is that of points of the mesh. The least-squares
    problem is that of the given centres; what their moves leave is met by further rounds of it.
    Returns the sample of the round, the given one included, whose field misses the mesh least.
    UsageError for a kernel that is not smooth enough.
    """
    if not fit.kernel.hermite:
        raise UsageError(f"kernel '{fit.kernel.name}' has no Hermite fit: take greedy centres")
    where, _ = spread_points(np.asarray(vertices), np.asarray(faces), SAMPLES, seed=seed)
    points, normals = sample.points, sample.normals
    reach = float(spacing(points).mean())

    def fitted(points: Floats, normals: Floats) -> tuple[Floats, float]:
        field = fit.fit(points, normals)
        return field(where), surface_error(field, where, reach)

    value, least = fitted(points, normals)
    best, problem = sample, _problem(points, normals, where, fit, reach)
    for _ in range(ROUNDS):
        points, normals = _step(points, normals, value, problem)
        value, now = fitted(points, normals)
        if now < least:
            best, least = replace(sample, points=points, normals=normals), now
    return best


class _Problem(NamedTuple):
    """Linear least squares for values and gradients at the centres; they change too little for
    another matrix.
    """

    cardinal: (
        np.ndarray
    )  # (4K, n), values at the samples for unit values and gradients: of order one
    factor: tuple[np.ndarray, bool]  # of its normal matrix
    scale: float


def _problem(
    points: Floats, normals: Floats, samples: Floats, fit: FieldFit, reach: float
) -> _Problem:
    """The problem of some centres."""
    count = len(points)
    basis = Basis(points, fit.kernel, fit.epsilon, hermite=True)
    scaled, scale = (samples - basis.origin) / basis.scale, float(basis.scale[0])
    full = basis.full_matrix()
    if math.isfinite(fit.condition):
        full[np.diag_indices(basis.size)] += bounding_ridge(basis, fit.condition)
    factor = linalg.lu_factor(full, overwrite_a=True, check_finite=False)
    cardinal = np.empty((basis.size, len(scaled)), order="F")
    for low in range(0, len(scaled), _CHUNK):
        rows = _rows(basis, scaled[low : low + _CHUNK])
        found = linalg.lu_solve(factor, rows.T, trans=1, check_finite=False)
        cardinal[:, low : low + _CHUNK] = found[: basis.size]
    matrix = cardinal @ cardinal.T
    weight = np.full(basis.size, STIFFNESS)
    weight[count:] *= reach / scale  # derivatives are by scaled coordinates
    matrix[np.diag_indices(basis.size)] += weight**2 * len(samples) / count
    return _Problem(
        cardinal, linalg.cho_factor(matrix, overwrite_a=True, check_finite=False), scale
    )


def _step(
    points: Floats, normals: Floats, value: Floats, problem: _Problem
) -> tuple[Floats, Floats]:
    """Centres and normals after the change that undoes most of the values (n,) at the samples."""
    count = len(points)
    change = linalg.cho_solve(problem.factor, problem.cardinal @ -value, check_finite=False)
    gradients = normals + change[count:].reshape(3, count).T / problem.scale
    size = np.linalg.norm(gradients, axis=1)
    turned = gradients / size[:, None]
    return points - (change[:count] / size)[:, None] * turned, turned


def _rows(basis: Basis, at: Floats) -> Floats:
    """Rows (n, size + q) of the field at scaled points: for the weights a, B and the polynomial."""
    kernel = basis.kernel
    points = basis.points[0].T
    epsilon = float(basis.epsilon[0])
    offset, r = at[:, None, :] - points, cdist(at, points)
    first = kernel.first(r, epsilon)
    parts = [kernel.phi(r, epsilon), *(-first * offset[:, :, k] for k in range(3))]
    return np.hstack([*parts, np.prod(at[:, None] ** basis.powers, axis=2)])
