"""Interpolants on circles of complex epsilon, and the rational functions that continue them to epsilon = 0.

The interpolant is a meromorphic function of z = epsilon^2 with few poles near 0, the same for every point x (where
the matrix is singular). Wright & Fornberg (2017, RBF-RA, arXiv 1610.05374) compute it on a circle, where the direct
solve is sound, and continue it inwards by a rational function whose denominator is common to many points x.

On N = 2H even points of the circle, t = z / radius^2 = exp(i theta), the discrete Fourier coefficients F_l(x) of the
interpolant are real. Wanted is a denominator q of degree n for which q F has no coefficients above m = H - 1 nor
below 0: the null vector of stacked Toeplitz matrices, in the least-squares sense over all probes x (as Gonnet, Pachon
& Trefethen 2011 do for a single function). Then

    s(x, epsilon) = sum_k c_k(t) s(x, epsilon_k),   c_k = q(t_k) sum_{l <= m} (t / t_k)^l / (N q(t)),

so that the flat interpolant is a sum of N well-conditioned ones, which can be evaluated anywhere.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg
from scipy.spatial.distance import cdist

from rbfmuscle.geometry.arrays import Array, Floats
from rbfmuscle.implicit.fit import assembly
from rbfmuscle.implicit.fit.fitting import raise_if_singular
from rbfmuscle.implicit.fit.systems import check_degree, frame
from rbfmuscle.implicit.kernels import radial
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.implicit.kernels.table import Kernel


_HALF = 64  # solves a circle
_CONDITIONS = (1e6, 1e8, 1e10)  # of the real matrix on the circles that are tried with an entire kernel
_LEAST_RADII = (0.6, 0.5, 0.4)  # of those; few centres are sound far inside
_SHRINK = (0.95, 0.82, 0.7)  # of the distance to the nearest branch point, on those tried with any other
_NOISE = 3.0
_CHUNK = 200_000
_MOST_CENTRES = 600


class System:
    """Scaled centres, kernel and polynomials; solves for any complex epsilon."""

    def __init__(self, centres: Floats, kernel: Kernel, degree: int, reach: float) -> None:
        self.points, self.kernel, self.reach, self.size = centres, kernel, reach, len(centres)
        self.powers = assembly.exponents(degree)
        self.squares = cdist(centres, centres, "sqeuclidean")
        self.polynomials = assembly.monomials(centres, self.powers)
        raise_if_singular(self)

    @classmethod
    def of(
        cls, points: Floats, kernel: str, degree: Any, reach: float
    ) -> tuple[System, tuple[Floats, float]]:
        """The system of these points in their own frame, and that frame (origin, scale)."""
        kernel = get_kernel(kernel)
        if kernel.base not in (radial.GAUSS, radial.BINOMIAL):
            raise UsageError(
                f"kernel '{kernel.name}' is not analytic and has no flat limit; use RBFField.fit"
            )
        if not 1.0 <= reach <= 10.0:
            raise UsageError(f"reach must lie between 1 and 10, got {reach}")
        if len(points) > _MOST_CENTRES:
            raise UsageError(
                f"a flat fit takes at most {_MOST_CENTRES} centres (beyond, none of it is sound), got {len(points)}"
            )
        degree = check_degree(kernel, degree, len(points))
        origin, scale = frame(points)
        return cls((points - origin) / scale, kernel, degree, reach), (origin, scale)

    def check_reach(self, points: Floats) -> Floats:
        """The scaled points, if none lies beyond the reach."""
        far = np.sqrt((points * points).sum(axis=1).max(initial=0.0))
        if far > self.reach * (1 + 1e-12):
            raise UsageError(
                f"a point lies {far:.3g} radii from the middle of the centres; fit with "
                f"reach={math.ceil(100 * far) / 100}"
            )
        return points

    def matrix(self, z: Any) -> Array:
        """The augmented matrix at epsilon^2 = z."""
        count, q = len(self.points), len(self.powers)
        full = np.zeros((count + q, count + q), dtype=complex)
        full[:count, :count] = self.radial(z * self.squares, 0)
        full[count:, :count], full[:count, count:] = self.polynomials, self.polynomials.T
        return full

    def radial(self, u: Array, k: int) -> Array:
        """The k-th radial function (see `kernels`) at complex u = s^2."""
        row = self.kernel.table[k]
        if self.kernel.base == radial.GAUSS:
            return row[2] * np.exp(-u)
        power = self.kernel.parameter - row[1]
        whole = int(np.floor(power))
        base = 1.0 + u
        if power == whole:
            rest = np.ones_like(base)
        else:
            rest = np.sqrt(base) if power - whole == 0.5 else base ** (power - whole)
        for _ in range(abs(whole)):
            rest = rest * base if whole > 0 else rest / base
        return row[2] * rest

    def radii(self) -> list[float]:
        """Radii of circles to try, the largest first."""
        if self.kernel.base == radial.GAUSS:
            found = [self._radius_of(condition) for condition in _CONDITIONS]
            return [max(radius, least) for radius, least in zip(found, _LEAST_RADII)]
        return [shrink / (1.0 + self.reach) for shrink in _SHRINK]

    def _radius_of(self, condition: float) -> float:
        """Real epsilon with a given condition, by bisection of its logarithm."""
        low, high = -6.0, 6.0
        for _ in range(16):
            middle = 0.5 * (low + high)
            sizes = np.abs(linalg.eigvalsh(self.matrix(4.0**middle).real))
            low, high = (low, middle) if sizes.max() < condition * sizes.min() else (middle, high)
        return 2.0**high

    def probes(self, count: int) -> Floats:
        """Points on lines through two centres each, a little beyond them too: (count, 3)."""
        rng = np.random.default_rng(0)
        first, second = self.points[rng.integers(len(self.points), size=(2, count))]
        out = first + rng.uniform(-0.1, 1.1, (count, 1)) * (second - first)
        return out / np.maximum(np.linalg.norm(out, axis=1) / self.reach, 1.0)[:, None]


class Circle:
    """Interpolants on a circle of complex epsilon and the denominator that continues them inwards."""

    def __init__(self, system: System, radius: float, values: Floats) -> None:
        self.system, self.radius, self.size = system, radius, np.abs(values).max()
        self.angles = np.pi * (np.arange(_HALF) + 0.5) / _HALF
        self.squares = radius**2 * np.exp(1j * self.angles)
        right = np.append(values, np.zeros(len(system.powers)))
        self.weights, self.condition = np.empty((_HALF, len(right)), dtype=complex), 1.0
        for k, z in enumerate(self.squares):
            self.weights[k] = self._solve(z, right)
        self.sites = system.probes(2 * len(system.points) + 20)
        coefficients = self._coefficients(np.array([self._direct(k, self.sites)[0] for k in range(_HALF)]))
        self.denominator = common_denominator(coefficients)

    def _solve(self, z: Any, right: Floats) -> Array:
        matrix = self.system.matrix(z)
        factor, pivots, info = linalg.lapack.zgetrf(matrix)
        if info:
            raise np.linalg.LinAlgError("singular flat fit: centres all but coincide; remove duplicates")
        norm = np.abs(matrix).sum(axis=0).max()
        self.condition = max(self.condition, 1.0 / max(linalg.lapack.zgecon(factor, norm)[0], 1e-300))
        return linalg.lapack.zgetrs(factor, pivots, right)[0]

    def _coefficients(self, samples: Array) -> Floats:
        """Fourier coefficients -H ... H - 1 of samples on the upper half circle: (2H, M), real."""
        orders = np.arange(-_HALF, _HALF)
        return (np.exp(-1j * np.outer(orders, self.angles)) @ samples).real / _HALF

    def _direct(self, k: int, points: Floats, gradient: bool = False) -> Array:
        """Interpolant (and gradient) at the k-th complex epsilon: (1 or 4, n)."""
        system, z, weights = self.system, self.squares[k], self.weights[k]
        count = len(system.points)
        u = z * cdist(points, system.points, "sqeuclidean")
        out = np.empty((4 if gradient else 1, len(points)), dtype=complex)
        out[0] = system.radial(u, 0) @ weights[:count]
        out[0] += weights[count:] @ assembly.monomials(points, system.powers)
        if gradient:
            pull = z * system.radial(u, 1) * weights[:count]
            out[1:] = (points * pull.sum(axis=1)[:, None] - pull @ system.points).T
            slopes = assembly.monomial_gradients(points, system.powers)
            out[1:] += np.einsum("q,cqn->cn", weights[count:], slopes)
        return out

    def shares(self, epsilon: float) -> Array:
        """c_k of the module's formula for the upper half circle, times two: (H,)."""
        if not epsilon < self.radius:
            raise UsageError(
                f"epsilon is not flat: it is {epsilon / self.radius:.3g} of the circle's radius; use RBFField.fit"
            )
        t, ends = (epsilon / self.radius) ** 2, np.exp(1j * self.angles)
        series = np.vander(t / ends, _HALF, increasing=True).sum(axis=1)
        bottom = np.polynomial.polynomial.polyval(t, self.denominator)
        return np.polynomial.polynomial.polyval(ends, self.denominator) * series / (_HALF * bottom)

    def evaluate(self, points: Floats, epsilon: float, gradient: bool = False) -> Floats:
        """Value (and gradient) at scaled points for a scaled real epsilon: (1 or 4, n)."""
        shares = self.shares(epsilon)
        out = np.zeros((4 if gradient else 1, len(points)))
        step = max(_CHUNK // len(self.system.points), 1)
        for start in range(0, len(points), step):
            some = slice(start, start + step)
            for k, share in enumerate(shares):
                out[:, some] += (share * self._direct(k, points[some], gradient)).real
        return out

    def influence(self, points: Floats, epsilon: float) -> Floats:
        """Matrix that maps values at the centres to the field at scaled points: (n, K)."""
        system, count = self.system, len(self.system.points)
        squares = cdist(points, system.points, "sqeuclidean")
        monomials = assembly.monomials(points, system.powers).T
        out = np.zeros((len(points), count))
        for share, z in zip(self.shares(epsilon), self.squares):
            rows = np.hstack([system.radial(z * squares, 0), monomials])
            # the matrix is symmetric, not Hermitian: row A^-1 is A^-1 row
            out += (share * self._solve(z, rows.T)[:count].T).real
        return out

    def difference(self, other: Circle, epsilon: float) -> float:
        """Largest difference from another circle's values at the probes, as a share of the data."""
        mine, others = (circle.evaluate(self.sites, epsilon) for circle in (self, other))
        return float(np.abs(mine - others).max() / max(self.size, 1e-300))


def common_denominator(coefficients: Floats) -> Floats:
    """Coefficients of the common denominator, of the least degree that reaches the level of the noise.

    Parameters
    ----------
    coefficients : (2H, M) ndarray
        Of order -H ... H - 1 for M functions.

    Returns
    -------
    (n + 1,) ndarray
    """
    half, most = len(coefficients) // 2, len(coefficients) // 4
    scaled = coefficients / np.maximum(np.abs(coefficients).max(axis=0), 1e-300)
    wrong = np.arange(-half, 0)
    columns = []
    for i in range(most + 1):
        # samples lie at odd multiples of pi / (2H): an order below -H comes back with the other sign
        order = wrong - i
        sign = np.where(order < -half, -1.0, 1.0)
        columns.append((sign[:, None] * scaled[(order + half) % (2 * half)]).ravel())
    upper = linalg.qr(np.stack(columns, axis=1), mode="r")[0][: most + 1]
    found = [linalg.svd(upper[: n + 1, : n + 1]) for n in range(most + 1)]
    least = np.array([values[-1] for _, values, _ in found])
    degree = int(np.argmax(least <= _NOISE * max(least[-1], 1e-15)))
    return found[degree][2][-1]


def choose_circles(system: System, values: Floats, epsilon: float) -> tuple[Circle, Circle]:
    """The two neighbouring circles that agree best at epsilon, the better conditioned one first."""
    circles = [Circle(system, radius, values) for radius in system.radii() if radius > epsilon]
    if len(circles) < 2:
        raise UsageError("epsilon is not flat: the direct solve is sound there; use RBFField.fit")
    return min(pairwise(circles), key=lambda pair: pair[0].difference(pair[1], epsilon))
