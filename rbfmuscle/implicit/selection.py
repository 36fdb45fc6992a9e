"""Choosing the shape parameter epsilon: the least error at other points of the surface, with one sheet near it.

Every fit has a bounded condition (a ridge keeps it), so that flat kernels can be looked at in the time of sound ones.
The range is scanned, the best valley narrowed by golden sections, and left towards better conditions as far as the
error stays within 2 %. Points on a surface say nothing of sheets that leave it, so the zero sets of the best are looked
at in their order; from one that is sound the way back to a better one that broke is halved.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.extraction.sheets import Sheets, count_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.field_fit import FieldFit
from rbfmuscle.validation import NumericalWarning, UsageError, check_points, check_vectors

SPAN = (0.02, 20.0)
"""Searched range of epsilon, in units of 1 / (mean distance of the centres to the nearest other)."""
BOUND = 1e10
"""Condition of the fits of kernels with a shape parameter, where none is given."""
# Fits of the scan, of the golden sections, and towards better conditions.
SCAN, REFINE, RELAX = 25, 6, 4
# Errors this much apart are alike: the best-conditioned fit of them is taken.
WITHIN = 1.02
# Slope of a field, 1 where all is well, below which it is taken to be flat; and the share of points where it may be.
LEAST_SLOPE, FLAT_SHARE = 0.3, 0.02
# Zero sets that are looked at. Next to one that broke, epsilons within a factor are passed over, at first and where
# all others broke too.
LOOKS, APART = 12, (1.15, 1.04)
# A zero set that is at most this much further from the mesh than the mesh from it needs no other look.
ALIKE = 1.05
# An error of this share of the spacing is that of a field that is flat between its centres.
FLAT = 0.5
# Halvings of the way from one that did not break to a better one that did.
HALVINGS = 3
# Cells along the longest side where the distance of the zero set is measured: so many a spacing, between two bounds.
CELLS, RANGE = 3.0, (48, 160)
_GOLDEN = 0.5 * (math.sqrt(5) - 1)

Trial = tuple[float, float, float]
"""epsilon, error, condition."""
Distance = Callable[[Floats], Floats]


@dataclass(frozen=True)
class EpsilonChoice:
    """A chosen shape parameter and the way to it.

    Attributes
    ----------
    epsilon : float
        [1/length]
    error : float
        Root mean square distance of the held-out points, both ways where the zero set was looked at [length].
    condition : float
    tried : (n, 3) ndarray
        epsilon, error at the held-out points, condition of all fits, by epsilon.
    broken : str
        Why no zero set that was looked at is that of the surface, empty where one is.
    """

    epsilon: float
    error: float
    condition: float
    tried: np.ndarray
    broken: str = ""


def spacing(points: ArrayLike) -> Floats:
    """Distance (n,) of each point to the nearest other.

    Raises
    ------
    UsageError
        For fewer than two points, or coinciding ones.
    """
    points = check_points(points)
    if len(points) < 2:
        raise UsageError(f"spacing needs at least 2 points, got {len(points)}")
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    if not distance.all():
        raise UsageError(f"point {int(np.argmin(distance))} coincides with another; remove duplicates")
    return np.asarray(distance)


def surface_error(fitted: RBFField, points: Floats, reach: float) -> float:
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


def choose_epsilon(
    points: ArrayLike,
    normals: ArrayLike,
    fit: FieldFit,
    *,
    held_out: ArrayLike,
    distance: Distance | None = None,
) -> EpsilonChoice:
    """Search the epsilon of a fit.

    Parameters
    ----------
    points, normals : (K, 3) array_like
    fit : FieldFit
        Of any epsilon; its condition should be bounded.
    held_out : (n, 3) array_like
        Other points of the surface, spread evenly over it.
    distance : callable, optional
        ``(n, 3) -> (n,)``, distance to the surface, signed or not; with it zero sets are looked at.

    Returns
    -------
    EpsilonChoice

    Raises
    ------
    UsageError
        For a kernel without a shape parameter.
    numpy.linalg.LinAlgError
        Where no epsilon can be fitted.
    """
    if not fit.kernel.has_epsilon:
        raise UsageError(
            f"kernel '{fit.kernel.name}' has no shape parameter: epsilon does not change its interpolant"
        )
    points = check_points(points)
    normals = check_vectors(normals, len(points))
    search = _Search(points, normals, fit, check_points(held_out, name="held_out"))
    order = search.run()
    if not order:
        raise np.linalg.LinAlgError(
            f"no epsilon of kernel '{fit.kernel.name}' gives a fit; take another kernel or spread the centres"
        )
    (epsilon, error, found), broken = order[0], ""
    if distance is not None:
        looks = _Looks(search, distance)
        best = looks.best_of(order)
        if best is None:
            broken = looks.why()
        else:
            error, (epsilon, _, found) = best
    return EpsilonChoice(epsilon, error, found, np.array(sorted(search.trials.values())), broken)


class _Search:
    """Fits by epsilon, and their errors at the held-out points."""

    def __init__(self, points: Floats, normals: Floats, fit: FieldFit, held_out: Floats) -> None:
        self.points, self.normals, self.fit, self.held_out = points, normals, fit, held_out
        self.reach = float(spacing(points).mean())
        self.trials: dict[float, Trial] = {}
        self.fields: dict[float, RBFField] = {}

    def attempt(self, epsilon: float) -> Trial:
        """The trial of an epsilon, of infinite error where it cannot be fitted."""
        if epsilon in self.trials:
            return self.trials[epsilon]
        trial = epsilon, math.inf, math.inf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            try:
                field = replace(self.fit, epsilon=epsilon).fit(self.points, self.normals)
                trial = epsilon, surface_error(field, self.held_out, self.reach), field.condition
                self.fields[epsilon] = field
            except np.linalg.LinAlgError:
                pass
        self.trials[epsilon] = trial
        return trial

    def run(self) -> list[Trial]:
        """Scan, narrow, relax; the trials in the order of their worth."""
        grid = np.geomspace(*SPAN, SCAN) / self.reach
        best = min((self.attempt(float(epsilon)) for epsilon in grid), key=lambda trial: trial[1])
        if math.isinf(best[1]):
            return []
        self._narrow(best[0] * grid[0] / grid[1], best[0] * grid[1] / grid[0])
        self._relax()
        tried = [trial for trial in self.trials.values() if math.isfinite(trial[1])]
        limit = WITHIN * min(trial[1] for trial in tried)
        return sorted(tried, key=lambda t: (t[1] > limit, t[2] if t[1] <= limit else t[1]))

    def _narrow(self, low: float, high: float) -> None:
        """Golden sections of the logarithm between low and high."""
        a, b = math.log(low), math.log(high)
        x, y = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
        left, right = self.attempt(math.exp(x)), self.attempt(math.exp(y))
        for _ in range(REFINE - 2):
            if left[1] <= right[1]:
                b, y, right = y, x, left
                x = b - _GOLDEN * (b - a)
                left = self.attempt(math.exp(x))
            else:
                a, x, left = x, y, right
                y = a + _GOLDEN * (b - a)
                right = self.attempt(math.exp(y))

    def _relax(self) -> None:
        """Towards better conditions, as far as the error stays within 2 % of the best."""
        tried = sorted(self.trials.values())
        errors = np.array([trial[1] for trial in tried])
        limit, at = WITHIN * errors.min(), int(errors.argmin())
        while at + 1 < len(tried) and errors[at + 1] <= limit:
            at += 1
        if at + 1 == len(tried):
            return
        good, bad = tried[at][0], tried[at + 1][0]
        for _ in range(RELAX):
            middle = math.sqrt(good * bad)
            good, bad = (middle, bad) if self.attempt(middle)[1] <= limit else (good, middle)


class _Looks:
    """Zero sets that were looked at: which are one closed sheet, and how far they are from the surface."""

    def __init__(self, search: _Search, distance: Distance) -> None:
        self.search, self.distance = search, distance
        self.broken: list[tuple[Trial, Sheets]] = []
        self.count = 0

    def best_of(self, order: list[Trial]) -> tuple[float, Trial] | None:
        """Distance both ways and trial of the best that is sound, None where all that were looked at broke."""
        for factor in APART:
            best = self._first(order, factor)
            if best is not None:
                return self._halve(best)
        return None

    def _first(self, order: list[Trial], factor: float) -> tuple[float, Trial] | None:
        """The best of the trials in their order, apart from those that broke."""
        best: tuple[float, Trial] | None = None
        for trial in order:
            hopeless = trial[1] >= (FLAT * self.search.reach if best is None else math.sqrt(2.0) * best[0])
            if hopeless or self.count >= LOOKS:
                break
            if any(max(trial[0] / t[0], t[0] / trial[0]) < factor for t, _ in self.broken):
                continue
            both = self._both_ways(trial)
            if both < (math.inf if best is None else best[0]):
                best = both, trial
            if both < ALIKE * trial[1]:
                break
        return best

    def _halve(self, best: tuple[float, Trial]) -> tuple[float, Trial]:
        """From the best towards the nearest better one that broke."""
        better = [t[0] for t, _ in self.broken if WITHIN * t[1] < best[1][1]]
        if not better:
            return best
        bad = min(better, key=lambda epsilon: abs(math.log(epsilon / best[1][0])))
        for _ in range(HALVINGS):
            trial = self.search.attempt(math.sqrt(best[1][0] * bad))
            both = self._both_ways(trial) if trial[1] < math.sqrt(2.0) * best[0] else math.inf
            if both < best[0]:
                best = both, trial
            else:
                bad = trial[0]
        return best

    def _both_ways(self, trial: Trial) -> float:
        """Root mean square distance both ways, infinite where the zero set is open or in several sheets."""
        self.count += 1
        field, points = self.search.fields[trial[0]], self.search.points
        sheets = count_sheets(field, points, self.distance)
        if sheets.sound():
            cells = int(np.clip(CELLS * np.ptp(points, axis=0).max() / self.search.reach, *RANGE))
            try:
                found = extract_surface(field, points=points, resolution=cells)
            except ValueError:
                sheets = Sheets(0, True, cells)
            else:
                return math.sqrt(0.5 * (trial[1] ** 2 + float((self.distance(found.vertices) ** 2).mean())))
        self.broken.append((trial, sheets))
        return math.inf

    def why(self) -> str:
        """Why none is sound."""
        remedy = "take more centres or another kernel"
        if not self.broken:
            return f"the field is flat between the centres at every epsilon; {remedy}"
        several = [sheets.number for _, sheets in self.broken if sheets.number > 1]
        if several:
            return f"{several[0]} sheets at every epsilon that was looked at"
        return f"the level set is open at every epsilon that was looked at; {remedy}"
