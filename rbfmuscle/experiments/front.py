"""The Pareto front of error and time, and where the default lies."""

import math
from collections.abc import Sequence
from typing import Any

from rbfmuscle.metrics.quantities import QUANTITIES
from rbfmuscle.metrics.summary import shown_number

# Worst over muscles and frames, by magnitude.
WORST = (
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "solver_penetration_max",
    "rest_error_rms",
    "edge_strain_rms",
    "components",
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


def mark_front(rows: list[dict[str, Any]], quantity: str = "error_rms") -> list[dict[str, Any]]:
    """Mark the front among the points of each reference, and judge the default of each against
    ``time_frame``.

    References take no part: their error is zero by definition. A verdict holds ``factor``: the
    least by which both error and time of the default must fall to lie on the front, 1 on it;
    ``near``: up to `NEAR`; ``faster``, ``better``: keys of the quickest point of no greater error
    and the most accurate of no greater time, None where there is none; ``text``: all of it in
    words.
    """
    verdicts = []
    for group in dict.fromkeys(row["reference"] for row in rows if row["reference"]):
        mine = [row for row in rows if row["reference"] == group and row["role"] != "reference"]
        usable = [row for row in mine if row["status"] == "done"]
        for k in pareto_front([r[quantity] for r in usable], [r["time_frame"] for r in usable]):
            usable[k]["front"] = True
        default = [
            row for row in usable if row["role"] == "default" and math.isfinite(row[quantity])
        ]
        verdicts += [_judge(row, usable, quantity) for row in default]
    return verdicts


def _judge(default: dict[str, Any], rows: list[dict[str, Any]], quantity: str) -> dict[str, Any]:
    error, time = default[quantity], default["time_frame"]
    others = [r for r in rows if r is not default and math.isfinite(r[quantity])]
    factor = max(
        [1.0, *(min(_ratio(error, r[quantity]), _ratio(time, r["time_frame"])) for r in others)]
    )
    quicker = [r for r in others if r[quantity] <= error and r["time_frame"] < time]
    finer = [r for r in others if r["time_frame"] <= time and r[quantity] < error]
    faster = min(quicker, key=lambda r: r["time_frame"], default=None)
    better = min(finer, key=lambda r: r[quantity], default=None)
    off = "within 10 % of" if factor <= NEAR else f"a factor of {factor:.2g} off"
    where = "on" if default["front"] else off
    text = (
        f"{default['scene']}: the default lies {where} the Pareto front "
        f"({_figures(default, quantity)})"
    )
    for row, words in ((faster, "as accurate and quicker"), (better, "as quick and more accurate")):
        text += f"; {words}: {row['label']} ({_figures(row, quantity)})" if row else ""
    keys = {
        "faster": faster and faster["key"],
        "better": better and better["key"],
        "default": default["key"],
    }
    return {
        "scene": default["scene"],
        "factor": factor,
        "near": factor <= NEAR,
        **keys,
        "text": f"{text}.",
    }


def _ratio(mine: float, other: float) -> float:
    return mine / other if other > 0 else (math.inf if mine > 0 else 1.0)


def _figures(row: dict[str, Any], quantity: str) -> str:
    unit = row["units"] if quantity in LENGTHS else ""
    return (
        f"{shown_number(row[quantity], unit)} at {shown_number(row['time_frame'], 's')} per frame"
    )
