"""What a run amounts to: least, greatest and mean of each quantity, and the limits that it is held to."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.metrics.quantities import ALL, QUANTITIES
from rbfmuscle.validation import LimitExceededError, UsageError, did_you_mean

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


# Quantity: greatest allowed magnitude; lengths in millimetres, converted to the scene's unit.
LIMITS = {
    "volume_error": 1e-3,
    "penetration_max": 0.5,
    "bone_penetration_max": 0.5,
    "solver_penetration_max": 3.0,
    "components": 1.0,
    "euler": 2.0,
    "self_crossing": 0.0,
    "unfitted_fraction": 0.05,
    "flicker_rms": 0.1,
    "flicker_max": 0.5,
    "tunnelled": 0.0,
    "rest_error_rms": 0.6,
    "rest_error_max": 5.0,
}

MOST_NAMED = 6  # exceeded limits that a verdict names
# Quantities of which too little is wrong: their limit is the least allowed value.
LEAST = {"euler"}


class Summary:
    """Collects rows of metrics; keeps numbers only, no surfaces."""

    def __init__(self) -> None:
        self._values = defaultdict(lambda: defaultdict(list))
        self._units = {}

    def add(self, rows: list[Any]) -> None:
        """Take in rows of metrics."""
        for row in rows:
            quantity = row.quantity
            if "moment_arm" in quantity:
                quantity = f"{quantity}:{row.coordinate}"
            self._values[row.muscle][quantity].append((row.frame, row.value))
            self._units[quantity] = row.unit

    def table(self) -> dict[str, Any]:
        """Nested dict: muscle -> quantity -> unit, count, min, max, mean, median, last, worst and its frame.

        ``worst`` is the value of greatest magnitude, or the least where that is what is limited (`LEAST`). A moment
        arm is named with its coordinate.
        """
        return {
            muscle: {quantity: self._facts(quantity, found) for quantity, found in quantities.items()}
            for muscle, quantities in self._values.items()
        }

    def _facts(self, quantity, found):
        frames = [frame for frame, _ in found]
        values = np.array([value for _, value in found])
        finite = values[np.isfinite(values)]
        facts = {"unit": self._units[quantity], "count": len(values), "last": float(values[-1])}
        if len(finite):
            sound = np.where(np.isfinite(values), values, np.nan)
            worst = int(np.nanargmin(sound) if quantity in LEAST else np.nanargmax(np.abs(sound)))
            facts |= {
                "min": float(finite.min()),
                "max": float(finite.max()),
                "mean": float(finite.mean()),
                "median": float(np.median(finite)),
                "worst": float(values[worst]),
                "worst_frame": frames[worst],
            }
        return facts


def parse_limits(limits: Any, scene: Scene) -> dict[str, Any]:
    """Limits as a dict of quantity to greatest allowed magnitude.

    Parameters
    ----------
    limits : str, list of str, dict or None
        ``"penetration_max=0.5,volume_error"``: a quantity with a value in the unit of ``metrics.csv``, or
        alone with the limit of `LIMITS`; ``"all"`` for every one of `LIMITS`.
    scene : Scene

    Raises
    ------
    UsageError
        On an unknown quantity or a value that is no number.
    """
    if not limits:
        return {}
    if isinstance(limits, dict):
        parts = [f"{name}={value}" for name, value in limits.items()]
    else:
        listed = [limits] if isinstance(limits, str) else limits
        parts = [part.strip() for text in listed for part in text.split(",") if part.strip()]
    found = {}
    for part in parts:
        if part == "all":
            found |= {name: default_limit(name, scene) for name in LIMITS}
            continue
        name, given, value = part.replace("<=", "=").partition("=")
        name = name.strip()
        _check_quantity(name)
        if given:
            found[name] = _number(value, part)
        elif name in LIMITS:
            found[name] = default_limit(name, scene)
        else:
            raise UsageError(f"--fail-on {name}: give a value, for instance {name}=1")
    return found


def default_limit(quantity: str, scene: Scene) -> float:
    """Limit of a quantity in the scene's unit."""
    is_length = QUANTITIES[quantity][0] == "length"
    return scene.length(LIMITS[quantity]) if is_length else LIMITS[quantity]


def within(quantity: str, worst: float, limit: float) -> bool:
    """Whether a worst value keeps to a limit, which is the least allowed value for those in `LEAST`; NaN does not."""
    return worst >= limit if quantity in LEAST else abs(worst) <= limit


def exceeded(table: dict[str, Any], limits: dict[str, Any]) -> list[Any]:
    """List of (muscle, quantity, worst value, limit, frame) beyond the limits; NaN counts as beyond."""
    found = []
    for muscle, quantities in table.items():
        for name, facts in quantities.items():
            limit = limits.get(name.partition(":")[0])
            if limit is None or muscle == ALL:
                continue
            worst = facts.get("worst")
            worst = math.nan if worst is None else worst  # as a file has it
            if not within(name, worst, limit):
                found.append((muscle, name, worst, limit, facts.get("worst_frame")))
    return found


def describe_verdict(table: dict[str, Any], limits: dict[str, Any]) -> str:
    """One sentence: all muscles within their limits, or what exceeds one, with its value, the worst ratio first."""
    found = exceeded(table, limits)
    if not found:
        return "every muscle stays within every limit in every frame"
    found.sort(key=_excess, reverse=True)
    parts = [
        f"{muscle}: {name} {worst:.3g} (limit {limit:g}) at frame {frame}"
        for muscle, name, worst, limit, frame in found[:MOST_NAMED]
    ]
    more = f" and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
    return f"beyond a limit: {'; '.join(parts)}{more}"


def _excess(row):
    """How many times its limit a worst value is, as far as that can be said."""
    _, quantity, worst, limit, _ = row
    bounded = quantity not in LEAST and limit > 0 and math.isfinite(worst)
    return abs(worst) / limit if bounded else math.inf


def require_limits(table: dict[str, Any], limits: dict[str, Any]) -> None:
    """Raise LimitExceededError naming everything beyond the limits."""
    found = exceeded(table, limits)
    if found:
        text = "; ".join(
            f"{m}: {q} = {v:.4g} {'<' if q in LEAST else '>'} {limit:g} at frame {f}"
            for m, q, v, limit, f in found
        )
        raise LimitExceededError(text)


def _check_quantity(name):
    if name not in QUANTITIES:
        raise UsageError(f"--fail-on: unknown quantity {name!r}, {did_you_mean(name, QUANTITIES)}")


def _number(text, part):
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise UsageError(f"--fail-on {part}: the limit must be a number, zero or more")
    return value
