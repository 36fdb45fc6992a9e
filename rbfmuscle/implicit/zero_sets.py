"""The zero sets of the best epsilons of a search, looked at: which of them is one closed sheet near its surface.

Points on a surface say nothing of sheets that leave it. Whether a field has any is no function of its error: flat
kernels grow sheets of their own between few centres, narrow ones where they end. So those that broke are left with a
distance in epsilon, and where one that did not is found, the way back to the better ones that broke is halved.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.extraction.sheets import BOXES, Sheets, count_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.selection import WITHIN, EpsilonChoice, believed, by_worth, spacing
from rbfmuscle.implicit.shape_search import Limits
from rbfmuscle.validation import NumericalWarning

# Cells along the longest side when the distance of the zero set is measured: so many a spacing of the centres, between
# two bounds. Between coarser ones the ends of slender muscles bulge unseen.
CELLS, RANGE = 3.0, (48, 160)
# A zero set this much further from the mesh than the mesh from it has sheets that the mesh has not.
ALIKE = 1.05
# One that much further is no better company than one that broke.
STRAYED = 1.5
# A better condition may cost that much both ways, where it costs no more than 2 % to first order.
RELAXED = 1.04
# Zero sets that are looked at; so many of them whatever the time.
LOOKS, LEAST_LOOKS = 16, 6
# Next to one that broke, epsilons within this factor of it are passed over, at first and where all others broke too.
APART = (1.15, 1.04)
# An error of this share of the spacing is that of a field that is flat between its centres: whatever its sheets are,
# it knows no surface there.
FLAT = 0.5
# Halvings of the way from one that did not break to a better one that did.
HALVINGS = 4
UNKNOWN = "the field is flat between the centres at every epsilon; take more centres or another kernel"
OPEN = "the level set is open at every epsilon that was looked at; take more centres or another kernel"

Trial = tuple[float, float, float]


@dataclass
class _Looks:
    """What was looked at.

    Attributes
    ----------
    field_of : callable
        epsilon -> field.
    error : callable
        field -> error at the held-out points, to first order.
    points : (n, 3) ndarray
        Centres.
    distance : callable
    limits : Limits
    reach : float
        Mean distance of the centres to the nearest other.
    best : tuple or None
        Distance both ways and trial of the best that is sound.
    broken : list
        Trials that broke, with their number of sheets, and those that are sound but stray far from the surface.
    count : int
        How many were looked at.
    """

    field_of: Callable[[float], RBFField]
    error: Callable[[RBFField], float]
    points: Floats
    distance: Callable[..., Any]
    limits: Limits
    reach: float = field(init=False)
    best: tuple[float, Trial] | None = None
    broken: list[tuple[Trial, Sheets]] = field(default_factory=list)
    count: int = 0

    def __post_init__(self) -> None:
        self.reach = spacing(self.points).mean()

    def left(self) -> bool:
        """Whether another may be looked at."""
        return self.count < (LOOKS if self.limits.in_time() else LEAST_LOOKS)

    def near_broken(self, epsilon: float, factor: float) -> bool:
        """Whether one that broke lies within a factor."""
        return any(max(epsilon / t[0], t[0] / epsilon) < factor for t, _ in self.broken)

    def hopeless(self, missed: float) -> bool:
        """Whether the field knows no surface, or its distance both ways cannot be less than the best."""
        return not missed < FLAT * self.reach or (
            self.best is not None and missed >= math.sqrt(2.0) * self.best[0]
        )

    def look(self, trial: Trial) -> bool:
        """Whether this one is sound; the best is kept."""
        epsilon, missed, _ = trial
        self.count += 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            try:
                fitted = self.field_of(epsilon)
            except np.linalg.LinAlgError:
                self.broken.append((trial, Sheets(0, True, 0)))
                return False
        # coarse and cheap first; boxes are looked at once, a band that leaves its grid is followed far
        found = count_sheets(fitted, self.points, self.distance, boxes=BOXES[:1])
        both = math.inf
        if found.sound():
            both = math.sqrt(0.5 * (missed**2 + _back(fitted, self.points, self.distance) ** 2))
            if math.isfinite(both):
                if both > STRAYED * missed:
                    self.broken.append((trial, found))
                if self.best is not None and both >= self.best[0]:
                    return True
                found = count_sheets(fitted, self.points, self.distance, boxes=BOXES[1:])
        if not found.sound() or not math.isfinite(both):
            self.broken.append((trial, found))
            return False
        self.best = both, trial
        return True

    def improves(self, trial: Trial) -> bool:
        """Look at this one: whether it is the best now."""
        before = self.best
        return self.look(trial) and self.best is not before


def look_at_zero_sets(
    choice: EpsilonChoice,
    limits: Limits,
    field_of: Callable[[float], RBFField],
    error: Callable[[RBFField], float],
    points: Floats,
    distance: Callable[..., Any],
) -> EpsilonChoice:
    """The best of the tried epsilons by the distance both ways; the choice, named broken, where none is sound.

    Parameters
    ----------
    choice : EpsilonChoice
        What the search found.
    limits : Limits
        Its seconds hold for the looks too, but for the first few.
    field_of : callable
        epsilon -> field; raises LinAlgError where a fit fails.
    error : callable
        field -> error at the held-out points [length].
    points : (n, 3) ndarray
        Centres [length].
    distance : callable
        ``(n, 3) -> (n,)``, distance to the surface, signed or not.
    """
    looks = _Looks(field_of, error, points, distance, limits)
    trials: list[Trial] = [
        tuple(row) for row in choice.tried[choice.tried[:, 2] <= limits.condition].tolist()
    ]
    trials = [trials[k] for k in by_worth(np.array(trials), limits.doubt)]
    for factor in APART:
        if looks.best is None:
            _go_through(looks, trials, factor)
    if looks.best is None:
        return replace(choice, broken=_why(looks))
    _halve(looks, looks.best[1])
    _doubt_relaxed(looks, trials)
    both, (epsilon, _, condition) = looks.best
    return replace(choice, epsilon=epsilon, objective=both, condition=condition)


def _go_through(looks: _Looks, trials: list[Trial], factor: float) -> None:
    """Look at the trials in their order, apart from those that broke, until one is as near as its error says."""
    for trial in trials:
        if not looks.left():
            return
        if looks.hopeless(trial[1]) or looks.near_broken(trial[0], factor):
            continue
        if looks.look(trial) and looks.best is not None and looks.best[0] < ALIKE * trial[1]:
            return


def _halve(looks: _Looks, best: Trial) -> None:
    """From the best towards the nearest better one that broke, on either side."""
    for side in (-1.0, 1.0):
        better = [t for t, _ in looks.broken if side * (t[0] - best[0]) > 0.0 and WITHIN * t[1] < best[1]]
        if not better:
            continue
        sound, broken = best[0], min(better, key=lambda t: abs(math.log(t[0] / best[0])))[0]
        for _ in range(HALVINGS):
            if not looks.left():
                return
            trial = _trial(looks, math.sqrt(sound * broken))
            if trial is not None and trial[2] <= looks.limits.condition and looks.improves(trial):
                sound = trial[0]
            else:
                broken = math.sqrt(sound * broken)


def _doubt_relaxed(looks: _Looks, trials: list[Trial]) -> None:
    """Where a better condition costs more both ways than to first order, as much of it as 2 % of the least allow."""
    kept = looks.best
    assert kept is not None
    least = trials[int(np.argmin(believed(np.array(trials), looks.limits.doubt)))]
    if least[1] >= kept[1][1] or looks.near_broken(least[0], APART[-1]) or not looks.left():
        return
    if not looks.improves(least) or looks.best is None or RELAXED * looks.best[0] >= kept[0]:
        looks.best = kept
        return
    limit, good, bad = WITHIN * looks.best[0], looks.best, kept[1][0]
    if kept[1][2] >= good[1][2]:
        return
    for _ in range(HALVINGS // 2):
        trial = _trial(looks, math.sqrt(good[1][0] * bad)) if looks.left() else None
        if trial is None:
            break
        looks.best = None  # whether it is the least of all is not asked
        allowed = trial[2] <= looks.limits.condition
        if allowed and looks.look(trial) and looks.best is not None and looks.best[0] <= limit:
            good = looks.best
        else:
            bad = trial[0]
    looks.best = good


def _trial(looks: _Looks, epsilon: float) -> Trial | None:
    """Another epsilon's error and condition, None where its fit fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            fitted = looks.field_of(epsilon)
        except np.linalg.LinAlgError:
            return None
    looks.limits.spent += 1
    return epsilon, looks.error(fitted), fitted.condition


def _why(looks: _Looks) -> str:
    """Why none is sound: flat or open where all are, else the sheets of the best."""
    if not looks.broken:
        return UNKNOWN
    sheets = [found.number for _, found in looks.broken if found.number > 1]
    return f"{sheets[0]} sheets at every epsilon that was looked at" if sheets else OPEN


def _back(fitted: RBFField, points: Floats, distance: Callable[..., Any]) -> float:
    """Root mean square distance of the zero set's vertices from the surface, infinite where it is open."""
    try:
        cells = int(np.clip(CELLS * np.ptp(points, axis=0).max() / spacing(points).mean(), *RANGE))
        found = extract_surface(fitted, points=points, resolution=cells)
    except ValueError:
        return math.inf
    return float(np.sqrt((np.asarray(distance(found.vertices)) ** 2).mean()))
