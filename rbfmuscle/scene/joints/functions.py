"""Functions of joint coordinates: linear, polynomials, piecewise linear, splines.

Each takes the values of its coordinates in order and returns one number; those of one variable take
the first. ``rescaled`` gives the function in other units, ``g(f_k q_k) = output * self(q)``, f the
``inputs``.
"""

import bisect
import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np


@dataclass(frozen=True)
class Linear:
    """``c1 q1 + ... + cn qn + constant``; without slopes a constant."""

    slopes: tuple[float, ...]
    constant: float = 0.0

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return sum(slope * value for slope, value in zip(self.slopes, values)) + self.constant

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
        return float(np.polyval(self.coefficients, values[0]))

    def rescaled(self, inputs: list[float], output: float) -> "Polynomial":
        """Return the function in other units."""
        top = len(self.coefficients) - 1
        return Polynomial(
            tuple(c * output / inputs[0] ** (top - k) for k, c in enumerate(self.coefficients))
        )


@dataclass(frozen=True)
class PiecewiseLinear:
    """Through points (x, y), straight between them; the first and the last piece go on beyond
    them.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]

    degree: ClassVar[int] = 1

    @cached_property
    def _pieces(self) -> list[list[float]]:
        """Four coefficients of each piece, highest power first: before, between and beyond the
        points.
        """
        from scipy.interpolate import make_interp_spline

        x, y = np.array(self.x), np.array(self.y)
        if self.degree == 1 or len(x) < 3:
            curve = make_interp_spline(x, y, k=min(1, len(x) - 1))
        else:  # three points: one parabola
            ends = (
                [(3, 6.0 * _third(x[s], y[s]) if len(x) > 3 else 0.0)]
                for s in (np.s_[:4], np.s_[-4:])
            )
            curve = make_interp_spline(x, y, k=3, bc_type=tuple(ends))
        pieces = np.stack([curve(x, nu=n) / math.factorial(n) for n in (3, 2, 1, 0)], axis=1)
        straight = pieces * [0.0, 0.0, 1.0, 1.0]
        return np.stack([straight[0], *pieces[:-1], straight[-1]]).tolist()

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        k = bisect.bisect_right(self.x, values[0])
        a, b, c, d = self._pieces[k]
        t = values[0] - self.x[max(k - 1, 0)]
        return ((a * t + b) * t + c) * t + d

    def rescaled(self, inputs: list[float], output: float) -> Self:
        """Return the function in other units."""
        return replace(
            self, x=tuple(v * inputs[0] for v in self.x), y=tuple(v * output for v in self.y)
        )


class Spline(PiecewiseLinear):
    """Cubic spline through points; beyond them it goes on straight.

    It is the spline of Forsythe, Malcolm and Moler (1977), which OpenSim calls SimmSpline: the
    third derivative of the first and of the last piece is that of the cubic through the four points
    there.
    """

    degree = 3


@dataclass(frozen=True)
class Multivariate:
    """A polynomial of several coordinates: of each term the coefficient, then the power of each."""

    terms: tuple[tuple[float, ...], ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return sum(c * math.prod(map(pow, values, powers)) for c, *powers in self.terms)

    def rescaled(self, inputs: list[float], output: float) -> "Multivariate":
        """Return the function in other units."""
        factors = [output / math.prod(map(pow, inputs, powers)) for _, *powers in self.terms]
        return Multivariate(
            tuple((c * factor, *powers) for factor, (c, *powers) in zip(factors, self.terms))
        )


Function = Linear | Polynomial | PiecewiseLinear | Multivariate


def exponents(dimension: int, order: int) -> np.ndarray:
    """Return the exponents (m, d) of every term up to an order, the last coordinate's going
    fastest, as OpenSim's.
    """
    powers = itertools.product(range(order + 1), repeat=dimension)
    return np.array([power for power in powers if sum(power) <= order])


def scaled(function: Function, factor: float) -> Function:
    """Return ``factor`` times a function."""
    count = len(function.slopes) if isinstance(function, Linear) else 1
    if isinstance(function, Multivariate):
        count = max((len(term) - 1 for term in function.terms), default=1)
    return function.rescaled([1.0] * count, factor)


def _third(x, y):
    """Third divided difference of four points."""
    table = y
    for order in range(1, 4):
        table = np.diff(table) / (x[order:] - x[:-order])
    return float(table[0])
