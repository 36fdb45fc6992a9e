"""Settings of an RBF muscle, and what they may be."""

import math
from dataclasses import dataclass, fields

from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED
from rbfmuscle.implicit.placement.sampling import PLACEMENTS
from rbfmuscle.sim.scene.options import did_you_mean
from rbfmuscle.validation import SceneError, UsageError

# What the settings may be; all others are free.
RANGES = {
    "centres": (0, 20000), "samples": (50, 200000), "iterations": (1, 1000), "contacts": (1, 10000),
    "resolution": (4, 1000), "epsilon": (0.0, math.inf), "stretch_low": (0.01, 1.0),
    "stretch_high": (1.0, 100.0), "stretch_hold": (0.0, 1.0), "across": (0, 50), "across_weight": (0.0, 1e6),
    "acceleration": (0, 50),
}  # fmt: skip
CHOICES = {"placement": (*PLACEMENTS, FITTED), "derivatives": ("auto", "all", "normal")}


@dataclass(frozen=True)
class RBFOptions:
    """Settings of an RBF muscle; each is a key of the muscle's model table in the scene file."""

    centres: int = 0
    samples: int = 2000
    iterations: int = 8
    contacts: int = 24
    resolution: int = 48
    kernel: str = "cubic"
    epsilon: float = 0.0
    stretch_low: float = 0.5
    stretch_high: float = 2.0
    stretch_hold: float = 0.3
    across: int = 3
    across_weight: float = 1.0
    acceleration: int = 5
    placement: str = "greedy"
    derivatives: str = "auto"
    seed: int = 0

    @classmethod
    def from_table(cls, table, *, muscle):
        """Build from a scene's model table; raises SceneError naming an unknown or impossible key."""
        known = {field.name: field.type for field in fields(cls)}
        for key, value in table.items():
            if key not in known:
                hint = did_you_mean(key, known)
                raise SceneError(f"muscle {muscle!r}: model rbf has no setting {key!r}, {hint}")
            if known[key] is not str and (isinstance(value, bool) or not isinstance(value, (int, float))):
                raise SceneError(f"muscle {muscle!r}: {key} must be a number, got {value!r}")
            low, high = RANGES.get(key, (-math.inf, math.inf))
            if known[key] is not str and not low <= value <= high:
                raise SceneError(f"muscle {muscle!r}: {key} must be {_range(low, high)}, got {value:g}")
            if key in CHOICES and value not in CHOICES[key]:
                raise SceneError(
                    f"muscle {muscle!r}: {key} must be one of {', '.join(CHOICES[key])}, got {value!r}"
                )
        try:
            get_kernel(table.get("kernel", cls.kernel))
        except UsageError as error:
            raise SceneError(f"muscle {muscle!r}: {error}") from None
        return cls(**table)


def _range(low, high):
    return f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
