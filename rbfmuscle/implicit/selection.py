"""Choosing the shape parameter epsilon: the least error at other points of the surface, with one
sheet near it.

Every fit has a bounded condition (a ridge keeps it), so that flat kernels take no longer than
others. The range is scanned and the best valley narrowed by golden sections. Points on a surface
say nothing of sheets that leave it, so the zero sets of the best are extracted in their order,
until one is a single closed sheet.
"""

import contextlib
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.extraction import find_sheets
from rbfmuscle.implicit.field import FieldFit, RBFField, overlapping_parts
from rbfmuscle.validation import NumericalWarning, UsageError, check_points, check_vectors

SPAN = (0.02, 20.0)
"""Searched range of epsilon, times the mean distance of the centres to the nearest other."""
BOUND = 1e10
"""Condition of the fits of kernels with a shape parameter, where none is given."""
# Fits of the scan, and of the golden sections.
SCAN, REFINE = 25, 8
# Errors this much apart are alike: the best-conditioned fit of them comes first.
WITHIN = 1.02
# Slope of a field, 1 where all is well, below which it is taken to be flat; and the share of points
# where it may be.
LEAST_SLOPE, FLAT_SHARE = 0.3, 0.02
# Zero sets that are extracted; epsilons within a factor of one whose zero set broke are passed
# over.
LOOKS, APART = 12, 1.15
# An error of this share of the spacing is that of a field that is flat between its centres.
FLAT = 0.5
_GOLDEN = 0.5 * (math.sqrt(5) - 1)


class Trial(NamedTuple):
    """A fit of some epsilon, its error at the held-out points, infinite where there is no fit, and
    its condition.
    """

    epsilon: float
    error: float
    condition: float
    field: RBFField | None


class EpsilonChoice(NamedTuple):
    """A chosen shape parameter [1/length] and its root mean square ``error`` at the held-out points
    [length].

    ``broken`` says why no zero set that was extracted is that of the surface, empty where one is.
    ``trials`` (n, 2) are each epsilon times the mean spacing, growing, and its error.
    """

    epsilon: float
    error: float
    broken: str
    trials: Floats


def spacing(points: ArrayLike) -> Floats:
    """Distance (n,) of each point to the nearest other; UsageError for fewer than two points, or
    coinciding ones.
    """
    points = check_points(points)
    if len(points) < 2:
        raise UsageError(f"spacing needs at least 2 points, got {len(points)}")
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    if not distance.all():
        raise UsageError(
            f"point {int(np.argmin(distance))} coincides with another; remove duplicates"
        )
    return np.asarray(distance)


def surface_error(fitted: RBFField, points: Floats, reach: float) -> float:
    """Root mean square distance of a field's surface from points (n, 3) that should lie on it, to
    first order [length].

    |f| / |grad f| for a field of slope one near its surface, as a fit to unit normals or distances
    is; at most ``reach``, the mean distance of the centres to the nearest other. Where the field is
    flat it knows no surface, though it may be 0: beyond a few such points, as thin rims have, each
    counts as missed by ``reach``.
    """
    value, gradient = fitted.value_and_gradient(points)
    slope = np.linalg.norm(gradient, axis=1)
    missed = np.minimum(np.abs(value) / np.maximum(slope, LEAST_SLOPE), reach)
    flat = max(float((slope < LEAST_SLOPE).mean()) - FLAT_SHARE, 0.0)
    return float(np.sqrt((missed**2).mean() + flat * reach**2))


def choose_epsilon(
    points: ArrayLike,
    normals: ArrayLike,
    fit: FieldFit,
    *,
    held_out: ArrayLike,
    distance: Callable[[Floats], Floats] | None = None,
) -> EpsilonChoice:
    """Search the epsilon of a fit to points with normals (K, 3).

    ``fit`` is of any epsilon; its condition should be bounded. ``held_out`` (n, 3) are other points
    of the surface, spread evenly over it. ``distance`` maps points (n, 3) to their distances (n,)
    from the surface, signed or not; with it zero sets are extracted. UsageError for a kernel
    without a shape parameter, LinAlgError where no epsilon can be fitted.
    """
    if not fit.kernel.has_epsilon:
        raise UsageError(
            f"kernel '{fit.kernel.name}' has no shape parameter: epsilon changes nothing"
        )
    points = check_points(points)
    normals, reach = check_vectors(normals, len(points)), float(spacing(points).mean())
    order = _search(points, normals, fit, check_points(held_out, name="held_out"), reach)
    if not order:
        message = (
            f"no epsilon of kernel '{fit.kernel.name}' gives a fit; take another or spread "
            "the centres"
        )
        raise np.linalg.LinAlgError(message)
    found, broken = (
        (order[0], "") if distance is None else _first_sound(order, points, reach, distance)
    )
    chosen = found or order[0]
    trials = np.array(sorted((trial.epsilon * reach, trial.error) for trial in order))
    return EpsilonChoice(chosen.epsilon, chosen.error, broken, trials)


def _search(
    points: Floats, normals: Floats, fit: FieldFit, held_out: Floats, reach: float
) -> list[Trial]:
    """Scan and narrow; the trials that have a fit, in the order of their worth."""
    trials: dict[float, Trial] = {}
    parts = overlapping_parts(points)

    def error(epsilon: float) -> float:
        if epsilon not in trials:
            trials[epsilon] = Trial(epsilon, math.inf, math.inf, None)
            with contextlib.suppress(np.linalg.LinAlgError):
                field = replace(fit, epsilon=epsilon).fit(points, normals, parts)
                missed = surface_error(field, held_out, reach)
                trials[epsilon] = Trial(epsilon, missed, field.condition, field)
        return trials[epsilon].error

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        grid = [float(epsilon) for epsilon in np.geomspace(*SPAN, SCAN) / reach]
        best = min(grid, key=error)
        # golden sections of the logarithm
        a, b = math.log(best * grid[0] / grid[1]), math.log(best * grid[1] / grid[0])
        for _ in range(REFINE):
            x, y = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
            a, b = (a, y) if error(math.exp(x)) <= error(math.exp(y)) else (x, b)
    tried = [trial for trial in trials.values() if math.isfinite(trial.error)]
    limit = WITHIN * min((trial.error for trial in tried), default=0.0)
    return sorted(
        tried, key=lambda t: (t.error > limit, t.condition if t.error <= limit else t.error)
    )


def _first_sound(
    order: list[Trial], points: Floats, reach: float, distance: Callable[[Floats], Floats]
) -> tuple[Trial | None, str]:
    """The first trial whose zero set is closed and has no stray sheets, or None and why there is
    none.
    """
    broken: list[float] = []
    stray, remedy = 0, "take more centres or another kernel"
    for trial in order:
        if trial.field is None or trial.error >= FLAT * reach or len(broken) == LOOKS:
            break
        if any(max(trial.epsilon / epsilon, epsilon / trial.epsilon) < APART for epsilon in broken):
            continue
        sheets = find_sheets(trial.field, points, distance)
        if sheets.sound():
            return trial, ""
        broken.append(trial.epsilon)
        stray = max(stray, sheets.stray)
    if not broken:
        return None, f"the field is flat between the centres at every epsilon; {remedy}"
    if stray:
        return None, f"{stray} stray sheets at every epsilon that was tried; {remedy}"
    return None, f"the level set is open at every epsilon that was tried; {remedy}"
