"""The search of a shape parameter by a measured error, with a bound on fits, seconds and condition.

Fits of sound condition take milliseconds, an eigen-decomposition beyond that thirty times as long. So the sound ones
are scanned first, from the narrow end on; what lies beyond is scanned with a ridge, and only its best without.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.selection import WITHIN, _golden, believed
from rbfmuscle.validation import NumericalWarning

# Step beyond the last sound fit.
STEP = 1.2
# How a system is solved: soundly or not at all, with a ridge, by a truncated eigen-decomposition.
SOUND, RIDGE, TRUNCATED = "sound", "ridge", "truncated"
# Fits that find the flattest sound one, and the narrowest that is as good as the best.
EDGE = 4
# What counts the seconds of a search.
CLOCK = time.monotonic
# Unknowns beyond which an eigen-decomposition takes seconds: there it is the last resort.
LARGE = 1500

Trial = tuple[float, float, float]
Attempt = Callable[..., Trial]


@dataclass
class Limits:
    """What a search may spend.

    Attributes
    ----------
    fits : int
    seconds : float
        None is begun later than that after the first, which may compile, but for those of the scan; a search that ends
        by it need not end alike on another machine.
    slow : int
        Fits by eigen-decomposition among them.
    condition : float
        None beyond it is chosen.
    scan : int
        Fits of the first scan.
    doubt : float
        An error at a condition beyond `DOUBTFUL`, whose fits take fifteen times as long, must be so much smaller.
    bound : float
        A ridge keeps the condition of every fit to normals below it, so that flat kernels can be looked at too.
    """

    fits: int = 80
    seconds: float = math.inf
    slow: int = 4
    condition: float = math.inf
    scan: int = 25
    doubt: float = 1.05
    bound: float = math.inf

    def start(self) -> None:
        """Begin to count."""
        self.spent, self.begun, self.scanning = 0, CLOCK(), True

    def left(self) -> bool:
        """Whether another fit may be made."""
        return self.spent < self.fits and (self.scanning or self.in_time())

    def in_time(self) -> bool:
        """Whether its seconds are not over."""
        return CLOCK() - self.begun < self.seconds

    def why(self) -> str:
        """What ran out, or empty."""
        if self.spent >= self.fits:
            return f"{self.fits} fits"
        return "" if self.left() else f"{self.seconds:.2g} s"


def search_shape(
    error: Callable[[float, str], tuple[float, float]],
    span: tuple[float, float],
    *,
    refine: int,
    size: int,
    limits: Limits,
) -> Floats:
    """Trials (n, 3) of epsilon, error and condition, by epsilon.

    Parameters
    ----------
    error : callable
        ``(epsilon, how) -> error, condition``; raises LinAlgError where a fit fails.
    span : (float, float)
        Of epsilon [1/length].
    refine : int
        Fits of the refinement.
    size : int
        Unknowns of a fit.
    limits : Limits
    """
    limits.start()

    def attempt(epsilon: float, how: str = SOUND) -> Trial:
        if not limits.left():
            return epsilon, math.inf, math.inf
        limits.spent += 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            try:
                score, condition = error(epsilon, how)
            except np.linalg.LinAlgError:
                return epsilon, math.inf, math.inf
            finally:
                if limits.spent == 1:
                    limits.begun = CLOCK()
        return epsilon, score if math.isfinite(score) else math.inf, condition

    sound, ratio = _scan_sound(attempt, span, limits.scan)
    limits.scanning = False
    tried = [t for t in sound if math.isfinite(t[1])]
    if tried:
        tried += _narrow(attempt, tried, ratio, refine)
        tried += _relax(attempt, tried)
    flattest = min((t[0] for t in tried), default=span[1])
    if limits.slow and (not tried or size <= LARGE):
        tried += _beyond(attempt, tried, flattest, span, limits)
    return np.array(sorted(tried)) if tried else np.zeros((0, 3))


def _scan_sound(attempt: Attempt, span: tuple[float, float], count: int) -> tuple[list[Trial], float]:
    """From the narrow end on until two in a row are unsound."""
    grid, found, broken = np.geomspace(span[1], span[0], count), [], 0
    for epsilon in grid:
        found.append(attempt(float(epsilon)))
        sound = math.isfinite(found[-1][1])
        broken = 0 if sound else broken + 1
        if broken >= 2 and any(math.isfinite(t[1]) for t in found):
            break
    return found, float(grid[0] / grid[1])


def _narrow(attempt: Attempt, tried: list[Trial], ratio: float, refine: int) -> list[Trial]:
    """Golden sections around the best; towards the last sound one where the best is next to it."""
    best = tried[int(np.argmin(believed(np.array(tried))))][0]
    low, high = best / ratio, best * ratio
    found: list[Trial] = []
    if best <= min(t[0] for t in tried):
        for _ in range(EDGE):  # the valley goes on: how far is it sound?
            middle = math.sqrt(low * best)
            found.append(attempt(middle))
            low, best = (low, middle) if math.isfinite(found[-1][1]) else (middle, best)
        low = best
    found += _golden(lambda e: attempt(e)[1:], low, high, refine, 1.0)
    return [t for t in found if math.isfinite(t[1])]


def _relax(attempt: Attempt, tried: list[Trial]) -> list[Trial]:
    """Towards better conditions, as far as the error stays within 2 % of the best."""
    tried = sorted(tried)
    worth = believed(np.array(tried))
    limit, at = WITHIN * worth.min(), int(np.argmin(worth))
    while at + 1 < len(tried) and worth[at + 1] <= limit:
        at += 1
    if at + 1 == len(tried):
        return []
    good, bad = tried[at][0], tried[at + 1][0]
    found: list[Trial] = []
    for _ in range(EDGE):
        found.append(attempt(math.sqrt(good * bad)))
        good, bad = (found[-1][0], bad) if found[-1][1] <= limit else (good, found[-1][0])
    return [t for t in found if math.isfinite(t[1])]


def _beyond(
    attempt: Attempt, tried: list[Trial], flattest: float, span: tuple[float, float], limits: Limits
) -> list[Trial]:
    """Beyond the sound fits: all scanned with a ridge, for the time of a sound fit, the best also without."""
    first = flattest / STEP if tried else flattest
    count = max(int(math.log(first / span[0]) / math.log(STEP**2)) + 1, 2)
    with_ridge = [attempt(float(e), RIDGE) for e in np.geomspace(first, span[0], count)]
    least = min((t[1] for t in tried), default=math.inf)
    queue = [t[0] for t in sorted(with_ridge, key=lambda t: t[1]) if t[1] < least][: limits.slow]
    # with a ridge the valley is not quite the same one: down it from there, then what else is promising
    found = _descend(attempt, queue[0], limits.slow) if queue else []
    found += [attempt(epsilon, TRUNCATED) for epsilon in queue[1 : 1 + limits.slow - len(found)]]
    return [t for t in found if math.isfinite(t[1])]


def _descend(attempt: Attempt, first: float, most: int) -> list[Trial]:
    """Steps from the first as long as the error falls, flatter ones first."""
    found = [attempt(first, TRUNCATED)]
    for step in (1.0 / STEP, STEP):
        at = found[0]
        while len(found) < most:
            found.append(attempt(at[0] * step, TRUNCATED))
            if found[-1][1] >= at[1]:
                break
            at = found[-1]
        if at is not found[0]:
            break
    return found
