"""Choosing epsilon for a surface that is at hand: the error is measured on it, and the zero set is looked at."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.off_surface import off_surface_points
from rbfmuscle.implicit.selection import SPAN, EpsilonChoice, by_worth, choose_epsilon, spacing
from rbfmuscle.validation import NumericalWarning

if TYPE_CHECKING:
    from rbfmuscle.implicit.kernels.table import Kernel


# Evaluations of the scan and of the refinement. Flat Gaussians close their surface in spans of a factor of 1.3 only.
COARSE, REFINE = 25, 6
# Cells along the longest side when the zero set is looked at.
RESOLUTION = 48
# A zero set this much further from the mesh than the mesh from it has sheets that the mesh has not.
ALIKE = 1.05


def choose_surface_epsilon(
    points: ArrayLike,
    normals: ArrayLike,
    *,
    kernel: Kernel | str,
    held_out: ArrayLike | None = None,
    distance: Callable[..., Any] | None = None,
    criterion: str | None = None,
    derivatives: str = "all",
    smoothing: float = 0.0,
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
    derivatives, smoothing
        As in `RBFField.fit_surface`.

    Returns
    -------
    EpsilonChoice
        Where the zero set was looked at, the objective is the root mean square distance both ways.
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
    choice = choose_epsilon(
        **data, kernel=kernel, criterion=criterion, held_out=held_out if criterion == "held_out" else None,
        smoothing=smoothing, span=(SPAN[0] * ratio, SPAN[1] * ratio), coarse=COARSE, refine=REFINE,
    )  # fmt: skip
    if criterion != "held_out" or distance is None:
        return choice

    def fit(epsilon: float) -> RBFField:
        return RBFField.fit_surface(
            points, normals, kernel=kernel, epsilon=epsilon, derivatives=derivatives, smoothing=smoothing
        )

    return _look_at_zero_sets(choice, fit, points, distance)


def _look_at_zero_sets(
    choice: EpsilonChoice, fit: Callable[..., Any], points: Floats, distance: Callable[..., Any]
) -> EpsilonChoice:
    """The best of the tried epsilons by the distance both ways; the choice itself where none is closed."""
    found, least = choice, np.inf
    for number in by_worth(choice.tried):
        epsilon, missed, condition = (float(x) for x in choice.tried[number])
        # The distance both ways is at least this, and twice the error has never been the better surface.
        if missed > 2.0 * least or missed / np.sqrt(2.0) > least or not np.isfinite(missed):
            break
        both = np.sqrt(0.5 * (missed**2 + _back(fit, epsilon, points, distance) ** 2))
        if both < least:
            found, least = EpsilonChoice(epsilon, float(both), condition, choice.tried), both
        if both < ALIKE * missed:
            break
    return found


def _back(fit: Callable[..., Any], epsilon: float, points: Floats, distance: Callable[..., Any]) -> float:
    """Root mean square distance of the zero set's vertices from the surface, infinite where it is open."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            found = extract_surface(fit(epsilon), points=points, resolution=RESOLUTION)
        except (ValueError, np.linalg.LinAlgError):
            return np.inf
    return float(np.sqrt((np.asarray(distance(found.vertices)) ** 2).mean()))
