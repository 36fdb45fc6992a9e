"""Functions of joint coordinates: constant, linear, polynomial, piecewise linear, splines, scaled.

Each takes the values of its coordinates in order and returns one number; those of one variable take the first.
"""

import bisect
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Constant:
    """The same value at every coordinate."""

    value: float

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return self.value

    def rescaled(self, inputs: list[float], output: float) -> "Constant":
        """Return the function in other units: ``g(f_k q_k) = output * self(q)``."""
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
        """Return the function in other units, see `Constant.rescaled`."""
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
        """Return the function in other units, see `Constant.rescaled`."""
        top = len(self.coefficients) - 1
        return Polynomial(tuple(c * output / inputs[0] ** (top - k) for k, c in enumerate(self.coefficients)))


@dataclass(frozen=True)
class PiecewiseLinear:
    """Straight between the points; the first and the last piece go on beyond them."""

    x: tuple[float, ...]
    y: tuple[float, ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        if len(self.x) == 1:
            return self.y[0]
        k = min(max(bisect.bisect_right(self.x, values[0]) - 1, 0), len(self.x) - 2)
        t = (values[0] - self.x[k]) / (self.x[k + 1] - self.x[k])
        return self.y[k] + t * (self.y[k + 1] - self.y[k])

    def rescaled(self, inputs: list[float], output: float) -> "PiecewiseLinear":
        """Return the function in other units, see `Constant.rescaled`."""
        return PiecewiseLinear(*_rescaled_points(self, inputs, output))


@dataclass(frozen=True)
class Spline:
    """Cubic spline through points; beyond them it goes on straight.

    With ``natural`` false it is the spline of Forsythe, Malcolm and Moler (1977), which OpenSim calls SimmSpline:
    the third derivative of the first and of the last piece is that of the cubic through the four points there.
    With ``natural`` true the second derivative is zero at both ends.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
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
        last = len(x) - 1
        if q < x[0] or q > x[last]:
            k, t, e, side = (0, 0.0, x[0], 0) if q < x[0] else (last - 1, 1.0, x[last], 1)
            h = x[k + 1] - x[k]
            slope = (y[k + 1] - y[k]) / h
            # At an end of a piece the slope differs from the chord's by the bends at both.
            slope += h * (m[k] + 2.0 * m[k + 1]) / 6.0 if side else -h * (2.0 * m[k] + m[k + 1]) / 6.0
            return (y[last] if side else y[0]) + slope * (q - e)
        k = min(max(bisect.bisect_right(x, q) - 1, 0), last - 1)
        h = x[k + 1] - x[k]
        t = (q - x[k]) / h
        s = 1.0 - t
        bend = (s**3 - s) * m[k] + (t**3 - t) * m[k + 1]
        return s * y[k] + t * y[k + 1] + h * h * bend / 6.0

    def rescaled(self, inputs: list[float], output: float) -> "Spline":
        """Return the function in other units, see `Constant.rescaled`."""
        x, y = _rescaled_points(self, inputs, output)
        return Spline(x, y, natural=self.natural)


@dataclass(frozen=True)
class Scaled:
    """``factor`` times another function."""

    factor: float
    inner: "Function"

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return self.factor * self.inner(*values)

    def rescaled(self, inputs: list[float], output: float) -> "Scaled":
        """Return the function in other units, see `Constant.rescaled`."""
        return Scaled(self.factor, self.inner.rescaled(inputs, output))


Function = Constant | Linear | Polynomial | PiecewiseLinear | Spline | Scaled


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


def _rescaled_points(function, inputs, output):
    return tuple(v * inputs[0] for v in function.x), tuple(v * output for v in function.y)
