"""Radial functions of the kernels of the table, from the rows that describe them."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats

ONE, EXP, GAUSS, BINOMIAL, CUT, LOG, POWER = range(7)
"""Bases: 1, exp(-s), exp(-s^2), (1+s^2)^beta, (1-s)+ with an exponent, log s, s^a."""

TERMS = 5  # coefficients of a polynomial: of degree 4 at most
_TINY = np.finfo(float).tiny


def base_values(base: int, parameter: float, u: Floats, s: Floats) -> Floats:
    """The base of a kernel at u = s**2."""
    if base == EXP:
        return np.exp(-s)
    if base == GAUSS:
        return np.exp(-u)
    if base == BINOMIAL:
        return np.asarray((1.0 + u) ** parameter)
    if base == CUT:
        return np.maximum(1.0 - s, 0.0)
    if base == LOG:
        return 0.5 * np.log(np.maximum(u, _TINY))
    return s**parameter if base == POWER else np.ones_like(s)


def row_values(base: int, row: Floats, u: Floats, s: Floats, b: Floats) -> Floats:
    """s**j (base * A(s) + B(s)) of a row of `Kernel.table`, for the base's values ``b``.

    Where the function is infinite at s = 0 the value there is 0: it is only ever multiplied by
    vectors that vanish.
    """
    power, extra = int(row[0]), int(row[1])
    inner, outer = row[2 : 2 + TERMS], row[2 + TERMS :]
    values = np.zeros_like(s)
    if inner.any():
        values = _polynomial(inner, s)
        values *= b**extra if base == CUT else b
        if base == BINOMIAL and extra:
            values /= (1.0 + u) ** extra
    if outer.any():
        values = values + _polynomial(outer, s)
    for _ in range(power // 2):
        values *= u
    if power > 0 and power % 2:
        values *= s
    for _ in range(-power):
        values = np.divide(values, s, out=np.zeros_like(s), where=s > 0.0)
    return values


def _polynomial(coefficients: Floats, s: Floats) -> Floats:
    """A polynomial, constant first."""
    highest = int(np.flatnonzero(coefficients)[-1])
    values = np.full_like(s, coefficients[highest])
    for coefficient in coefficients[:highest][::-1]:
        values *= s
        values += coefficient
    return values
