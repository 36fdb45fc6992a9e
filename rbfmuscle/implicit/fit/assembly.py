"""Systems of RBF fits: the coordinates that they are scaled to, their matrices and polynomials.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives, so that every
row of every block is one contiguous run.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.evaluation import _offsets_loop
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.jit import compiled
from rbfmuscle.validation import UsageError


def exponents(degree: int) -> Integers:
    """Exponents (q, 3) of the monomials of total degree up to ``degree``; (0, 3) for degree -1."""
    every = [power for power in np.ndindex(*[degree + 1] * 3) if sum(power) <= degree]
    every.sort(key=lambda power: (sum(power), *(-p for p in power)))
    return np.array(every, dtype=np.int64).reshape(-1, 3)


class Basis:
    """Centres, kernel and polynomials of P fits of n centres each, every one in coordinates scaled
    to order one.

    Of the caller's ``centres`` (K, 3), of which ``parts`` (P, n) says which each fit has, and
    epsilon [1 / length]: ``points`` (P, 3, n) are (x - ``origin``) / ``scale``, in the unit ball,
    and ``epsilon`` (P,) goes with them. The unknowns of a fit, ``size`` of them, are values at its
    centres, for a ``hermite`` one also all derivatives. ``polynomials`` (P, q, size) are the
    monomials of ``powers`` (q, 3) and their derivatives. LinAlgError for fewer values than
    polynomial terms.
    """

    def __init__(
        self,
        centres: Floats,
        kernel: Kernel,
        epsilon: float,
        *,
        hermite: bool = False,
        parts: Integers | None = None,
    ) -> None:
        if not len(centres):
            raise UsageError("a fit needs at least one point, got none")
        self.centres, self.parts = (
            centres,
            np.arange(len(centres))[None] if parts is None else parts,
        )
        points, (fits, count) = centres[self.parts], self.parts.shape
        self.origin = 0.5 * (points.min(axis=1) + points.max(axis=1))
        away = points - self.origin[:, None]
        self.scale = np.sqrt(np.einsum("pnc,pnc->pn", away, away).max(axis=1))
        self.scale[self.scale == 0.0] = 1.0
        self.points = np.ascontiguousarray(np.swapaxes(away / self.scale[:, None, None], 1, 2))
        self.kernel, self.hermite = kernel, hermite
        self.epsilon = epsilon * self.scale if kernel.has_epsilon else np.ones(fits)
        self.powers = exponents(kernel.degree)
        if not hermite and len(self.powers) > count:
            raise np.linalg.LinAlgError(
                f"degree {kernel.degree} of kernel '{kernel.name}' has {len(self.powers)} "
                "polynomial terms, more than "
                f"the {count} points; degree too high: use a kernel of lower order or add points"
            )
        self.size = 4 * count if hermite else count
        self.polynomials = np.empty((fits, len(self.powers), self.size))
        _polynomials_loop(self.points, self.powers, self.polynomials)

    def scaled(self) -> Floats:
        """All centres (K, 3) in the unit ball."""
        away = self.centres - 0.5 * (self.centres.min(axis=0) + self.centres.max(axis=0))
        return np.asarray(away / (np.sqrt((away**2).sum(axis=1).max()) or 1.0))

    def matrices(self, start: int, stop: int) -> Floats:
        """A of the fits from start to stop: (stop - start, size, size)."""
        out = np.empty((stop - start, self.size, self.size))
        if self.hermite and self.kernel.plain_cube:
            _cubic_matrices_loop(self.points, self.epsilon, start, out)
        else:
            _matrices_loop(self.points, self.epsilon, self.kernel.form, self.hermite, start, out)
        return out


@compiled
def _polynomials_loop(points, powers, out):
    """Monomials at points (P, 3, n), and where there is room for them their derivatives."""
    n = points.shape[2]
    for p in range(len(points)):
        for q in range(len(powers)):
            for c in range(-1, out.shape[2] // n - 1):
                _monomial_loop(points[p], powers[q], c, out[p, q, (c + 1) * n : (c + 2) * n])


@compiled
def _monomial_loop(x, powers, axis, out):
    """A monomial at points (3, n), or its derivative along an axis that is not negative."""
    out[:] = powers[axis] if axis >= 0 else 1.0
    for c in range(3):
        for _ in range(powers[c] - int(c == axis)):
            for i in range(len(out)):
                out[i] *= x[c, i]


@compiled
def _matrices_loop(points, epsilon, form, hermite, start, out):
    """Matrices of fits from start on, of points (P, 3, n), for any kernel."""
    n = points.shape[2]
    d = np.empty((3, n))
    u = np.empty(n)
    work = np.empty((3, n))
    radial = np.empty((3, n))
    for p in range(len(out)):
        x, e2 = points[start + p], epsilon[start + p] ** 2
        for j in range(n):
            _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), e2, d, u)
            _radial_loop(form, 7 if hermite else 1, u, work, radial)
            for i in range(n):
                out[p, j, i] = radial[0, i]
            if hermite:
                _derivatives_loop(j, e2, d, radial, out[p])


@compiled
def _cubic_matrices_loop(points, epsilon, start, out):
    """As `_matrices_loop` for the kernel s^3, which muscles use and which should not wait for
    others.
    """
    n = points.shape[2]
    d = np.empty((3, n))
    u = np.empty(n)
    radial = np.empty((3, n))
    for p in range(len(out)):
        x, e2 = points[start + p], epsilon[start + p] ** 2
        for j in range(n):
            _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), e2, d, u)
            for i in range(n):
                s = np.sqrt(u[i])
                radial[1, i] = 3.0 * s
                radial[2, i] = 3.0 / s if s > 0.0 else 0.0
                out[p, j, i] = u[i] * s
            _derivatives_loop(j, e2, d, radial, out[p])


@compiled
def _derivatives_loop(j, e2, d, radial, out):
    """Derivatives in the four rows of centre j, from the offsets of all centres and the radial
    functions there.

    Blocks: (value, d/dx_c) first * d_c, as the other way round by the sign of d;
    (d/dx_c, d/dx_e) -(first * delta + second * d_c d_e).
    """
    n = d.shape[1]
    for c in range(3):
        for i in range(n):
            out[j, (c + 1) * n + i] = e2 * radial[1, i] * d[c, i]
            out[(c + 1) * n + j, i] = -e2 * radial[1, i] * d[c, i]
    for e in range(3):
        row = (e + 1) * n + j
        for c in range(3):
            for i in range(n):
                out[row, (c + 1) * n + i] = -e2 * e2 * radial[2, i] * d[c, i] * d[e, i]
        for i in range(n):
            out[row, (e + 1) * n + i] -= e2 * radial[1, i]
