"""Choosing the shape parameter epsilon."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.cross_validation import LeastSquaresPath, SmoothingPath, leave_one_out
from rbfmuscle.implicit.fit.fitting import DOUBTFUL, Basis, solve
from rbfmuscle.implicit.fit.regularisation import check_criterion, search_smoothing
from rbfmuscle.implicit.fit.systems import check_degree, collocation, frame, hermite_system
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.validation import (
    NumericalWarning,
    UsageError,
    check_points,
    check_positive,
    check_values,
    check_vectors,
)

if TYPE_CHECKING:
    from rbfmuscle.implicit.fit.regularisation import SmoothingChoice
    from rbfmuscle.implicit.kernels.table import Kernel


CRITERIA = ("loo", "gcv", "held_out", "condition")
SPAN = (0.02, 20.0)
"""Searched range of epsilon, in units of 1 / (mean distance of the centres to the nearest other)."""
_GOLDEN = 0.5 * (math.sqrt(5) - 1)
# Beyond DOUBTFUL an objective must be so much better to be believed: residuals are rounding noise there, while an
# error measured at other points is what it is, and only the slower fit speaks against it.
_NOISE, _NOISE_HELD_OUT = 2.0, 1.05


# Objectives this much apart are alike: the best-conditioned of them is taken.
WITHIN = 1.02
# Slope of a field, 1 where all is well, below which it is taken to be flat.
LEAST_SLOPE = 0.3
# Of all points, so many may lie where the field is flat.
FLAT_SHARE = 0.02
# Of the spacing: what an error of one in the left-out normal counts. Values alone would choose the narrowest kernel,
# which knows nothing between its centres, and where nothing is known f is 0, as it should be on the surface.
SLOPE_SHARE = 0.15


@dataclass(frozen=True)
class EpsilonChoice:
    """A chosen shape parameter and the way to it.

    Attributes
    ----------
    epsilon : float
        [1/length]
    objective : float
        The criterion there: root mean square of the left-out residuals, or of those with the mean block (GCV), [unit of
        the values; for Hermite fits length, the derivatives' residuals times ``SLOPE_SHARE`` of the spacing
        included], or |log10 of condition over target|.
    condition : float
        Estimate of the condition there.
    tried : (n, 3) ndarray
        epsilon, objective, condition of all evaluations, by epsilon.
    stopped : str
        What the search ran out of, empty where it came to its end.
    broken : str
        Why the zero set of the best is none of the surface, empty where it is or was not looked at.
    """

    epsilon: float
    objective: float
    condition: float
    tried: np.ndarray
    stopped: str = ""
    broken: str = ""


def hardy_epsilon(points: Floats) -> float:
    """Hardy (1971): 1 / (0.815 d), d the mean distance to the nearest neighbour."""
    return 1.0 / (0.815 * spacing(points).mean())


def franke_epsilon(points: Floats) -> float:
    """Franke (1982): 0.8 sqrt(N) / D, D the diameter of the bounding sphere of `frame`."""
    points = check_points(points)
    return 0.8 * math.sqrt(len(points)) / (2 * frame(points)[1])


def spacing_epsilon(points: Floats, *, factor: float = 0.5) -> float:
    """factor / h, h the mean distance to the nearest neighbour: what scattered points in 3-D ask for."""
    return check_positive(factor, name="factor") / spacing(points).mean()


def spacing(points: Floats, *, neighbours: int = 1) -> Floats:
    """Distance (n,) of each point to its nearest neighbours, their mean.

    Raises
    ------
    UsageError
        For fewer points than asked for, or coinciding ones.
    """
    points = check_points(points)
    if len(points) <= neighbours:
        raise UsageError(f"spacing needs more than {neighbours} points, got {len(points)}")
    distance = cKDTree(points).query(points, k=neighbours + 1)[0][:, 1:].mean(axis=1)
    if not distance.all():
        raise UsageError(f"point {int(np.argmin(distance))} coincides with another; remove duplicates")
    return distance


def choose_epsilon(
    points: ArrayLike,
    *,
    values: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    kernel: Kernel | str = "gaussian",
    criterion: str = "loo",
    held_out: ArrayLike | None = None,
    target: float = 1e10,
    derivatives: str = "all",
    smoothing: float | str = 0.0,
    span: tuple[float, float] = SPAN,
    coarse: int = 13,
    refine: int = 8,
) -> EpsilonChoice:
    """Search epsilon for a fit to values or, with normals, for a Hermite fit.

    A log-spaced scan brackets the minimum, golden sections narrow it. Where the condition exceeds 1e13 the objective
    is rounding noise: a finer and wider scan takes the sections' place, and such a value is believed only if it is
    twice as good as any sound one (5 % better for "held_out", which measures).

    Parameters
    ----------
    points : (K, 3) array_like
    values : (K,) array_like, optional
    normals : (K, 3) array_like, optional
        Exactly one of values and normals.
    kernel : str or Kernel
    criterion : {"loo", "gcv", "held_out", "condition"}
    held_out : (n, 3) array_like, optional
        Other points of the surface, for "held_out": root mean square of f / |grad f| there.
    target : float
        Condition wanted, for "condition".
    derivatives, smoothing
        As in `RBFField.fit_hermite`.
    span : (float, float)
        Searched range, in multiples of 1 / (mean distance to the nearest neighbour).
    coarse, refine : int
        Evaluations of the scan and of the refinement.

    Returns
    -------
    EpsilonChoice

    Raises
    ------
    UsageError
        For a kernel without epsilon, an unknown criterion, or missing data.
    """
    if isinstance(smoothing, str):
        raise UsageError(
            "epsilon is chosen for a smoothing that is a number; choose the smoothing afterwards"
        )
    points, kernel = check_points(points), get_kernel(kernel)
    _check_request(kernel, criterion, values, normals, held_out)
    data = _Data(
        points,
        None if values is None else check_values(values, len(points)),
        None if normals is None else check_vectors(normals, len(points)),
        kernel,
        derivatives,
        smoothing,
    )
    objective = _objective(data, criterion, target, held_out)
    unit = 1.0 / spacing(points).mean()
    noise = _NOISE_HELD_OUT if criterion == "held_out" else _NOISE
    tried = [_trial(objective, e * unit) for e in np.geomspace(span[0], span[1], coarse)]
    best = int(np.argmin(believed(tried, noise)))
    # Noise has no valley to narrow: there the range is scanned, and a wider one.
    noisy = tried[best][2] > DOUBTFUL
    low, high = (tried[min(max(best + side * (1 + noisy), 0), coarse - 1)][0] for side in (-1, 1))
    if noisy:
        tried += [_trial(objective, e) for e in np.geomspace(low, high, 2 * refine)]
    else:
        tried += _golden(objective, low, high, refine, noise)
    tried = np.array(sorted(tried))
    best = tried[by_worth(tried, noise)[0]]
    return EpsilonChoice(float(best[0]), float(best[1]), float(best[2]), tried)


def choose_smoothing(
    points: ArrayLike,
    *,
    values: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    centres: ArrayLike | None = None,
    kernel: str = "cubic",
    epsilon: float = 1.0,
    degree: Any = None,
    criterion: str = "gcv",
    derivatives: str = "all",
    cutoff: float = 1e-14,
) -> SmoothingChoice:
    """Choose the Tikhonov parameter of a fit along one decomposition, for the time of thirty to forty fits.

    Parameters
    ----------
    points : (n, 3) array_like
    values : (n,) array_like, optional
    normals : (n, 3) array_like, optional
        Exactly one of values and normals.
    centres : (K, 3) array_like, optional
        Fewer centres than values: the least-squares fit.
    kernel, epsilon, degree, derivatives, cutoff
        As in `RBFField.fit`, `RBFField.fit_hermite` and `RBFField.fit_least_squares`.
    criterion : {"gcv", "loo"}
        A Hermite fit leaves points out with their normals; one in a normal counts half the spacing.

    Returns
    -------
    regularisation.SmoothingChoice
        Its ``smoothing`` is what the fit takes by that name.
    """
    points, kernel, epsilon = (
        check_points(points),
        get_kernel(kernel),
        check_positive(epsilon, name="epsilon"),
    )
    if (values is None) == (normals is None) or (centres is not None and values is None):
        raise UsageError("give either values or normals, and centres only with values")
    check_criterion(criterion)
    if normals is not None:
        normals = check_vectors(normals, len(points))
        return search_smoothing(
            SmoothingPath(*hermite_system(points, normals, kernel, epsilon, derivatives)[:2]), criterion
        )
    values = check_values(np.asarray(values), len(points))
    degree = check_degree(kernel, degree, len(points))
    if centres is None:
        origin, scale = frame(points)
        basis = Basis(
            (points - origin) / scale, kernel, epsilon * scale if kernel.has_epsilon else 1.0, degree
        )
        return search_smoothing(SmoothingPath(basis, values), criterion)
    centres = check_points(centres, name="centres")
    matrix, _ = collocation(points, centres, kernel, epsilon, degree, *frame(centres))
    return search_smoothing(LeastSquaresPath(matrix, values, cutoff=cutoff), criterion)


def surface_miss(fitted: RBFField, points: Floats, reach: float) -> float:
    """Root mean square distance of a field's surface from points that should lie on it, to first order.

    |f| / |grad f|, at most ``reach``. Where the field is flat it knows no surface, though it may be 0: beyond a few
    such points, as thin rims have, each counts as missed by ``reach``.

    Parameters
    ----------
    fitted : RBFField
        Of slope one near its surface, as a fit to unit normals or distances is.
    points : (n, 3) array_like
    reach : float
        Mean distance of the centres to the nearest other [length].

    Returns
    -------
    float
        [length]
    """
    value, gradient = fitted.value_and_gradient(points)
    slope = np.linalg.norm(gradient, axis=1)
    missed = np.minimum(np.abs(value) / np.maximum(slope, LEAST_SLOPE), reach)
    flat = max(float((slope < LEAST_SLOPE).mean()) - FLAT_SHARE, 0.0)
    return float(np.sqrt((missed**2).mean() + flat * reach**2))


def _check_request(kernel: Kernel, criterion: str, values: object, normals: object, held_out: object) -> None:
    if not kernel.has_epsilon:
        raise UsageError(
            f"kernel '{kernel.name}' has no shape parameter: epsilon does not change its interpolant"
        )
    if criterion not in CRITERIA:
        raise UsageError(f"criterion must be one of {', '.join(CRITERIA)}, got '{criterion}'")
    if (values is None) == (normals is None):
        raise UsageError("give either values or normals")
    if (criterion == "held_out") != (held_out is not None):
        raise UsageError("held_out points are needed for, and only for, criterion 'held_out'")


class _Data(NamedTuple):
    """What is fitted while epsilon is sought: values (n,) or normals (n, 3) at points (n, 3)."""

    points: Floats
    values: Floats | None
    normals: Floats | None
    kernel: Kernel
    derivatives: str
    smoothing: float

    def system(self, epsilon: float) -> tuple[Any, Any]:
        """Basis and right side."""
        if self.normals is not None:
            return hermite_system(self.points, self.normals, self.kernel, epsilon, self.derivatives)[:2]
        origin, scale = frame(self.points)
        local = (self.points - origin) / scale
        return Basis(local, self.kernel, epsilon * scale, self.kernel.degree), self.values

    def field(self, epsilon: float) -> RBFField:
        """The fitted field."""
        settings: dict[str, Any] = {"kernel": self.kernel, "epsilon": epsilon, "smoothing": self.smoothing}
        if self.normals is not None:
            return RBFField.fit_hermite(self.points, self.normals, derivatives=self.derivatives, **settings)
        return RBFField.fit(self.points, np.asarray(self.values), **settings)


def _objective(
    data: _Data, criterion: str, target: float, held_out: ArrayLike | None
) -> Callable[[float], tuple[float, float]]:
    """epsilon -> (objective, condition)."""
    others = None if held_out is None else check_points(held_out, name="held_out")
    reach = spacing(data.points).mean()
    # A direction that is wrong by one at a left-out centre misses the surface by a part of the spacing.
    lever = 0.0 if data.normals is None else SLOPE_SHARE * reach / frame(data.points)[1]

    def by_residuals(epsilon: float) -> tuple[float, float]:
        found = leave_one_out(*data.system(epsilon), smoothing=data.smoothing)
        return found.score(criterion, lever), found.condition

    def by_held_out(epsilon: float) -> tuple[float, float]:
        field = data.field(epsilon)
        return surface_miss(field, np.asarray(others), reach), field.condition

    def by_condition(epsilon: float) -> tuple[float, float]:
        condition = solve(*data.system(epsilon), smoothing=data.smoothing)[2]
        return abs(math.log10(condition / target)), condition

    return {"held_out": by_held_out, "condition": by_condition}.get(criterion, by_residuals)


def _trial(objective: Callable[..., Any], epsilon: float) -> tuple[float, float, float]:
    """(epsilon, objective, condition); infinite where the fit fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            score, condition = objective(epsilon)
        except np.linalg.LinAlgError:
            return epsilon, math.inf, math.inf
    return epsilon, score if math.isfinite(score) else math.inf, condition


def by_worth(tried: ArrayLike, noise: float = _NOISE_HELD_OUT) -> np.ndarray:
    """Order (n,) of trials (n, 3): those within 2 % of the best by their condition, then the others by objective."""
    worth, condition = believed(tried, noise), np.asarray(tried)[:, 2]
    alike = worth <= WITHIN * worth.min()
    return np.lexsort((np.where(alike, condition, worth), ~alike))


def believed(tried: ArrayLike, noise: float = _NOISE_HELD_OUT) -> Floats:
    """Objectives (n,) of trials (n, 3), those of a doubtful condition made worse by ``noise``."""
    tried = np.asarray(tried)
    return tried[:, 1] * np.where(tried[:, 2] > DOUBTFUL, noise, 1.0)


def _golden(
    objective: Callable[..., Any], low: float, high: float, count: int, noise: float
) -> list[tuple[float, float, float]]:
    """Golden-section search of the logarithm between low and high."""
    a, b = math.log(low), math.log(high)
    x, y = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
    left, right = _trial(objective, math.exp(x)), _trial(objective, math.exp(y))
    tried = [left, right]
    for _ in range(count - 2):
        worth = believed([left, right], noise)
        if worth[0] <= worth[1]:
            b, y, right = y, x, left
            x = b - _GOLDEN * (b - a)
            left = _trial(objective, math.exp(x))
            tried.append(left)
        else:
            a, x, left = x, y, right
            y = a + _GOLDEN * (b - a)
            right = _trial(objective, math.exp(y))
            tried.append(right)
    return tried
