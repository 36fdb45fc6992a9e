"""The radial kernels: one table row holds every fact about one kernel.

Every kernel is a function of ``s = epsilon * r``. With ``u = s**2`` the radial functions that
gradients and Hermite fits need are ``2**k d^k phi / du^k``::

    k = 0   phi
    k = 1   first   phi'/r
    k = 2   second  (phi'' - phi'/r) / r**2

For all kernels of the table they have the form ``s**j * (base(s) * A(s) + B(s))`` with polynomials
A and B of degree four at most. A row lists j, A and B of phi, the others follow. Kernels of another
form are registered as functions of arrays.

Sources: Fasshauer, *Meshfree Approximation Methods with MATLAB* (2007); Wendland (1995); Buhmann
(2000); SciPy's ``RBFInterpolator`` for names and signs. ``skala_cervenka`` is second-hand: the
formula r^2 (r^a - 1) was not checked against the original of 2019, and neither was the default
exponent.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from hashlib import sha256

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import UsageError, check_finite, did_you_mean, shown

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


@dataclass(frozen=True)
class Kernel:
    """One row of the kernel table.

    ``order`` m is that of conditional positive definiteness: polynomials of degree m - 1 must be
    added. Phi is C^k at the origin for k = ``smoothness``, 99 for infinitely often; if ``compact``
    it vanishes for r >= 1/epsilon. ``has_epsilon`` is False where epsilon only rescales the weights
    (polyharmonic kernels). ``parameter`` is the kernel's own exponent (beta, a), 0 where it has
    none.
    """

    name: str
    order: int
    compact: bool
    smoothness: int
    has_epsilon: bool
    parameter: float
    base: int = field(repr=False)
    table: np.ndarray = field(repr=False, compare=False)
    functions: tuple[Radial, ...] = field(default=(), repr=False, compare=False)
    limits: tuple[float, ...] = field(default=(), repr=False, compare=False)

    @property
    def hermite(self) -> bool:
        """Whether phi is smooth enough (C2) for a fit to points and normals."""
        return self.smoothness >= 2

    @property
    def degree(self) -> int:
        """Least polynomial degree, -1 for none."""
        return self.order - 1

    @property
    def plain_cube(self) -> bool:
        """Whether phi is s^3, for which there is a loop of its own."""
        return self.name == "cubic"

    @property
    def identity(self) -> str:
        """Name that stands for the formula too, in keys of what is kept on disk."""
        if not self.functions:
            return self.name
        return f"{self.name} {sha256(self.table.tobytes()).hexdigest()}"

    def phi(self, r: ArrayLike, epsilon: float = 1.0) -> Floats:
        """Kernel at distances r (any shape), shape parameter epsilon [1/length]."""
        r = np.asarray(r, dtype=float)
        check_finite(np.atleast_1d(r), name="r")
        s = np.atleast_1d(r * epsilon)
        with np.errstate(over="ignore", invalid="ignore"):
            return self.radial(s * s, 1)[0].reshape(r.shape)

    def radial(self, u: Floats, count: int) -> list[Floats]:
        """The first ``count`` radial functions at u = s**2, of any shape.

        Where a function is infinite at u = 0 a finite value stands in: it is only ever multiplied
        by zero vectors.
        """
        s = np.sqrt(u)
        if self.functions:
            return [self._given(k, s) for k in range(count)]
        b = base_values(self.base, self.parameter, u, s)
        found = [row_values(self.base, row, u, s, b) for row in self.table[:count]]
        if self.compact:
            for values in found:
                values[u >= 1.0] = 0.0
        return found

    def _given(self, k: int, s: Floats) -> Floats:
        """The k-th of the functions that were registered."""
        values = np.zeros(s.shape)
        inside = s < 1.0 if self.compact else np.ones(s.shape, dtype=bool)
        with np.errstate(all="ignore"):
            values[inside] = self.functions[k](np.maximum(s[inside], LEAST))
        if np.isfinite(self.limits[k]):
            values[s == 0.0] = self.limits[k]
        return values


Phi = tuple[int, tuple[float | Fraction, ...], tuple[float | Fraction, ...], int]
# name, order m, C^k at 0, compact, has epsilon, own parameter, base, and phi =
# s**power (base * inner + outer): the power, coefficients of inner and outer from the constant up,
# and the base's own exponent
_ROWS: list[tuple[str, int, int, bool, bool, float, int, Phi]] = [
    ("linear", 1, 0, False, False, 0.0, ONE, (1, (), (-1,), 0)),
    ("cubic", 2, 2, False, False, 0.0, ONE, (3, (), (1,), 0)),
    ("quintic", 3, 4, False, False, 0.0, ONE, (5, (), (-1,), 0)),
    ("septic", 4, 6, False, False, 0.0, ONE, (7, (), (1,), 0)),
    ("thin_plate_spline", 2, 1, False, False, 0.0, LOG, (2, (1,), (), 0)),
    ("polyharmonic_4", 3, 3, False, False, 0.0, LOG, (4, (-1,), (), 0)),
    ("gaussian", 0, 99, False, True, 0.0, GAUSS, (0, (1,), (), 0)),
    # signs as conditional definiteness wants them
    ("multiquadric", 1, 99, False, True, 0.5, BINOMIAL, (0, (-1,), (), 0)),
    ("inverse_multiquadric", 0, 99, False, True, -0.5, BINOMIAL, (0, (1,), (), 0)),
    ("inverse_quadratic", 0, 99, False, True, -1.0, BINOMIAL, (0, (1,), (), 0)),
    ("generalised_multiquadric", 2, 99, False, True, 1.5, BINOMIAL, (0, (1,), (), 0)),
    ("matern_12", 0, 0, False, True, 0.0, EXP, (0, (1,), (), 0)),
    ("matern_32", 0, 2, False, True, 0.0, EXP, (0, (1, 1), (), 0)),
    ("matern_52", 0, 4, False, True, 0.0, EXP, (0, (1, 1, Fraction(1, 3)), (), 0)),
    ("matern_72", 0, 6, False, True, 0.0, EXP, (0, (1, 1, Fraction(2, 5), Fraction(1, 15)), (), 0)),
    ("wendland_c0", 0, 0, True, True, 0.0, CUT, (0, (1,), (), 2)),
    ("wendland_c2", 0, 2, True, True, 0.0, CUT, (0, (1, 4), (), 4)),
    ("wendland_c4", 0, 4, True, True, 0.0, CUT, (0, (1, 6, Fraction(35, 3)), (), 6)),
    ("wendland_c6", 0, 6, True, True, 0.0, CUT, (0, (1, 8, 25, 32), (), 8)),
    ("wendland_51", 0, 2, True, True, 0.0, CUT, (0, (1, 5), (), 5)),
    ("buhmann", 0, 2, True, True, 0.0, LOG, (0, (0, 0, 0, 0, 12), (1, 0, -12, 32, -21), 0)),
    ("skala_cervenka", 2, 3, False, False, 1.8, POWER, (2, (1,), (-1,), 0)),
]


def _radial_rows(base: int, parameter: float, phi: Phi) -> Floats:
    """Rows (3, 2 + 2 `TERMS`): j, the base's own exponent, A, B; each (1/s) d/ds of the last, in
    exact fractions.
    """
    rows = np.zeros((3, 2 + 2 * TERMS))
    exponent = Fraction(parameter)
    size = TERMS + 2
    power, inner, outer, extra = phi
    if base == ONE and any(inner):
        raise ValueError(f"a kernel with the base 1 has no A, got {inner}: write it as B")
    a, b = (np.array([Fraction(c) for c in (*part, *[0] * size)][:size]) for part in (inner, outer))
    for row in rows:
        lowest = int(np.flatnonzero((a != 0) | (b != 0))[0])
        power = power + lowest
        a = np.roll(a, -lowest)
        b = np.roll(b, -lowest)
        row[:2] = (power, extra)
        row[2 : 2 + TERMS] = a[:TERMS]
        row[2 + TERMS :] = b[:TERMS]
        slope, b = (power + np.arange(size)) * a, (power + np.arange(size)) * b
        if base == EXP:
            slope = slope - np.roll(a, 1)
        elif base == GAUSS:
            slope = slope - 2 * np.roll(a, 2)
        elif base == CUT:
            slope, extra = slope - np.roll(slope + extra * a, 1), extra - 1
        elif base == BINOMIAL:
            slope, extra = slope + np.roll(slope + 2 * (exponent - extra) * a, 2), extra + 1
        elif base == POWER:
            slope = slope + exponent * a
        elif base == LOG:
            b = b + a
        power, a = power - 2, slope
    rows.setflags(write=False)
    return rows


KERNELS = {
    name: Kernel(name, order, compact, smooth, has_epsilon, own, base, _radial_rows(base, own, phi))
    for name, order, smooth, compact, has_epsilon, own, base, phi in _ROWS
}


def get_kernel(name: Kernel | str) -> Kernel:
    """Look a kernel up by name; a Kernel is handed back. UsageError names the nearest right one for
    an unknown name.
    """
    if isinstance(name, Kernel):
        return name
    if not isinstance(name, str):
        raise UsageError(
            f"a kernel is given by its name, for instance 'cubic', got {shown(name)}; "
            "rbfmuscle.register_kernel adds one"
        )
    if name not in KERNELS:
        raise UsageError(f"unknown kernel {name!r}, {did_you_mean(name, KERNELS)}")
    return KERNELS[name]


def register_kernel(
    name: str,
    phi: Radial,
    first: Radial,
    second: Radial | None = None,
    *,
    order: int,
    smoothness: int,
    compact: bool = False,
    has_epsilon: bool = True,
) -> Kernel:
    """Add a kernel under a name of its own, known wherever kernels are named in this process.

    The functions are checked against each other for s from 1e-9 to 3e4, and called as they are.

    Parameters
    ----------
    name : str
        Letters, digits and underscores.
    phi, first, second : callable
        phi(s), phi'(s)/s and (phi'' - phi'/s)/s**2 of an array of s = epsilon r (n,), n values
        each. ``second`` is left out for a kernel that is not C2.
    order : int
        Of conditional positive definiteness, 0 where phi is positive definite; the sign of phi
        must be right for it.
    smoothness : int
        k, where phi is C^k at the origin; 99 for infinitely often.
    compact : bool
        Whether phi ends at s = 1; the functions are then called for s < 1 alone.
    has_epsilon : bool
        False where epsilon only rescales the weights.

    Returns
    -------
    Kernel
        Its row of the table of kernels.

    Raises
    ------
    UsageError
        If the name is taken, a function is not finite, or ``first`` or ``second`` is not the
        derivative of the one before.

    Examples
    --------
    >>> import numpy as np
    >>> kernel = register_kernel(
    ...     "matern_92",
    ...     lambda s: (1 + s + 3 * s**2 / 7 + 2 * s**3 / 21 + s**4 / 105) * np.exp(-s),
    ...     lambda s: -(1 + s + 2 * s**2 / 5 + s**3 / 15) * np.exp(-s) / 7,
    ...     lambda s: (1 + s + s**2 / 3) * np.exp(-s) / 35,
    ...     order=0,
    ...     smoothness=8,
    ... )
    >>> round(float(kernel.phi(1.0)), 9)
    0.931961251
    """
    if not str(name).isidentifier():
        raise UsageError(f"a kernel's name is letters, digits and _, got {shown(repr(name))}")
    if name in KERNELS:
        raise UsageError(f"kernel {shown(repr(name))} is known already, choose another name")
    if second is None and smoothness >= 2:
        raise UsageError(f"kernel {name!r} is C{smoothness}, so it needs its function second")
    functions = (phi, first) if second is None else (phi, first, second)
    at_zero = tuple(limits(functions))
    compared = check_functions(functions, compact)
    facts = name, order, compact, smoothness, has_epsilon
    kernel = Kernel(*facts, 0.0, ONE, compared, functions, at_zero)
    KERNELS[name] = kernel
    return kernel
