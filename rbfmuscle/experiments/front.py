"""The Pareto front of error and time, and where the default lies."""

import math
from collections.abc import Sequence

from rbfmuscle.experiments.sweep_table import FrontVerdict, SweepRow
from rbfmuscle.metrics.quantities import QUANTITIES
from rbfmuscle.metrics.summary import shown_number

# Worst over muscles and frames, by magnitude: of a point of a sweep, and of the README's table.
WORST = (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "solver_penetration_max",
    "neighbour_overlap_max",
    "rest_error_rms",
    "rest_error_max",
    "edge_strain_rms",
    "components",
    "flicker",
    "bowing",
    "self_crossings",
)
# In the scene's unit.
LENGTHS = ("error_rms", "error_max", *(name for name in WORST if QUANTITIES[name][0] == "length"))
# The default may be this much worse than the front, in error and in time at once.
NEAR = 1.1


def pareto_front(errors: Sequence[float], times: Sequence[float]) -> list[int]:
    """Indices, by growing time, of points that no other beats in error or time without loss; NaN
    takes no part.
    """
    front, least = [], math.inf
    for k in sorted(range(len(errors)), key=lambda k: (times[k], errors[k])):
        if math.isfinite(errors[k]) and math.isfinite(times[k]) and errors[k] < least:
            front.append(k)
            least = errors[k]
    return front


def mark_front(rows: list[SweepRow], quantity: str = "error_rms") -> list[FrontVerdict]:
    """Mark the front among the points of each reference, and judge the default of each against
    ``time_frame``.

    References take no part: their error is zero by definition.
    """
    verdicts = []
    for group in dict.fromkeys(row.reference for row in rows if row.reference):
        mine = [row for row in rows if row.reference == group and row.role != "reference"]
        usable = [row for row in mine if row.status == "done"]
        errors = [row.value(quantity) for row in usable]
        for k in pareto_front(errors, [row.value("time_frame") for row in usable]):
            usable[k].front = True
        default = [
            row for row in usable if row.role == "default" and math.isfinite(row.value(quantity))
        ]
        verdicts += [_judge(row, usable, quantity) for row in default]
    return verdicts


def _judge(default: SweepRow, rows: list[SweepRow], quantity: str) -> FrontVerdict:
    def error(row: SweepRow) -> float:
        return row.value(quantity)

    def time(row: SweepRow) -> float:
        return row.value("time_frame")

    others = [row for row in rows if row is not default and math.isfinite(error(row))]
    ratios = [
        min(_ratio(error(default), error(row)), _ratio(time(default), time(row))) for row in others
    ]
    factor = max([1.0, *ratios])
    quicker = [r for r in others if error(r) <= error(default) and time(r) < time(default)]
    finer = [r for r in others if time(r) <= time(default) and error(r) < error(default)]
    faster = min(quicker, key=time, default=None)
    better = min(finer, key=error, default=None)
    off = "within 10 % of" if factor <= NEAR else f"a factor of {factor:.2g} off"
    where = "on" if default.front else off
    text = (
        f"{default.scene}: the default lies {where} the Pareto front "
        f"({_figures(default, quantity)})"
    )
    for row, words in ((faster, "as accurate and quicker"), (better, "as quick and more accurate")):
        text += f"; {words}: {row.label} ({_figures(row, quantity)})" if row else ""
    return FrontVerdict(
        scene=default.scene,
        factor=factor,
        near=factor <= NEAR,
        faster=faster and faster.key,
        better=better and better.key,
        default=default.key,
        text=f"{text}.",
    )


def _ratio(mine: float, other: float) -> float:
    return mine / other if other > 0 else (math.inf if mine > 0 else 1.0)


def _figures(row: SweepRow, quantity: str) -> str:
    unit = row.units if quantity in LENGTHS else ""
    error, time = row.value(quantity), row.value("time_frame")
    return f"{shown_number(error, unit)} at {shown_number(time, 's')} per frame"
