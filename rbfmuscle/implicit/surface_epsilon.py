"""Choosing epsilon for a surface that is at hand: the error is measured on it, and the zero set is looked at."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import blas

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.condition import largest_eigenvalue
from rbfmuscle.implicit.fit.fitting import Basis
from rbfmuscle.implicit.fit.systems import frame, hermite_system
from rbfmuscle.implicit.kernels.table import Kernel, get_kernel
from rbfmuscle.implicit.placement.off_surface import off_surface_points
from rbfmuscle.implicit.selection import (
    SPAN,
    EpsilonChoice,
    by_worth,
    choose_epsilon,
    spacing,
    surface_miss,
)
from rbfmuscle.implicit.shape_search import RIDGE, TRUNCATED, Limits, search_shape
from rbfmuscle.implicit.zero_sets import look_at_zero_sets
from rbfmuscle.validation import check_points

# Evaluations of the scan and of the refinement. Flat Gaussians close their surface in spans of a factor of 1.3 only.
COARSE, REFINE = 25, 6
# Ridge, as a share of the largest eigenvalue: near the least that Cholesky can take, so that what it smooths is what
# the truncated solution does.
RIDGE_SHARE = 3e-13


def choose_surface_epsilon(
    points: ArrayLike,
    normals: ArrayLike,
    *,
    kernel: Kernel | str,
    held_out: ArrayLike | None = None,
    distance: Callable[..., Any] | None = None,
    criterion: str | None = None,
    derivatives: str = "all",
    limits: Limits | None = None,
) -> EpsilonChoice:
    """Search epsilon for `RBFField.fit_surface`, whatever the kernel.

    Parameters
    ----------
    points, normals : (K, 3) array_like
    kernel : str or Kernel
    held_out : (n, 3) array_like, optional
        Other points of the surface, spread evenly over it.
    distance : callable, optional
        ``(n, 3) -> (n,)``, distance to the surface, signed or not. With it the zero set of the best epsilon is
        extracted: held-out points on the surface say nothing of sheets that leave it. Where the zero set is open, or
        further from the surface than the held-out points from it, the next best is looked at.
    criterion : {"held_out", "loo", "gcv", "condition"}, optional
        "held_out" where such points are given, else "loo".
    derivatives
        As in `RBFField.fit_surface`.
    limits : Limits, optional
        Of a search by held-out points: fits, seconds, and the condition of what is chosen.

    Returns
    -------
    EpsilonChoice
        Where the zero set was looked at, the objective is the root mean square distance both ways.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where no epsilon can be fitted, or none within the bound of the condition.
    """
    kernel, points, normals = get_kernel(kernel), np.asarray(points), np.asarray(normals)
    criterion = criterion or ("loo" if held_out is None else "held_out")
    if kernel.hermite:
        data: dict[str, Any] = {"points": points, "normals": normals, "derivatives": derivatives}
    else:
        where, values = off_surface_points(points, normals)
        data = {"points": where, "values": values}
    # Points off the surface lie closer than those on it, which decide how far a kernel must reach.
    ratio = spacing(data["points"]).mean() / spacing(points).mean()
    span = (SPAN[0] * ratio, SPAN[1] * ratio)
    if criterion != "held_out" or held_out is None:
        return choose_epsilon(
            **data,
            kernel=kernel,
            criterion=criterion,
            held_out=held_out,
            span=span,
            coarse=COARSE,
            refine=REFINE,
        )
    limits, unit = limits or Limits(), 1.0 / spacing(data["points"]).mean()
    others, reach = check_points(held_out, name="held_out"), spacing(points).mean()

    fields: dict[float, RBFField] = {}  # those without a ridge, which the looks ask for again

    def fit(epsilon: float, how: str = TRUNCATED) -> RBFField:
        if how != RIDGE and epsilon in fields:
            return fields[epsilon]
        ridge = _ridge(data, kernel, epsilon) if how == RIDGE else 0.0
        found = RBFField.fit_surface(
            points, normals, kernel=kernel, epsilon=epsilon, derivatives=derivatives, smoothing=ridge,
            truncate=how == TRUNCATED, condition=limits.bound,
        )  # fmt: skip
        if how != RIDGE:
            fields[epsilon] = found
        return found

    def miss(field: RBFField) -> float:
        return surface_miss(field, others, reach)

    def error(epsilon: float, how: str) -> tuple[float, float]:
        field = fit(epsilon, how)
        return miss(field), field.condition

    each = {"all": 4, "normal": 2}[derivatives] if kernel.hermite else 3
    tried = search_shape(
        error, (span[0] * unit, span[1] * unit), refine=REFINE, size=each * len(points), limits=limits
    )
    choice = _best_within(tried, kernel, limits)
    return choice if distance is None else look_at_zero_sets(choice, limits, fit, miss, points, distance)


def _ridge(data: dict[str, Any], kernel: Kernel, epsilon: float) -> float:
    """What must be added to the diagonal for a condition that Cholesky can take."""
    if "normals" in data:
        basis = hermite_system(data["points"], data["normals"], kernel, epsilon, data["derivatives"])[0]
    else:
        origin, scale = frame(data["points"])
        basis = Basis((data["points"] - origin) / scale, kernel, epsilon * scale, kernel.degree)
    matrix = basis.matrix()
    return RIDGE_SHARE * largest_eigenvalue(basis.size, lambda v: blas.dsymv(1.0, matrix, v, lower=1))


def _best_within(tried: Floats, kernel: Kernel, limits: Limits) -> EpsilonChoice:
    """The best trial whose condition is within the bound."""
    if not len(tried):
        raise np.linalg.LinAlgError(
            f"no epsilon of kernel '{kernel.name}' gives a fit; take another kernel or spread the centres"
        )
    allowed = tried[tried[:, 2] <= limits.condition]
    if not len(allowed):
        raise np.linalg.LinAlgError(
            f"no epsilon of kernel '{kernel.name}' has a condition of at most {limits.condition:g}, the least is "
            f"{tried[:, 2].min():.1e}; raise the bound or take another kernel"
        )
    best = allowed[by_worth(allowed, limits.doubt)[0]]
    return EpsilonChoice(float(best[0]), float(best[1]), float(best[2]), tried, limits.why())
