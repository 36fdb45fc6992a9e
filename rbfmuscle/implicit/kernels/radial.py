"""Loops that fill the radial functions of any kernel for a block of squared distances.

The kernel is chosen once a block, outside the inner loops, which are short enough to become vector
code. exp and log are written out here because calls into the C library keep a loop from being
vectorised.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.jit import compiled

ONE, EXP, GAUSS, BINOMIAL, CUT, LOG, POWER, SAMPLED = range(8)
"""Bases: 1, exp(-s), exp(-s^2), (1+s^2)^beta, (1-s)+, log s, s^a; polynomials of `sampled.py`."""

# Of a sampled kernel: panels to an octave of u as a power of 2, from 2^LOW to 2^HIGH, and the
# coefficients of a panel.
BITS = 5
LOW = -60
HIGH = 30
SIZE = 8


class Form(NamedTuple):
    """A kernel as the loops read it: base, its own exponent, whether it ends at s = 1, rows of the
    table.
    """

    base: int
    parameter: float
    compact: bool
    table: np.ndarray


_LOG2E = 1.4426950408889634  # log2(e), and log(2) in two parts
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
_SHIFTER = 6755399441055744.0  # 1.5 * 2**52: adding it leaves the rounded integer in the low bits
_TINY = 2.2250738585072014e-308  # the least normal number


@compiled(fastmath={"contract"})
def _exp(x):
    """exp(x), relative error below 3e-16; 0 where x < -708: x = n log 2 + r, n goes into the
    exponent's bits.
    """
    t = min(max(x, -708.0), 709.0)
    whole = np.float64(t * _LOG2E + _SHIFTER)
    n = whole - _SHIFTER
    r = (t - n * _LN2_HIGH) - n * _LN2_LOW
    p = ((1.0 / 6227020800.0 * r + 1.0 / 479001600.0) * r + 1.0 / 39916800.0) * r + 1.0 / 3628800.0
    p = (((p * r + 1.0 / 362880.0) * r + 1.0 / 40320.0) * r + 1.0 / 5040.0) * r + 1.0 / 720.0
    p = (((((p * r + 1.0 / 120.0) * r + 1.0 / 24.0) * r + 1.0 / 6.0) * r + 0.5) * r + 1.0) * r + 1.0
    power = np.int64((whole.view(np.int64) + np.int64(1023)) << np.int64(52)).view(np.float64)
    return p * power if x >= -708.0 else 0.0


@compiled(fastmath={"contract"})
def _log(x):
    """log(x) for x > 0, relative error below 4e-16; 0 is taken as the smallest normal number."""
    bits = np.float64(max(x, _TINY)).view(np.int64)
    exponent = np.int64(
        (bits - np.int64(4604544271217802189)) >> np.int64(52)
    )  # mantissa in [0.707, 1.414)
    m = np.int64(bits - (exponent << np.int64(52))).view(np.float64)
    f = m - 1.0
    s = f / (m + 1.0)
    z = s * s
    p = (((1.0 / 23.0 * z + 1.0 / 21.0) * z + 1.0 / 19.0) * z + 1.0 / 17.0) * z + 1.0 / 15.0
    p = (((p * z + 1.0 / 13.0) * z + 1.0 / 11.0) * z + 1.0 / 9.0) * z + 1.0 / 7.0
    p = (p * z + 1.0 / 5.0) * z + 1.0 / 3.0
    # log m = 2s + 2s^3 p with 2s = f - s f, so that the leading term is exact
    return exponent * _LN2_HIGH + (f - s * (f - 2.0 * z * p) + exponent * _LN2_LOW)


@compiled(fastmath={"contract"})
def _exp_loop(factor, x, out):
    """out = exp(factor * x)."""
    for i in range(x.size):
        out[i] = _exp(factor * x[i])


@compiled(fastmath={"contract"})
def _log_loop(x, out):
    """out = log(x)."""
    for i in range(x.size):
        out[i] = _log(x[i])


@compiled
def _base_loop(base, parameter, u, s, b, more):
    """s = sqrt(u) and b = the kernel's base; more is scratch."""
    if base != GAUSS and base != BINOMIAL:  # functions of u alone
        for i in range(u.size):
            s[i] = np.sqrt(u[i])
    if base == EXP:
        _exp_loop(-1.0, s, b)
    elif base == GAUSS:
        _exp_loop(-1.0, u, b)
    elif base == LOG:
        _log_loop(u, b)
        for i in range(u.size):
            b[i] = 0.5 * b[i]
    elif base == BINOMIAL:
        _binomial_loop(parameter, u, b)
    elif base == POWER:
        _log_loop(u, more)
        _exp_loop(0.5 * parameter, more, b)
        for i in range(u.size):
            b[i] = b[i] if u[i] > 0.0 else 0.0
    elif base == CUT:
        for i in range(u.size):
            b[i] = max(1.0 - s[i], 0.0)


@compiled
def _binomial_loop(beta, u, b):
    """b = (1 + u)**beta for beta = 1.5, 0.5, -0.5 and -1."""
    if beta == 0.5:
        for i in range(u.size):
            b[i] = np.sqrt(1.0 + u[i])
    elif beta == -0.5:
        for i in range(u.size):
            b[i] = 1.0 / np.sqrt(1.0 + u[i])
    elif beta == -1.0:
        for i in range(u.size):
            b[i] = 1.0 / (1.0 + u[i])
    else:
        for i in range(u.size):
            b[i] = (1.0 + u[i]) * np.sqrt(1.0 + u[i])


@compiled(fastmath={"contract"})
def _inner_loop(base, row, u, s, b, out):
    """out = base * A(s)."""
    a0 = row[2]
    a1 = row[3]
    a2 = row[4]
    a3 = row[5]
    a4 = row[6]
    if base == ONE or (a0 == 0.0 and a1 == 0.0 and a2 == 0.0 and a3 == 0.0 and a4 == 0.0):
        for i in range(u.size):
            out[i] = 0.0
        return
    if a1 == 0.0 and a2 == 0.0 and a3 == 0.0 and a4 == 0.0:
        if base == CUT:
            for i in range(u.size):
                out[i] = a0
        else:
            for i in range(u.size):
                out[i] = a0 * b[i]
    elif base == CUT:
        for i in range(u.size):
            out[i] = a0 + s[i] * (a1 + s[i] * (a2 + s[i] * (a3 + s[i] * a4)))
    else:
        for i in range(u.size):
            out[i] = b[i] * (a0 + s[i] * (a1 + s[i] * (a2 + s[i] * (a3 + s[i] * a4))))
    if base == CUT:
        for _ in range(int(row[1])):
            for i in range(u.size):
                out[i] *= b[i]
    elif base == BINOMIAL:
        for _ in range(int(row[1])):
            for i in range(u.size):
                out[i] = out[i] / (1.0 + u[i])


@compiled
def _radial_loop(form, wanted, u, work, out):
    """Fill out[k] (3, n) with the k-th radial function of u = s**2 for each bit k of wanted; work
    (3, n) is scratch.

    Where a function is infinite at u = 0 a finite value stands in: it is only ever multiplied by
    zero vectors.
    """
    base, parameter, compact, table = form
    if base == SAMPLED:
        for k in range(3):
            if (wanted >> k) & 1:
                _sampled_loop(table[k], compact, u, out[k])
        return
    s = work[0][: u.size]
    b = work[1][: u.size]
    more = work[2][: u.size]
    _base_loop(base, parameter, u, s, b, more)
    for k in range(3):
        if not (wanted >> k) & 1:
            continue
        row = table[k]
        values = out[k][: u.size]
        _inner_loop(base, row, u, s, b, values)
        c0 = row[7]
        c1 = row[8]
        c2 = row[9]
        c3 = row[10]
        c4 = row[11]
        if c1 != 0.0 or c2 != 0.0 or c3 != 0.0 or c4 != 0.0:
            for i in range(u.size):
                values[i] += c0 + s[i] * (c1 + s[i] * (c2 + s[i] * (c3 + s[i] * c4)))
        elif c0 != 0.0:
            for i in range(u.size):
                values[i] += c0
        _times_power_loop(int(row[0]), u, s, values)
        if compact:
            for i in range(u.size):
                values[i] = values[i] if u[i] < 1.0 else 0.0


@compiled
def _times_power_loop(power, u, s, values):
    """values *= s**power; for a negative power the value at s = 0 becomes 0."""
    if power > 0:
        if power & 1:
            for i in range(u.size):
                values[i] *= s[i]
        for _ in range(power // 2):
            for i in range(u.size):
                values[i] *= u[i]
    for _ in range(-power):
        for i in range(u.size):
            values[i] = values[i] / s[i] if s[i] > 0.0 else 0.0


@compiled
def _sampled_loop(row, compact, u, out):
    """Values of a sampled function. The panel is in the exponent and the first bits behind it."""
    last = (HIGH - LOW << BITS) - 1
    shift = np.int64(52 - BITS)
    for i in range(u.size):
        if u[i] < 2.0**LOW or (compact and u[i] >= 1.0):
            out[i] = row[1] if u[i] < 1.0 else 0.0
            continue
        bits = np.float64(min(u[i], 2.0**HIGH)).view(np.int64)
        panel = np.int64((bits >> shift) - ((1023 + LOW) << BITS))
        rest = np.int64(bits - ((bits >> shift) << shift))
        t = 2.0 ** (BITS - 51) * rest - 1.0
        if panel > last:  # the end of the last
            panel = last
            t = 1.0
        first = 2 + SIZE * panel
        value = 0.0
        for c in range(SIZE - 1, -1, -1):
            value = value * t + row[first + c]
        out[i] = value
