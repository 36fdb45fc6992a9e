"""Sums of radial functions, a phi(|p - c|), for a block of points: one loop a base, nothing stored in between.

The formulas are those of `radial.py`, which fills derivatives as well; here the value alone is wanted, by far the
commonest evaluation, and one loop over the points keeps it in registers.
"""

from typing import Any

import numpy as np

from rbfmuscle.implicit.kernels.radial import BINOMIAL, CUT, EXP, GAUSS, LOG, ONE, _exp, _log
from rbfmuscle.jit import compiled

_FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


@compiled(**_FAST)
def _power(power, s, u):
    """s**power for 0 <= power <= 7, u = s**2; selections, as the power is the same for the whole block."""
    out = s if power & 1 else 1.0
    out = out * u if power & 2 else out
    return out * (u * u) if power & 4 else out


@compiled(**_FAST)
def _gauss_loop(p, at, e2, a, acc):
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        acc[i] += a * _exp(-e2 * (dx * dx + dy * dy + dz * dz))


@compiled(**_FAST)
def _exponential_loop(p, at, e2, a, row, acc):
    a0, a1, a2, a3 = a * row[2], a * row[3], a * row[4], a * row[5]
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        s = np.sqrt(e2 * (dx * dx + dy * dy + dz * dz))
        acc[i] += _exp(-s) * (a0 + s * (a1 + s * (a2 + s * a3)))


@compiled(**_FAST)
def _cubic_loop(p, at, e2, a, acc):
    """The commonest, and twice as fast with its power written out."""
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = e2 * (dx * dx + dy * dy + dz * dz)
        acc[i] += a * u * np.sqrt(u)


@compiled(**_FAST)
def _odd_power_loop(p, at, e2, a, row, acc):
    power, c0 = int(row[0]), a * row[7]
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = e2 * (dx * dx + dy * dy + dz * dz)
        acc[i] += c0 * _power(power, np.sqrt(u), u)


@compiled(**_FAST)
def _logarithm_loop(p, at, e2, a, compact, row, acc):
    power = int(row[0])
    a0, a4 = 0.5 * row[2], 0.5 * row[6]
    c0, c2, c3, c4 = row[7], row[9], row[10], row[11]
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = e2 * (dx * dx + dy * dy + dz * dz)
        s = np.sqrt(u)
        value = _log(u) * (a0 + a4 * u * u) + (c0 + u * (c2 + s * c3 + u * c4))
        value = value * _power(power, s, u)
        acc[i] += a * (value if u < 1.0 or not compact else 0.0)


@compiled(**_FAST)
def _cut_loop(p, at, e2, a, row, acc):
    extra = int(row[1])
    a0, a1, a2, a3 = a * row[2], a * row[3], a * row[4], a * row[5]
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        s = np.sqrt(e2 * (dx * dx + dy * dy + dz * dz))
        b = max(1.0 - s, 0.0)
        b2 = b * b
        b4 = b2 * b2
        value = _power(extra, b, b2)
        value = value * (b4 * b4) if extra & 8 else value
        acc[i] += value * (a0 + s * (a1 + s * (a2 + s * a3)))


@compiled(**_FAST)
def _root_loop(p, at, e2, a, beta, acc):
    """a (1 + u)**beta for beta = 1.5, 0.5, -0.5 and -1."""
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = 1.0 + e2 * (dx * dx + dy * dy + dz * dz)
        root = u if beta == -1.0 else np.sqrt(u)
        factor = a * u if beta == 1.5 else a
        acc[i] += factor * root if beta > 0.0 else a / root


@compiled(**_FAST)
def _binomial_loop(p, at, e2, a, beta, acc):
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        acc[i] += a * _exp(beta * _log(1.0 + e2 * (dx * dx + dy * dy + dz * dz)))


@compiled(**_FAST)
def _skala_loop(p, at, e2, a, exponent, acc):
    """a s^2 (s^exponent - 1)."""
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = e2 * (dx * dx + dy * dy + dz * dz)
        acc[i] += a * (u * (_exp(0.5 * exponent * _log(u)) - 1.0))


@compiled(error_model="numpy")
def _add_values_loop(form, p, at, e2, a, acc):
    """acc += a phi(|p - c|) for a block of points p (3, n) and a centre c."""
    base, parameter, compact, table = form
    row = table[0]
    if base == GAUSS:
        _gauss_loop(p, at, e2, a * row[2], acc)
    elif base == EXP:
        _exponential_loop(p, at, e2, a, row, acc)
    elif base == ONE and row[0] == 3.0:
        _cubic_loop(p, at, e2, a * row[7], acc)
    elif base == ONE:
        _odd_power_loop(p, at, e2, a, row, acc)
    elif base == LOG:
        _logarithm_loop(p, at, e2, a, compact, row, acc)
    elif base == CUT:
        _cut_loop(p, at, e2, a, row, acc)
    elif base == BINOMIAL and (parameter in (1.5, 0.5, -0.5, -1.0)):
        _root_loop(p, at, e2, a * row[2], parameter, acc)
    elif base == BINOMIAL:
        _binomial_loop(p, at, e2, a * row[2], parameter, acc)
    else:
        _skala_loop(p, at, e2, a * row[2], parameter, acc)
