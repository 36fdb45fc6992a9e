"""Kernels that are given as functions of arrays: what is checked of them when they are
registered.
"""

from collections.abc import Callable, Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import UsageError

Radial = Callable[[Floats], Floats]  # of s (n,)

NAMES = ("phi", "first", "second")
# Between these powers of two of s, in so many panels to an octave, each function is checked
# against the one before it.
LOW, HIGH, PANELS = -30, 15, 16
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
# How far the integral of a derivative over a panel may be off, by the size of the functions there
# or at s from 1/2 to 1.
INTEGRATED = 1e-9
LEAST = 2.0**LOW  # functions are called for this in place of smaller s


def check_functions(functions: Sequence[Radial], compact: bool) -> Floats:
    """Check phi, first and second, of which the third may be missing, against each other.

    Over each panel the integral of s * first is the change of phi, and that of s * second the
    change of first. Returns the values that were compared (k, panels), which stand for the
    formula. UsageError says which function is not finite, or not the derivative of the one before.
    """
    ends = np.exp2(np.linspace(LOW, 0 if compact else HIGH, (HIGH - LOW) * PANELS + 1))
    start, length = ends[:-1], np.diff(ends)
    if compact:
        ends[-1] = np.nextafter(1.0, 0.0)
    between = start[:, None] + 0.5 * length[:, None] * (NODES + 1.0)
    usual = (start >= 0.5) & (start < 1.0)
    values = np.stack([_finite(*given, ends) for given in zip(NAMES, functions)])
    for k in range(1, len(functions)):
        slope = _finite(NAMES[k], functions[k], between.ravel()).reshape(between.shape)
        integral = 0.5 * length * ((slope * between) @ WEIGHTS)
        size = np.abs(values[k - 1][:-1])
        size = np.maximum(size, max(size[usual].max(), np.finfo(float).tiny))
        if k == 2:  # a function of s counts times s**2 beside the one before it
            size = np.maximum(size, np.abs(values[0][:-1]) / start**2)
        miss = np.abs(np.diff(values[k - 1]) - integral) / size
        worst = int(np.argmax(miss))
        if miss[worst] > INTEGRATED:
            raise UsageError(
                f"{NAMES[k]} of a kernel is not the derivative of {NAMES[k - 1]} by s, divided by "
                f"s, near s = {start[worst]:.3g}"
            )
    return values


def limits(functions: Sequence[Radial]) -> list[float]:
    """The functions at s = 0, of which the first must be finite; where the second has no value
    there, that at the least s.
    """
    found = [float(_values(*given, np.zeros(1))[0]) for given in zip(NAMES, functions)]
    if not np.isfinite(found[0]):
        raise UsageError(f"phi of a kernel must be finite at s = 0, got {found[0]}")
    if np.isnan(found[1]):
        found[1] = float(functions[1](np.array([LEAST]))[0])
    return found


def _finite(name: str, function: Radial, s: Floats) -> Floats:
    values = _values(name, function, s)
    if not np.isfinite(values).all():
        where = s[int(np.argmin(np.isfinite(values)))]
        raise UsageError(f"{name} of a kernel is not finite near s = {where:.3g}")
    return values


def _values(name: str, function: Radial, s: Floats) -> Floats:
    with np.errstate(all="ignore"):
        values = np.asarray(function(s), dtype=float)
    if values.shape != s.shape:
        raise UsageError(
            f"{name} of a kernel takes an array (n,) and gives as many values, "
            f"got {values.shape} for {s.shape}"
        )
    return values
