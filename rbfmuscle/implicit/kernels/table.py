"""The radial kernels: one table row holds every fact about one kernel.

Every kernel is a function of ``s = epsilon * r``. With ``u = s**2`` the radial functions that gradients
and Hermite fits need are ``2**k d^k phi / du^k``::

    k = 0   phi
    k = 1   first   phi'/r
    k = 2   second  (phi'' - phi'/r) / r**2

All of them, for all kernels, have the form ``s**j * (base(s) * A(s) + B(s))`` with polynomials A and B of
degree four at most. A row lists j, A and B for k = 0, 1, 2; the loops in ``radial.py`` know the bases and
no kernel.

Sources: Fasshauer, *Meshfree Approximation Methods with MATLAB* (2007); Wendland (1995); Buhmann (2000);
SciPy's ``RBFInterpolator`` for names and signs. ``skala_cervenka`` is second-hand: the formula r^2 (r^a - 1)
was not checked against the original of 2019, and neither was the default exponent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.kernels import radial
from rbfmuscle.validation import UsageError, check_finite, did_you_mean

_TERMS = 5


@dataclass(frozen=True)
class Kernel:
    """One row of the kernel table.

    Attributes
    ----------
    name : str
    order : int
        Order m of conditional positive definiteness; polynomials of degree m - 1 must be added.
    compact : bool
        Whether phi vanishes for r >= 1/epsilon.
    smoothness : int
        phi is C^k at the origin; 99 stands for infinitely often.
    has_epsilon : bool
        False where epsilon only rescales the weights (polyharmonic kernels).
    parameter : float
        The kernel's own exponent (beta, a), 0 where it has none.
    """

    name: str
    order: int
    compact: bool
    smoothness: int
    has_epsilon: bool
    parameter: float
    base: int = field(repr=False)
    table: np.ndarray = field(repr=False, compare=False)

    @property
    def hermite(self) -> bool:
        """Whether phi is smooth enough (C2) for a fit to points and normals."""
        return self.smoothness >= 2

    @property
    def degree(self) -> int:
        """Least polynomial degree, -1 for none."""
        return self.order - 1

    @property
    def form(self) -> radial.Form:
        """What the loops read of this row."""
        return radial.Form(self.base, self.parameter, self.compact, self.table)

    @property
    def plain_cube(self) -> bool:
        """Whether phi is s^3, for which the loops have a shorter way."""
        return bool(self.base == radial.ONE and self.table[0, 0] == 3.0 and self.table[0, 2 + _TERMS] == 1.0)

    def phi(self, r: ArrayLike, epsilon: float = 1.0) -> Floats:
        """Kernel at distances r (any shape), shape parameter epsilon [1/length]."""
        return self._radial(r, epsilon, 0)

    def first(self, r: ArrayLike, epsilon: float = 1.0) -> Floats:
        """phi'(r)/r, with its limit at r = 0 (which is infinite for kernels that are not C2)."""
        return self._radial(r, epsilon, 1)

    def second(self, r: ArrayLike, epsilon: float = 1.0) -> Floats:
        """(phi'' - phi'/r)/r**2, with its limit at r = 0 (infinite for kernels that are not C4)."""
        return self._radial(r, epsilon, 2)

    def _radial(self, r: ArrayLike, epsilon: float, k: int) -> Floats:
        r = np.asarray(r, dtype=float)
        check_finite(np.atleast_1d(r), name="r")
        flat = np.ascontiguousarray(np.abs(r).ravel() * epsilon)
        out = np.empty((3, flat.size))
        radial._radial_loop(self.form, 1 << k, flat * flat, np.empty((3, flat.size)), out)
        values = out[k]
        values[flat == 0.0] = self._limit(k)
        return (values * epsilon ** (2 * k)).reshape(r.shape)

    def _limit(self, k: int) -> float:
        """Value of the k-th radial function at s = 0."""
        power, inner, outer = self.table[k, 0], self.table[k, 2 : 2 + _TERMS], self.table[k, 2 + _TERMS :]
        limit = outer[0]
        if self.base == radial.LOG:
            limit = -math.inf * inner[0] if inner[0] else limit
        elif self.base == radial.POWER:
            power, limit = (power + self.parameter, inner[0]) if not limit else (power, limit)
        else:
            limit += inner[0]
        if power > 0:
            return 0.0
        return limit if power == 0 or limit == 0 else math.copysign(math.inf, limit)


def _row(
    power: float, inner: tuple[float, ...] = (), outer: tuple[float, ...] = (), extra: int = 0
) -> Floats:
    """One radial function: s**power (base * inner(s) + outer(s)); extra is the base's own exponent."""
    row = np.zeros(2 + 2 * _TERMS)
    row[0], row[1] = power, extra
    row[2 : 2 + len(inner)] = inner
    row[2 + _TERMS : 2 + _TERMS + len(outer)] = outer
    return row


def _power_rows(k: int, sign: float) -> list[Floats]:
    """Odd polyharmonic sign * s**k."""
    factors = np.cumprod([sign, k, k - 2])
    return [_row(k - 2 * i, outer=(factors[i],)) for i in range(3)]


def _binomial_rows(beta: float) -> list[Floats]:
    """sign * (1 + s**2)**beta; the sign makes it conditionally positive definite."""
    sign = (-1.0) ** max(math.ceil(beta), 0)
    factors = np.cumprod([sign, 2 * beta, 2 * (beta - 1)])
    return [_row(0, (factors[i],), extra=i) for i in range(3)]


def _skala_rows(a: float) -> list[Floats]:
    """s**2 (s**a - 1)."""
    factors = np.cumprod([1.0, 2 + a, a])
    outer = (-1.0, -2.0, 0.0)
    return [_row(2 - 2 * i, (factors[i],), (outer[i],)) for i in range(3)]


_E, _U, _T, _L = radial.EXP, radial.GAUSS, radial.CUT, radial.LOG
_1, _Q, _P = radial.ONE, radial.BINOMIAL, radial.POWER

# name, order m, C^k at 0, compact, has epsilon, own parameter, base, rows for k = 0, 1, 2
_ROWS = [
    ("linear", 1, 0, False, False, 0.0, _1, _power_rows(1, -1.0)),
    ("cubic", 2, 2, False, False, 0.0, _1, _power_rows(3, 1.0)),
    ("quintic", 3, 4, False, False, 0.0, _1, _power_rows(5, -1.0)),
    ("septic", 4, 6, False, False, 0.0, _1, _power_rows(7, 1.0)),
    (
        "thin_plate_spline", 2, 1, False, False, 0.0, _L,
        [_row(2, (1,)), _row(0, (2,), (1,)), _row(-2, (), (2,))],
    ),
    (
        "polyharmonic_4", 3, 3, False, False, 0.0, _L,
        [_row(4, (-1,)), _row(2, (-4,), (-1,)), _row(0, (-8,), (-6,))],
    ),
    ("gaussian", 0, 99, False, True, 0.0, _U, [_row(0, (1,)), _row(0, (-2,)), _row(0, (4,))]),
    ("multiquadric", 1, 99, False, True, 0.5, _Q, _binomial_rows),
    ("inverse_multiquadric", 0, 99, False, True, -0.5, _Q, _binomial_rows),
    ("inverse_quadratic", 0, 99, False, True, -1.0, _Q, _binomial_rows),
    ("generalised_multiquadric", 2, 99, False, True, 1.5, _Q, _binomial_rows),
    (
        "matern_12", 0, 0, False, True, 0.0, _E,
        [_row(0, (1,)), _row(-1, (-1,)), _row(-3, (1, 1))],
    ),
    (
        "matern_32", 0, 2, False, True, 0.0, _E,
        [_row(0, (1, 1)), _row(0, (-1,)), _row(-1, (1,))],
    ),
    (
        "matern_52", 0, 4, False, True, 0.0, _E,
        [_row(0, (1, 1, 1 / 3)), _row(0, (-1 / 3, -1 / 3)), _row(0, (1 / 3,))],
    ),
    (
        "matern_72", 0, 6, False, True, 0.0, _E,
        [
            _row(0, (1, 1, 2 / 5, 1 / 15)), _row(0, (-1 / 5, -1 / 5, -1 / 15)),
            _row(0, (1 / 15, 1 / 15)),
        ],
    ),
    (
        "wendland_c0", 0, 0, True, True, 0.0, _T,
        [_row(0, (1,), extra=2), _row(-1, (-2,), extra=1), _row(-3, (), (2,))],
    ),
    (
        "wendland_c2", 0, 2, True, True, 0.0, _T,
        [
            _row(0, (1, 4), extra=4), _row(0, (-20,), extra=3),
            _row(-1, (60,), extra=2),
        ],
    ),
    (
        "wendland_c4", 0, 4, True, True, 0.0, _T,
        [
            _row(0, (1, 6, 35 / 3), extra=6), _row(0, (-56 / 3, -280 / 3), extra=5),
            _row(0, (560,), extra=4),
        ],
    ),
    (
        "wendland_c6", 0, 6, True, True, 0.0, _T,
        [
            _row(0, (1, 8, 25, 32), extra=8), _row(0, (-22, -154, -352), extra=7),
            _row(0, (528, 3168), extra=6),
        ],
    ),
    (
        "wendland_51", 0, 2, True, True, 0.0, _T,
        [
            _row(0, (1, 5), extra=5), _row(0, (-30,), extra=4),
            _row(-1, (120,), extra=3),
        ],
    ),
    (
        "buhmann", 0, 2, True, True, 0.0, _L,
        [
            _row(0, (0, 0, 0, 0, 12), (1, 0, -12, 32, -21)), _row(0, (0, 0, 48), (-24, 96, -72)),
            _row(-1, (0, 96), (96, -96)),
        ],
    ),
    ("skala_cervenka", 2, 3, False, False, 1.8, _P, _skala_rows),
]  # fmt: skip


def _build() -> dict[str, Kernel]:
    kernels = {}
    for name, order, smooth, compact, has_epsilon, parameter, base, rows in _ROWS:
        table = np.array(rows(parameter) if callable(rows) else rows)
        table.setflags(write=False)
        kernels[name] = Kernel(name, order, compact, smooth, has_epsilon, parameter, base, table)
    return kernels


KERNELS = _build()


def get_kernel(name: Kernel | str) -> Kernel:
    """Look a kernel up by name.

    Parameters
    ----------
    name : str or Kernel
        A key of ``KERNELS``; a Kernel is handed back as it is.

    Raises
    ------
    UsageError
        For an unknown name, with the nearest right one.
    """
    if isinstance(name, Kernel):
        return name
    if name not in KERNELS:
        raise UsageError(f"unknown kernel {str(name)!r}, {did_you_mean(name, KERNELS)}")
    return KERNELS[name]
