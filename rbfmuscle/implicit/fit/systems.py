"""The systems behind fits: coordinates that they are scaled to, their matrices and right sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.fitting import Basis
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.implicit.kernels.table import Kernel


def frame(points: Floats) -> tuple[Floats, float]:
    """Origin (3,) and scale: the points lie in the unit ball of (x - origin) / scale."""
    if not len(points):
        raise UsageError("a fit needs at least one point, got none")
    origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = float(np.sqrt(((points - origin) ** 2).sum(axis=1).max()))
    return origin, scale if scale > 0 else 1.0


def hermite_system(
    points: Floats, normals: Floats, kernel: Kernel, epsilon: float, derivatives: str
) -> tuple[Basis, Floats, Floats, float]:
    """Basis, right side, origin and scale of a Hermite fit (arguments as in `RBFField.fit_hermite`)."""
    origin, scale = frame(points)
    shape = epsilon * scale if kernel.has_epsilon else 1.0
    scaled = (points - origin) / scale
    if derivatives == "all":
        basis = Basis(scaled, kernel, shape, kind="gradient")
        return basis, np.concatenate([np.zeros(len(points)), normals.T.ravel()]) * scale, origin, scale
    lengths = np.linalg.norm(normals, axis=1)
    if not lengths.all():
        raise UsageError(f"normals must not be zero, row {int(np.argmin(lengths))} is")
    unit = normals / lengths[:, None]
    basis = Basis(scaled, kernel, shape, kind="normal", normals=unit)
    return basis, np.concatenate([np.zeros(len(points)), lengths]) * scale, origin, scale


def hermite_weights(basis: Basis, weights: Floats) -> Floats:
    """Rows (a, B) for each centre from the solution of a Hermite system: (K, 4)."""
    if basis.kind == "gradient":
        return weights.reshape(4, -1).T.copy()
    value, along = weights.reshape(2, -1)
    return np.column_stack([value, along[:, None] * basis.normals])


def check_count(kernel: Kernel, count: int) -> None:
    """Raise LinAlgError where a kernel's polynomial has more terms than there are points."""
    degree = kernel.degree
    terms = (degree + 1) * (degree + 2) * (degree + 3) // 6
    if terms > count:
        raise np.linalg.LinAlgError(
            f"degree {degree} of kernel '{kernel.name}' has {terms} polynomial terms, more than the {count} points; "
            "degree too high: use a kernel of lower order or add points"
        )
