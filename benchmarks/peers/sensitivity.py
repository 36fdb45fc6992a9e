"""How the enclosed volume changes when centres move, weights fixed or refitted.

Inside f < 0, for any parameter p: dV/dp = - integral over the surface of (df/dp) / |grad f| dS. With refitted
weights w the change of the system F w = y adds - mu^T (dF) w with one adjoint solve F mu = dV/dw. Because F
is symmetric, that term needs only the field itself and the field with weights mu, differentiated at the moved
centre.
"""

import numpy as np

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit import assembly
from rbfmuscle.implicit.fit.fitting import Basis
from rbfmuscle.validation import check_points, check_values


def volume_derivative(field, points, areas, *, refit=False):
    """Derivative of the enclosed volume with respect to every centre.

    Parameters
    ----------
    field : RBFField
        Made by `RBFField.fit`, or by `RBFField.fit_hermite` with all derivatives.
    points : (n, 3) array_like
        Quadrature points on the zero set.
    areas : (n,) array_like
        Their weights, adding up to the area.
    refit : bool
        Whether the weights follow (same values and normals at the moved centres), or stay.

    Returns
    -------
    (K, 3) ndarray
        [length^2]. Its sum is zero with refitted weights. With fixed weights it is zero where there is no
        polynomial, which would stay behind. The sum of c_j x dV/dc_j is zero as well for fits to values (the
        normals of a Hermite fit would have to turn along).
    """
    points = check_points(points)
    areas = check_values(areas, len(points), name="areas")
    slope = np.linalg.norm(field.gradient(points), axis=1)
    factor = -areas / slope
    out = _fixed(field, points, factor)
    return out + _through_weights(field, points, factor) if refit else out


def _fixed(field, points, factor):
    """Weights fixed: a term depends on x - c_j, so df/dc_j is minus its own gradient."""
    out = np.empty_like(field.centres)
    for j in range(len(out)):
        term = _alone(field, j)
        out[j] = -factor @ term.gradient(points)
    return out


def _alone(field, j):
    """The field of one centre, without polynomial."""
    return RBFField(
        field.centres[j : j + 1], (field.origin, field.scale), field.kernel, field.epsilon,
        field.weights[j : j + 1], (np.zeros(0), np.zeros((0, 3), dtype=np.int64)), 1.0,
    )  # fmt: skip


def _through_weights(field, points, factor):
    """- mu^T (dF) w for each centre."""
    hermite = field.weights.ndim == 2
    kernel = field.kernel
    shape = field.epsilon * field.scale if kernel.has_epsilon else 1.0
    scaled = (field.centres - field.origin) / field.scale
    degree = int(field.powers.sum(axis=1).max()) if len(field.powers) else -1
    basis = Basis(scaled, kernel, shape, degree, kind="gradient" if hermite else "value")
    right = _responses(basis, (points - field.origin) / field.scale) @ factor
    adjoint = np.linalg.solve(basis.full_matrix(), right)
    weights = adjoint[: basis.size]
    weights = weights.reshape(4, -1).T.copy() if hermite else weights
    other = RBFField(
        field.centres, (field.origin, field.scale), kernel, field.epsilon, weights,
        (adjoint[basis.size :], field.powers), 1.0,
    )  # fmt: skip
    return -(_moved(field, other) + _moved(other, field))


def _moved(field, other):
    """Derivative of sum_k (conditions of field at k) * (weights of other) as centre k moves: (K, 3)."""
    gradient, hessian = field._derivatives(field.centres)
    if other.weights.ndim == 1:
        return other.weights[:, None] * gradient
    slopes = np.einsum("kij,kj->ki", hessian, other.weights[:, 1:]) * field.scale
    return other.weights[:, :1] * gradient + slopes


def _responses(basis, at):
    """Value at each point for a unit weight or coefficient: (size + q, n), scaled coordinates."""
    offsets = at[None] - basis.points[:, None]
    r = np.linalg.norm(offsets, axis=2)
    rows = [basis.kernel.phi(r, basis.epsilon)]
    if basis.kind == "gradient":
        first = basis.kernel.first(r, basis.epsilon)
        rows += [-first * offsets[:, :, axis] for axis in range(3)]
    return np.vstack([*rows, assembly.monomials(at, basis.powers)])
