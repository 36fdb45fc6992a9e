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
