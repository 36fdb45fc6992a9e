"""What a run amounts to: least, greatest and mean of each quantity, the limits it is held to, and
its verdict.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypedDict

import numpy as np

from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, quantity_of
from rbfmuscle.scene.check import END_GAP_MM, END_SHARE, MOST_ARTICULAR
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import UsageError, did_you_mean


class QuantityFacts(TypedDict, total=False):
    """What a quantity of a muscle amounts to over the frames [``unit``], ``sd`` their standard
    deviation; None where it is NaN.
    """

    unit: str
    count: int
    first: float | None
    last: float | None
    min: float
    max: float
    mean: float
    sd: float
    median: float
    worst: float | None
    worst_frame: int


# Of a run: muscle -> quantity -> facts, as `Summary.table` gives them.
Table = Mapping[str, Mapping[str, QuantityFacts]]


class Exceedance(NamedTuple):
    """A worst value beyond its limit [unit of ``metrics.csv``], and its frame; a moment arm is
    named with its coordinate. The value is NaN (in files None) where it is unknown.
    """

    muscle: str
    quantity: str
    value: float | None
    limit: float
    frame: int | None


class Unmeasured(NamedTuple):
    """A limit without a value."""

    muscle: str
    quantity: str


class Doubt(NamedTuple):
    """What no limit holds and a reader should know: about a muscle, or `ALL` for the scene."""

    muscle: str
    text: str


class Limits(NamedTuple):
    """What a run is held to: the limit of each quantity in the scene's unit.

    ``fail_on`` are those that make the exit code 6, with the value that the caller gave; None where
    it is the default. A value that was given holds for every muscle as it is (`muscle_limit`).
    """

    values: Mapping[str, float]
    fail_on: Mapping[str, float | None] = {}

    def is_given(self, quantity: str) -> bool:
        """Whether the caller gave the value of this limit."""
        return self.fail_on.get(quantity) is not None

    def is_named(self, quantity: str) -> bool:
        """Whether the caller asked for this limit by name; "all" names none."""
        everything = LIMITS.keys() <= self.fail_on.keys()
        return self.is_given(quantity) or (quantity in self.fail_on and not everything)

    def failing(self) -> "Limits":
        """Those of ``fail_on`` alone."""
        return Limits({name: self.values[name] for name in self.fail_on}, self.fail_on)


# The remedy where none is known to help.
LOOK = "look at that frame: rbfmuscle render RUN --frame FRAME -o frame.png"


class Limit(NamedTuple):
    """Greatest allowed magnitude of a quantity (of those in `LOWER_BOUNDS` the least), lengths in
    millimetres; ``mesh_remedy`` is that of mesh models, ``active_remedy`` that of muscles which
    contract, where it is another.

    A remedy is one that a test follows (tests/metrics/test_advice.py); where none is known to help,
    the frame is named.
    """

    value: float
    title: str
    remedy: str = LOOK
    mesh_remedy: str = ""
    active_remedy: str = ""


# Numbers from the first to below the second are shown without decimals or a power of ten.
_WHOLE = (100.0, 1e5)
_SETTLE = "raise model.iterations"
_CONVERGE = "take a model that converges, as pbd-converged"
_RELAX = "lower the activation: docs/contraction.md"
_JOINT = "correct the joint's centre, axes or range"
_APART = "move muscle or bone apart: rbfmuscle check SCENE"
LIMITS = {
    "volume_error": Limit(1e-9, "volume error"),
    "penetration_max": Limit(0.1, "surface in a bone"),
    "bone_penetration_max": Limit(0.3, "bone in the muscle"),
    "initial_overlap": Limit(0.3, "overlap left at rest", _APART),
    "components": Limit(1.0, "pieces"),
    "euler_characteristic": Limit(2.0, "Euler characteristic"),
    "self_crossings": Limit(0.0, "self-crossing triangles"),
    "solver_residual": Limit(1e-4, "error left by the solver", _SETTLE, _CONVERGE, _RELAX),
    "solid_volume_error": Limit(0.02, "volume error of the solid"),
    "unfitted_fraction": Limit(0.999, "surface shown without a fit"),
    "flicker": Limit(0.5, "flicker"),
    "bowing": Limit(1.03, "bowing"),
    "neighbour_overlap_max": Limit(0.5, "overlap with another muscle"),
    "tunnelled": Limit(0.0, "points beyond a bone"),
    "rest_error_rms": Limit(0.6, "rest error"),
    "end_gap": Limit(
        END_GAP_MM, "end away from its bone", "correct the attachment, or give it a tendon"
    ),
    "tendon_depth": Limit(
        0.3, "tendon in a bone", "give the tendon via points, or move them out of the bones"
    ),
    "articular_share": Limit(
        MOST_ARTICULAR,
        "attachment on an articular surface",
        "correct the attachment: docs/new.md",
    ),
    "moment_arm_jump": Limit(10.0, "moment arm that jumps within 5 degrees"),
    "roughness_beyond_path": Limit(0.5, "length that is rough over 2 degrees"),
    "moment_arm_reversal": Limit(5.0, "moment arm that changes its sign"),
    "doubtful_guesses": Limit(
        0.0,
        "doubtful guesses",
        "look at them (rbfmuscle check SCENE --picture), correct them, and remove their key guess "
        "from their lines",
    ),
    "bone_overlap": Limit(0.0, "bones in each other", _JOINT),
    "joint_gap": Limit(5.0, "joint that opens", _JOINT),
    "missing_bones": Limit(0.0, "bones left out", "repair their meshes and add them to the scene"),
}
# Quantities of which too little is wrong: their limit is the least allowed value.
LOWER_BOUNDS = {"euler_characteristic"}
# Limits of the whole scene, measured under the muscle `ALL`; all others are of each muscle.
OF_SCENE = ("bone_overlap", "joint_gap", "missing_bones")
# Limits that not every muscle has, and the quantity without which it has none: mesh models have no
# level set, muscles with one attachment no centreline.
NEEDS = {
    "flicker": "flicker",
    "unfitted_fraction": "unfitted_fraction",
    "solid_volume_error": "unfitted_fraction",
    "bowing": "length",
    # Known by coordinate alone, and only where one moves by itself.
    "moment_arm_jump": "moment_arm_jump",
    "moment_arm_reversal": "moment_arm_reversal",
    "roughness_beyond_path": "roughness_beyond_path",
}
COUNTS = ("components", "euler_characteristic", "self_crossings", "tunnelled", "doubtful_guesses")
# A muscle thinner than this [mm] may have this rest error [mm].
THIN, THIN_REST_ERROR = 10.0, 1.0
# A muscle that bows at rest may do so by this much more.
MORE_BOWING = 0.03


class Summary:
    """Collects rows of metrics; keeps numbers only, no surfaces."""

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        self._values: dict[str, dict[str, list[tuple[int, float]]]] = defaultdict(
            lambda: defaultdict(list)
        )
        self._units: dict[str, str] = {}
        self.add(rows)

    def add(self, rows: Iterable[Row]) -> None:
        """Take in rows of metrics."""
        for row in rows:
            quantity = row.quantity
            if "moment_arm" in quantity or "roughness" in quantity:
                quantity = f"{quantity}:{row.coordinate}"
            self._values[row.muscle][quantity].append((row.frame, row.value))
            self._units[quantity] = row.unit

    def series(self, quantity: str) -> dict[str, dict[int, float]]:
        """Values of a quantity by muscle and frame."""
        return {
            muscle: dict(found[quantity])
            for muscle, found in self._values.items()
            if quantity in found
        }

    def table(self) -> dict[str, dict[str, QuantityFacts]]:
        """Nested dict: muscle -> quantity -> unit, count, min, max, mean, sd, median, first,
        last, worst and its frame.

        ``worst`` is the value of greatest magnitude, or the least where that is what is limited
        (`LOWER_BOUNDS`). A moment arm is named with its coordinate.
        """
        return {
            muscle: {
                quantity: self._facts(quantity, found) for quantity, found in quantities.items()
            }
            for muscle, quantities in self._values.items()
        }

    def _facts(self, quantity, found):
        frames, values = (np.array(part) for part in zip(*found))
        facts = {
            "unit": self._units[quantity],
            "count": len(values),
            "first": float(values[0]),
            "last": float(values[-1]),
        }
        known = np.isfinite(values)
        if known.any():
            finite = values[known]
            worst = int(
                np.argmin(finite) if quantity in LOWER_BOUNDS else np.argmax(np.abs(finite))
            )
            facts |= {
                "min": float(finite.min()),
                "max": float(finite.max()),
                "mean": float(finite.mean()),
                "sd": float(finite.std()),
                "median": float(np.median(finite)),
                "worst": float(finite[worst]),
                "worst_frame": int(frames[known][worst]),
            }
        return facts


def parse_limits(limits: str | Sequence[str] | None, scene: Scene) -> Limits:
    """The limits of a run: those of `LIMITS`, and in their place or beside them those asked for.

    ``limits`` are like ``"penetration_max=0.5,volume_error"``, or a list of such: a quantity with a
    value in the unit of ``metrics.csv``, or alone with the limit of `LIMITS`; ``"all"`` for every
    one of `LIMITS`. UsageError on an unknown quantity, a value that is no number, or limits that
    are no text.
    """
    if isinstance(limits, Mapping):
        raise UsageError("limits are text, for instance 'penetration_max=0.5,volume_error'")
    listed = [limits] if isinstance(limits, str) else limits or []
    found: dict[str, float | None] = {}
    for part in (part.strip() for text in listed for part in text.split(",") if part.strip()):
        if part == "all":
            found = dict.fromkeys(LIMITS) | found
            continue
        name, given, value = part.replace("<=", "=").partition("=")
        name = name.strip()
        if name not in QUANTITIES:
            raise UsageError(
                f"fail_on: unknown quantity {name!r}, {did_you_mean(name, QUANTITIES)}"
            )
        if not given and name not in LIMITS:
            raise UsageError(f"fail_on {name}: give a value, for instance {name}=1")
        found[name] = found.get(name)
        if given:
            try:
                number = float(value)
            except ValueError:
                number = math.nan
            if not math.isfinite(number) or number < 0:
                raise UsageError(f"fail_on {part}: the limit must be a number, zero or more")
            found[name] = number
    values = {name: limit.value for name, limit in LIMITS.items()}
    values |= {
        name: from_mm(value, scene.units)
        for name, value in values.items()
        if QUANTITIES[name][0] == "length"
    }
    values |= {name: value for name, value in found.items() if value is not None}
    return Limits(values, found)


def muscle_limit(quantity: str, limits: Limits, found: Mapping[str, QuantityFacts]) -> float:
    """Limit of one muscle: of defaults, thin ones and those bowed at rest have wider ones.

    Where an end lies is a fault of a guess alone, unless the limit is asked for by name.
    """
    limit = limits.values[quantity]
    if limits.is_given(quantity):
        return limit
    first = {name: facts.get("first") for name, facts in found.items()}
    thickness = first.get("thickness")
    at_rest = first.get("bowing_at_rest")
    if quantity == "end_gap":
        if not first.get("guessed") and not limits.is_named(quantity):
            return math.inf
        length = first.get("length")
        return limit if length is None else min(limit, END_SHARE * length)
    if quantity == "rest_error_rms" and thickness is not None:
        unit = found["thickness"]["unit"]
        return from_mm(THIN_REST_ERROR, unit) if thickness < from_mm(THIN, unit) else limit
    if quantity == "bowing" and at_rest is not None:
        return max(limit, at_rest + MORE_BOWING)
    return limit


def meets_limit(quantity: str, worst: float, limit: float) -> bool:
    """Whether a worst value keeps to a limit, which is the least allowed value for those in
    `LOWER_BOUNDS`; NaN does not.
    """
    return worst >= limit if quantity in LOWER_BOUNDS else abs(worst) <= limit


def exceeded(table: Table, limits: Limits) -> list[Exceedance]:
    """What is beyond the limits, the worst first; NaN counts as beyond."""
    found = []
    for muscle, quantities in table.items():
        for name, facts in quantities.items():
            quantity = quantity_of(name)
            if quantity not in limits.values:
                continue
            limit = muscle_limit(quantity, limits, quantities)
            worst = facts.get("worst")
            worst = math.nan if worst is None else worst  # as a file has it
            if not meets_limit(quantity, worst, limit):
                found.append(Exceedance(muscle, name, worst, limit, facts.get("worst_frame")))
    return sorted(
        found, key=lambda row: limit_ratio(row.quantity, row.value, row.limit), reverse=True
    )


def unmeasured(table: Table, limits: Limits) -> list[Unmeasured]:
    """The limits without a value; `ALL` where no muscle has one."""
    muscles = [name for name in table if name != ALL]
    found = []
    for quantity in limits.values:
        having = {
            muscle
            for muscle, quantities in table.items()
            if any(quantity_of(name) == quantity for name in quantities)
        }
        if quantity in OF_SCENE or not muscles:
            wanted = [ALL]
        elif quantity in LIMITS:
            need = NEEDS.get(quantity)
            wanted = [name for name in muscles if need is None or need in table[name]]
        else:
            wanted = [] if having else [ALL]
        if limits.is_named(quantity) and not having:
            wanted = wanted or [ALL]
        found += [Unmeasured(muscle, quantity) for muscle in wanted if muscle not in having]
    return found


def limit_ratio(quantity: str, worst: float | None, limit: float) -> float:
    """How many times its limit a worst value is; of limits that cannot say so, 0 within and
    infinite beyond.
    """
    worst = math.nan if worst is None else worst
    if quantity in LOWER_BOUNDS or limit <= 0 or not math.isfinite(worst):
        return 0.0 if meets_limit(quantity, worst, limit) else math.inf
    return abs(worst) / limit


def shown_number(value: float | None, unit: str = "") -> str:
    """A value with three digits and its unit: less than 1e-12 and 0.01 mm as such, seconds as
    milliseconds.
    """
    if value is None or math.isnan(value):
        return "–"
    if unit == "s" and abs(value) < 1.0:
        value, unit = 1e3 * value, "ms"
    least = {"mm": 0.01}.get(unit, 1e-12)
    if 0.0 < abs(value) < least:
        text = f"< {least:g}"
    else:
        text = f"{value:.0f}" if _WHOLE[0] <= abs(value) < _WHOLE[1] else f"{value:.3g}"
    return text if unit in ("", "1") else f"{text} {unit}"
