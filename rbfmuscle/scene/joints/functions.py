"""Functions of joint coordinates: constant, linear, polynomial, piecewise linear, splines.

Each takes the values of its coordinates in order and returns one number; those of one variable take the first.
``rescaled`` gives the function in other units, ``g(f_k q_k) = output * self(q)``, f the ``inputs``.
"""

import bisect
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np


@dataclass(frozen=True)
class Constant:
    """The same value at every coordinate."""

    value: float

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return self.value

    def rescaled(self, inputs: list[float], output: float) -> "Constant":
        """Return the function in other units."""
        return Constant(self.value * output)


@dataclass(frozen=True)
class Linear:
    """``c1 q1 + ... + cn qn + constant``."""

    slopes: tuple[float, ...]
    constant: float = 0.0

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        total = 0.0
        for slope, value in zip(self.slopes, values):
            total += slope * value
        return total + self.constant

    def rescaled(self, inputs: list[float], output: float) -> "Linear":
        """Return the function in other units."""
        slopes = tuple(c if output == f else c * output / f for c, f in zip(self.slopes, inputs))
        return Linear(slopes, self.constant * output)


@dataclass(frozen=True)
class Polynomial:
    """Of one coordinate, highest power first."""

    coefficients: tuple[float, ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        total = 0.0
        for coefficient in self.coefficients:
            total = total * values[0] + coefficient
        return total

    def rescaled(self, inputs: list[float], output: float) -> "Polynomial":
        """Return the function in other units."""
        top = len(self.coefficients) - 1
        return Polynomial(tuple(c * output / inputs[0] ** (top - k) for k, c in enumerate(self.coefficients)))


@dataclass(frozen=True)
class _Points:
    x: tuple[float, ...]
    y: tuple[float, ...]

    def rescaled(self, inputs: list[float], output: float) -> Self:
        """Return the function in other units."""
        x, y = (tuple(v * f for v in values) for values, f in ((self.x, inputs[0]), (self.y, output)))
        return replace(self, x=x, y=y)

    def _piece(self, q: float) -> tuple[int, float, float]:
        """Number of the piece that holds q, its width, and the fraction of it before q."""
        k = min(max(bisect.bisect_right(self.x, q) - 1, 0), len(self.x) - 2)
        width = self.x[k + 1] - self.x[k]
        return k, width, (q - self.x[k]) / width


@dataclass(frozen=True)
class PiecewiseLinear(_Points):
    """Straight between the points; the first and the last piece go on beyond them."""

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        if len(self.x) == 1:
            return self.y[0]
        k, _, t = self._piece(values[0])
        return self.y[k] + t * (self.y[k + 1] - self.y[k])


@dataclass(frozen=True)
class Spline(_Points):
    """Cubic spline through points; beyond them it goes on straight.

    With ``natural`` false it is the spline of Forsythe, Malcolm and Moler (1977), which OpenSim calls SimmSpline:
    the third derivative of the first and of the last piece is that of the cubic through the four points there.
    With ``natural`` true the second derivative is zero at both ends.
    """

    natural: bool = False
    _bend: tuple[float, ...] = field(init=False, repr=False, compare=False, default=())

    def __post_init__(self) -> None:
        bend = second_derivatives(np.array(self.x), np.array(self.y), natural=self.natural)
        object.__setattr__(self, "_bend", tuple(bend.tolist()))

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        q, x, y, m = values[0], self.x, self.y, self._bend
        if len(x) == 1:
            return y[0]
        k, h, t = self._piece(q)
        if q < x[0] or q > x[-1]:
            # At an end of a piece the slope differs from the chord's by the bends at both.
            slope, after = (y[k + 1] - y[k]) / h, q > x[-1]
            slope += h * (m[k] + 2.0 * m[k + 1]) / 6.0 if after else -h * (2.0 * m[k] + m[k + 1]) / 6.0
            return (y[-1] if after else y[0]) + slope * (q - (x[-1] if after else x[0]))
        s = 1.0 - t
        bend = (s**3 - s) * m[k] + (t**3 - t) * m[k + 1]
        return s * y[k] + t * y[k + 1] + h * h * bend / 6.0


Function = Constant | Linear | Polynomial | PiecewiseLinear | Spline


def scaled(function: Function, factor: float) -> Function:
    """Return ``factor`` times a function."""
    count = len(function.slopes) if isinstance(function, Linear) else 1
    return function.rescaled([1.0] * count, factor)


def second_derivatives(x: np.ndarray, y: np.ndarray, *, natural: bool) -> np.ndarray:
    """Second derivatives of a cubic spline at its points.

    Parameters
    ----------
    x, y : (n,) ndarray
        Points, ``x`` increasing.
    natural : bool
        Zero at both ends, instead of the third derivatives of the cubics through four points.

    Returns
    -------
    (n,) ndarray
    """
    n = len(x)
    if n < 3:
        return np.zeros(n)
    h = np.diff(x)
    matrix, right = np.zeros((n, n)), np.zeros(n)
    inner = np.arange(1, n - 1)
    matrix[inner, inner - 1], matrix[inner, inner + 1] = h[:-1], h[1:]
    matrix[inner, inner] = 2.0 * (h[:-1] + h[1:])
    right[1:-1] = 6.0 * np.diff(np.diff(y) / h)
    if natural:
        matrix[0, 0] = matrix[-1, -1] = 1.0
    else:
        matrix[0, :2], matrix[-1, -2:] = [-1.0, 1.0], [-1.0, 1.0]
        if n > 3:  # three points: one parabola
            right[0], right[-1] = 6.0 * h[0] * _third(x[:4], y[:4]), 6.0 * h[-1] * _third(x[-4:], y[-4:])
    return np.linalg.solve(matrix, right)


def _third(x, y):
    """Third divided difference of four points."""
    table = y
    for order in range(1, 4):
        table = np.diff(table) / (x[order:] - x[:-order])
    return float(table[0])
