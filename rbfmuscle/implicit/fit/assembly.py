"""Systems of RBF fits: the coordinates that they are scaled to, their matrices and polynomials.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives, so that every
row of every block is one contiguous run.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.loops import loop
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
        self.polynomials = _monomials(self.points, self.powers, hermite)

    def scaled(self) -> Floats:
        """All centres (K, 3) in the unit ball."""
        away = self.centres - 0.5 * (self.centres.min(axis=0) + self.centres.max(axis=0))
        return np.asarray(away / (np.sqrt((away**2).sum(axis=1).max()) or 1.0))

    def matrices(self, start: int, stop: int) -> Floats:
        """A of the fits from start to stop: (stop - start, size, size)."""
        points, epsilon = self.points[start:stop], self.epsilon[start:stop]
        fits, _, count = points.shape
        square = np.zeros((fits, count, count))
        for axis in range(3):
            square += (points[:, axis, :, None] - points[:, axis, None, :]) ** 2
        square *= epsilon[:, None, None] ** 2
        radial = self.kernel.radial(square, 3 if self.hermite else 1)
        if not self.hermite:
            return radial[0]
        out = np.empty((fits, self.size, self.size))
        _hermite_loop(points, epsilon, *radial, out)
        return out


def _monomials(points: Floats, powers: Integers, derivatives: bool) -> Floats:
    """Monomials (P, q, n) at points (P, 3, n), or with their derivatives by the three axes
    (P, q, 4n).
    """
    raised = np.ones((powers.max(initial=0) + 1, *points.shape))
    for power in range(1, len(raised)):
        raised[power] = raised[power - 1] * points

    def product(powers: Integers) -> Floats:
        x, y, z = (raised[powers[:, axis], :, axis] for axis in range(3))
        return np.swapaxes(x * y * z, 0, 1)

    parts = [product(powers)]
    for axis in range(3 if derivatives else 0):
        lower = powers.copy()
        lower[:, axis] = np.maximum(powers[:, axis] - 1, 0)
        parts.append(powers[:, axis, None] * product(lower))
    return np.concatenate(parts, axis=2)


@loop
def _hermite_loop(points, epsilon, phi, first, second, out):
    """Matrices (P, 4n, 4n) of fits to points (P, 3, n) from the radial functions (P, n, n).

    With d the way from centre j to i, blocks are (value, value) phi; (value, d/dx_c) first * d_c,
    as the other way round by the sign of d; (d/dx_e, d/dx_c) -(first * delta + second * d_c d_e).
    """
    n = points.shape[2]
    for p in range(len(points)):
        e2 = epsilon[p] ** 2
        for j in range(n):
            for i in range(n):
                out[p, j, i] = phi[p, j, i]
            for c in range(3):
                at = (c + 1) * n
                for i in range(n):
                    along = e2 * first[p, j, i] * (points[p, c, i] - points[p, c, j])
                    out[p, j, at + i] = along
                    out[p, at + j, i] = -along
                for e in range(3):
                    row = (e + 1) * n + j
                    for i in range(n):
                        way = points[p, c, i] - points[p, c, j]
                        other = points[p, e, i] - points[p, e, j]
                        out[p, row, at + i] = -e2 * e2 * second[p, j, i] * way * other
                for i in range(n):
                    out[p, at + j, at + i] -= e2 * first[p, j, i]
