"""What a scalar field in space offers: the port between those who have one and those who draw or
cut by it.
"""

from typing import Protocol

import numpy as np


class Field(Protocol):
    """A scalar field: its values, and its values with their gradients."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3)."""

    def value_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) at points (n, 3)."""


class ClipDistance(Protocol):
    """What cuts a surface: a signed distance, negative inside, that need not be exact far away.

    No value changes by more than one for each unit of way, so that answers bound those nearby.
    """

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3); a lower bound where they are farther than a surface
        comes.
        """

    def value_and_gradient_below(
        self, points: np.ndarray, limit: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3), only lower bounds where a value is beyond its limit
        (n,).
        """


class BoneField(Protocol):
    """What tells how far points are from a bone, in bone coordinates or, with a pose (4, 4), in the
    world.
    """

    bounds: np.ndarray  # (2, 3) box of the bone, at rest

    def distance(
        self,
        points: np.ndarray,
        pose: np.ndarray | None = None,
        *,
        reach: np.ndarray | float = np.inf,
    ) -> np.ndarray:
        """Signed distances (n,), negative inside; a lower bound where they are beyond ``reach``."""

    def distance_and_gradient(
        self, points: np.ndarray, pose: np.ndarray | None = None, reach: np.ndarray | float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same with gradients (n, 3) in the axes of the points."""
