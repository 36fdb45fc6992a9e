"""Radial functions that are given as functions of arrays, kept as polynomials for the loops.

Each octave of u = s**2 is cut into `PANELS` panels of equal length, and each function is
interpolated by a polynomial in each of them. A row of the table holds the limit at s = 0, the value
that stands in below the first panel (the limit, where it is finite), and the coefficients of all
panels.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial.chebyshev import chebpts1
from numpy.polynomial.polynomial import polyval, polyvander

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.kernels.radial import BITS, HIGH, LOW, SIZE
from rbfmuscle.validation import UsageError

Radial = Callable[[Floats], Floats]  # of s (n,)

PANELS = 2**BITS  # to an octave of u
NAMES = ("phi", "first", "second")
# How far polynomials may be off, by the size of the function there or at s from 1/2 to 1.
INTERPOLATED = 1e-11
DIFFERENTIATED = 1e-5  # how far given derivatives may be off those of the polynomials, likewise
NODES = chebpts1(SIZE)  # of a polynomial, in a panel from -1 to 1
BETWEEN = np.linspace(-0.95, 0.95, 7)  # where in a panel the polynomial is checked


def sample_functions(functions: Sequence[Radial], compact: bool) -> Floats:
    """Table (3, 2 + panels * `SIZE`) of phi, first and second, checked against each other.

    The third may be missing: its row is NaN. UsageError says which function is not finite, not
    smooth, or not the derivative of the one before.
    """
    octaves = np.arange(LOW, 0 if compact else HIGH)
    start = np.ldexp(1.0 + np.arange(PANELS) / PANELS, octaves[:, None]).ravel()
    length = np.repeat(np.ldexp(1.0 / PANELS, octaves), PANELS)
    table = np.full((3, 2 + (HIGH - LOW) * PANELS * SIZE), np.nan)
    size = np.zeros(len(start))
    slope = None
    for row, name, function in zip(table, NAMES, functions):
        # A function of s counts times s**2 beside the one before it.
        found, size = _interpolate(name, function, (start, length), size / start)
        if slope is not None:
            _check_slope(name, (found[:, 0] - slope) / size, start)
        slope = 4.0 * found[:, 1] / length  # d/ds / s = 2 d/du at the middle of a panel
        row[:] = 0.0
        row[2 : 2 + found.size] = found.ravel()
        row[:2] = _limits(name, function, float(polyval(-1.0, found[0])))
    table.setflags(write=False)
    return table


def _interpolate(
    name: str, function: Radial, panels: tuple[Floats, Floats], least: Floats
) -> tuple[Floats, Floats]:
    """Coefficients (panels, `SIZE`), constant first, by the coordinate from -1 to 1 in a panel, and
    the size (panels,) by which errors count, ``least`` or more.
    """
    start, length = panels
    t = np.concatenate([NODES, BETWEEN])
    values = _values(name, function, np.sqrt(start[:, None] + length[:, None] * (t + 1) / 2))
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        where = np.sqrt(start[int(np.argmin(finite))])
        raise UsageError(f"{name} of a kernel is not finite near s = {where:.3g}")
    found = values[:, :SIZE] @ np.linalg.inv(polyvander(NODES, SIZE - 1)).T
    given = values[:, SIZE:]
    usual = np.abs(given[(start >= 0.25) & (start < 1.0)]).max()
    size = np.maximum(np.maximum(np.abs(given).max(axis=1), usual), least)
    miss = np.abs(found @ polyvander(BETWEEN, SIZE - 1).T - given).max(axis=1) / size
    worst = int(np.argmax(miss))
    if miss[worst] > INTERPOLATED:
        raise UsageError(
            f"{name} of a kernel is not smooth enough near s = {np.sqrt(start[worst]):.3g}: "
            f"polynomials miss it by {miss[worst]:.1g} of its size"
        )
    return found, size


def _values(name: str, function: Radial, s: Floats) -> Floats:
    with np.errstate(all="ignore"):
        values = np.asarray(function(s.ravel()), dtype=float)
    if values.shape != (s.size,):
        raise UsageError(
            f"{name} of a kernel takes an array (n,) and gives as many values, "
            f"got {values.shape} for ({s.size},)"
        )
    return values.reshape(s.shape)


def _check_slope(name: str, miss: Floats, start: Floats) -> None:
    """Whether a function is (1/s) d/ds of the one before, at s from 1/4 to 4."""
    miss = np.where((start >= 0.0625) & (start < 16.0), np.abs(miss), 0.0)
    worst = int(np.argmax(miss))
    if miss[worst] > DIFFERENTIATED:
        raise UsageError(
            f"{name} of a kernel is not the derivative of {NAMES[NAMES.index(name) - 1]} by s, "
            f"divided by s, near s = {np.sqrt(start[worst]):.3g}"
        )


def _limits(name: str, function: Radial, near: float) -> tuple[float, float]:
    """The function at s = 0, and a finite value in its place; ``near`` is that at the least s."""
    limit = float(_values(name, function, np.zeros((1, 1)))[0, 0])
    if name == "phi" and not np.isfinite(limit):
        raise UsageError(f"phi of a kernel must be finite at s = 0, got {limit}")
    if name == "first" and np.isnan(limit):
        limit = near
    return limit, limit if np.isfinite(limit) else near
