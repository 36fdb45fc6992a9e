"""Which row of a kernel study to take: errors with intervals, ties, what a tie costs, and fields that broke.

An error measured at points of a surface is itself uncertain; a bootstrap over the points (Efron 1979) gives each
figure an interval. Rows whose intervals reach the best one's are a tie, and within a tie the choice is by what users
pay: time, condition, a parameter to choose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats

# Bootstrap samples, and the share of them that an interval holds.
SAMPLES, HELD = 200, 0.9
# A level zero that encloses so much more or less than the mesh has lost or gained a part of it.
VOLUME_BOUND = 0.1
# The coarsest sensible kernel, |r|, is taken as the bound of the error; where it is not in the study, this many
# times the median error of the rows with as many centres.
COARSEST, TIMES_MEDIAN = "linear", 3.0
# Rows beyond this condition are taken only where none of the tie is below it.
SOUND = 1e10
# Quicker by less than this share is no reason to prefer a row; times of one are apart by a few per cent.
QUICKER = 0.15
# What a row for speed may err, in units of the least error.
COARSER = 1.5


class Bootstrap:
    """Intervals of root mean square errors; the same draws for every row, so that rows can be compared.

    Parameters
    ----------
    count : int
        Points at which errors are measured.
    seed : int
    """

    def __init__(self, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.weights = rng.multinomial(count, np.full(count, 1.0 / count), size=SAMPLES).astype(np.float32)
        self.weights /= count

    def interval(self, there: Floats, back: Floats) -> tuple[float, float]:
        """Interval of the RMS distance both ways.

        Parameters
        ----------
        there : (count,) ndarray
            Distances of the mesh's points from the surface [length].
        back : (n,) ndarray
            Distances of the surface's vertices from the mesh [length], whose mean is drawn with as many points.
        """
        mean = self.weights @ (there**2).astype(np.float32)
        spread = float(np.std(back**2)) / np.sqrt(len(back))
        rng = np.random.default_rng(len(back))
        other = np.maximum(np.mean(back**2) + spread * rng.standard_normal(SAMPLES), 0.0)
        errors = np.sqrt(0.5 * (mean + other))
        low, high = np.quantile(errors, [0.5 - HELD / 2, 0.5 + HELD / 2])
        return float(low), float(high)


def mark_unfit(rows: list[dict[str, Any]], *, sheets: int = 1, condition: float = np.inf) -> None:
    """Set ``unfit`` of each row: why its field must not be used, or empty.

    Parameters
    ----------
    rows : list of dict
    sheets : int
        Parts of the mesh.
    condition : float
        Its greatest allowed value.
    """
    for row in rows:
        row["unfit"] = _why_unfit(row, sheets)
        if not row["unfit"] and row["condition"] > condition:
            row["unfit"] = f"a condition of {row['condition']:.1e}, beyond {condition:g}"
    for count in {row["centres"] for row in rows}:
        good = [row for row in rows if row["centres"] == count and not row["unfit"]]
        if not good:
            continue
        plain = [row["rms"] for row in good if row["kernel"] == COARSEST]
        bound = plain[0] if plain else TIMES_MEDIAN * float(np.median([row["rms"] for row in good]))
        for row in good:
            if row["rms"] > bound:
                than = f"that of {COARSEST}" if plain else f"{TIMES_MEDIAN:g} times the median"
                row["unfit"] = f"an error of {row['rms']:.3g}, beyond {than}, {bound:.3g}"


def _why_unfit(row, sheets):
    if row["rms"] is None:
        return row["note"] or "no closed surface"
    if row["components"] > sheets:
        return f"{row['components']} sheets where the mesh has {sheets}"
    if abs(row["volume_error"]) > VOLUME_BOUND:
        return f"{100 * row['volume_error']:+.3g} % of volume, beyond {100 * VOLUME_BOUND:g}"
    return ""


def cost(row: dict[str, Any]) -> float:
    """What a frame pays for a row's field: a fit and the values at 20,000 points [s of processor time]."""
    return float(row["fit_time"] + row["evaluation_time"])


@dataclass
class Recommendation:
    """The rows to take.

    Attributes
    ----------
    row : dict
        The cheapest of the tie.
    reason : str
        One sentence.
    tie : list of dict
        Rows whose intervals reach the best one's, the cheapest first.
    quickest, most_accurate : dict or None
        Where another row is quicker at up to half more error, or nominally more accurate.
    """

    row: dict[str, Any]
    reason: str
    tie: list[dict[str, Any]]
    quickest: dict[str, Any] | None = None
    most_accurate: dict[str, Any] | None = None


def recommend(rows: list[dict[str, Any]]) -> Recommendation | None:
    """Choose among the rows of a study; None where every one is unfit.

    Parameters
    ----------
    rows : list of dict
        With ``rms, low, high, fit_time, evaluation_time, condition, epsilon, unfit``.
    """
    good = sorted((row for row in rows if not row["unfit"]), key=lambda row: row["rms"])
    if not good:
        return None
    best = good[0]
    tie = [row for row in good if row["low"] <= best["high"]]
    tie.sort(key=_preference(tie))
    row = tie[0]
    quick = min((r for r in good if r["rms"] <= COARSER * best["rms"]), key=cost)
    return Recommendation(
        row,
        _reason(row, best, tie),
        tie,
        quickest=quick if cost(quick) < (1.0 - QUICKER) * cost(row) else None,
        most_accurate=best if best is not row else None,
    )


def _preference(tie):
    """Order within a tie: sound conditions first, time in steps, no parameter to choose, the condition."""
    least = min(cost(row) for row in tie)

    def key(row):
        steps = int(np.log(cost(row) / least) / np.log1p(QUICKER))
        return row["condition"] > SOUND, steps, bool(row["epsilon"]), row["condition"]

    return key


def named(row: dict[str, Any]) -> str:
    """A row in words."""
    return f"{row['kernel']}, {row['centres']} centres"


def _reason(row, best, tie):
    place = f"{row['rms']:.3g} RMS ({row['low']:.3g} to {row['high']:.3g})"
    if len(tie) == 1:
        return f"{place}, no other is as accurate"
    others = f"one of {len(tie)} that cannot be told apart from the best, {best['rms']:.3g}"
    slow, quick = max(tie, key=cost), min(tie, key=cost)
    parts = [f"{place}, {others}"]
    if cost(slow) > 1.5 * cost(row):
        parts.append(f"and up to {cost(slow) / cost(row):.1f} times as quick as they are")
    elif quick is not row and cost(row) <= (1.0 + QUICKER) * cost(quick):
        parts.append(f"as quick as the quickest of them to {100 * QUICKER:.0f} %")
    if row["condition"] <= SOUND < quick["condition"]:
        parts.append(f"of a condition of at most {SOUND:.0e}".replace("e+", "e"))
    if not row["epsilon"]:
        parts.append("without a shape parameter to choose")
    return ", ".join(parts)
