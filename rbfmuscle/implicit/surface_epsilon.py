"""Choosing epsilon for a surface that is at hand: the error is measured on it, and the zero set is looked at."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import blas

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.condition import largest_eigenvalue
from rbfmuscle.implicit.fit.fitting import DOUBTFUL, Basis
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
from rbfmuscle.validation import NumericalWarning, check_points

# Evaluations of the scan and of the refinement. Flat Gaussians close their surface in spans of a factor of 1.3 only.
COARSE, REFINE = 25, 6
# Cells along the longest side when the zero set is looked at.
RESOLUTION = 48
# A zero set this much further from the mesh than the mesh from it has sheets that the mesh has not.
ALIKE = 1.05
# Ridge, as a share of the largest eigenvalue: errors are those of the truncated solution to a few per cent.
RIDGE_SHARE = 1e-12
# Zero sets that are looked at, and cells of the box in which sheets are looked for that do not belong to the surface.
LOOKS, BOX = 12, 40
# Cells of another look where slender muscles fall into pieces between the nodes of that box.
FINER = 160
# Where sheets are found, so much flatter kernels are looked at next.
FLATTER = 1.15
OPEN = "the level set is open at every epsilon that was looked at; take more centres or another kernel"


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

    def fit(epsilon: float, how: str = TRUNCATED) -> RBFField:
        ridge = _ridge(data, kernel, epsilon) if how == RIDGE else 0.0
        return RBFField.fit_surface(
            points, normals, kernel=kernel, epsilon=epsilon, derivatives=derivatives, smoothing=ridge,
            truncate=how == TRUNCATED,
        )  # fmt: skip

    def error(epsilon: float, how: str) -> tuple[float, float]:
        field = fit(epsilon, how)
        return surface_miss(field, others, reach), field.condition

    each = {"all": 4, "normal": 2}[derivatives] if kernel.hermite else 3
    tried = search_shape(
        error, (span[0] * unit, span[1] * unit), refine=REFINE, size=each * len(points), limits=limits
    )
    choice = _best_within(tried, kernel, limits)
    return choice if distance is None else _look_at_zero_sets(choice, limits, fit, points, distance)


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
    best = allowed[by_worth(allowed)[0]]
    return EpsilonChoice(float(best[0]), float(best[1]), float(best[2]), tried, limits.why())


def _look_at_zero_sets(
    choice: EpsilonChoice,
    limits: Limits,
    fit: Callable[..., Any],
    points: Floats,
    distance: Callable[..., Any],
) -> EpsilonChoice:
    """The best of the tried epsilons by the distance both ways; the choice, named broken, where none is closed."""
    found, spare = None, replace(choice, broken=OPEN)
    tried = choice.tried[choice.tried[:, 2] <= limits.condition]
    looks, narrow, again = 0, np.inf, False
    queue, passed = list(by_worth(tried)), list[int]()
    while queue or (passed and found is None and not again):
        if not queue:  # none is flat enough; long muscles may be whole only with narrower kernels
            queue, looks, narrow, again = passed, 0, np.inf, True
        number = queue.pop(0)
        epsilon, missed, condition = (float(x) for x in tried[number])
        if epsilon > narrow and not again:
            passed.append(number)
            continue  # one little flatter has sheets of its own where the kernels end
        looks += 1
        least = np.inf if found is None else found.objective
        # The distance both ways is at least this, and twice the error has never been the better surface.
        if looks > LOOKS or missed > 2.0 * least or missed / np.sqrt(2.0) > least or not np.isfinite(missed):
            break
        field = _fitted(fit, epsilon)
        if field is None:
            continue
        both = float(np.sqrt(0.5 * (missed**2 + _back(field, points, distance) ** 2)))
        if both >= least:
            continue
        now = replace(choice, epsilon=epsilon, objective=both, condition=condition)
        # In the whole box of the points, open ones included.
        sheets = _sheets(field, points, distance)
        if sheets > 1:
            if condition < DOUBTFUL:
                narrow = epsilon / FLATTER
            if spare.broken == OPEN or both < spare.objective:
                spare = replace(now, broken=f"{sheets} sheets at every epsilon that was looked at")
            continue
        found = now
        if both < ALIKE * missed:
            break
    return found or spare


def _fitted(fit: Callable[..., RBFField], epsilon: float) -> RBFField | None:
    """The field of an epsilon, None where it fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            return fit(epsilon)
        except np.linalg.LinAlgError:
            return None


def _back(field: RBFField, points: Floats, distance: Callable[..., Any]) -> float:
    """Root mean square distance of the zero set's vertices from the surface, infinite where it is open."""
    try:
        found = extract_surface(field, points=points, resolution=RESOLUTION)
    except ValueError:
        return np.inf
    return float(np.sqrt((np.asarray(distance(found.vertices)) ** 2).mean()))


def _sheets(field: RBFField, points: Floats, distance: Callable[..., Any]) -> int:
    """Sheets of the zero set in the whole box of the points."""
    found = extract_surface(field, points=points, resolution=BOX, search="box", keep="all")
    if found.components > 1 and not found.spurious:
        away = np.abs(np.asarray(distance(found.vertices)))
        if away.max() < found.spacing:  # none stands off the surface: pieces of it
            found = extract_surface(field, points=points, resolution=FINER, search="box", keep="all")
    return found.components
