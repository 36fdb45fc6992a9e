"""What a scalar field in space offers: the port between those who have one and those who draw or cut by it."""

from collections.abc import Callable
from typing import Protocol

import numpy as np


class Field(Protocol):
    """A scalar field: its values, and its values with their gradients."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3)."""

    def value_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) at points (n, 3)."""


class LevelField:
    """A field less a level: its zero set is the field's set of that level.

    Parameters
    ----------
    field : Field
    level : float
    """

    def __init__(self, field: Field, level: float) -> None:
        self.field, self.level = field, level

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3)."""
        return self.field(points) - self.level

    def value_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) at points (n, 3)."""
        value, gradient = self.field.value_and_gradient(points)
        return value - self.level, gradient


class FormulaField:
    """A field from a formula for its values; gradients are central differences.

    Parameters
    ----------
    formula : callable
        ``points (n, 3) -> values (n,)``.
    step : float
        Of the differences, in the unit of the points.
    """

    def __init__(self, formula: Callable[[np.ndarray], np.ndarray], step: float) -> None:
        self.formula, self.step = formula, step

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Values (n,) at points (n, 3)."""
        return self.formula(points)

    def value_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) at points (n, 3)."""
        offsets = self.step * np.vstack([np.eye(3), -np.eye(3)])
        around = self.formula((points[None] + offsets[:, None]).reshape(-1, 3)).reshape(6, -1)
        return self.formula(points), ((around[:3] - around[3:]) / (2.0 * self.step)).T
