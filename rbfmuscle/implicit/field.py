"""RBFField: a scalar field f, negative inside, whose zero set is the surface.

f(x) = sum_j a_j phi(|x - c_j|) - B_j . grad phi(x - c_j) + p(x), with B = 0 for a fit to values.
"""

import warnings

import numpy as np

from rbfmuscle.implicit import assembly
from rbfmuscle.implicit.evaluation import evaluate
from rbfmuscle.implicit.fitting import Basis, solve
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.validation import (
    NumericalWarning,
    UsageError,
    check_points,
    check_positive,
    check_values,
    check_vectors,
)

_DOUBTFUL = 1e13


class RBFField:
    """An RBF field; made by `fit` or `fit_hermite`.

    Attributes
    ----------
    centres : (K, 3) ndarray
        In the coordinates of the caller.
    kernel : Kernel
    epsilon : float
        Shape parameter [1/length]; multiplies r.
    weights : (K,) or (K, 4) ndarray
        a_j, or for a Hermite fit a_j and B_j, for centred and scaled coordinates.
    coefficients : (q,) ndarray
        Of the monomials ``powers`` in scaled coordinates.
    origin, scale : (3,) ndarray, float
        Scaled coordinates are (x - origin) / scale.
    condition : float
        Estimate for the matrix that was factored.
    """

    def __init__(self, centres, origin, scale, kernel, epsilon, weights, coefficients, powers, condition):
        self.centres, self.origin, self.scale = centres, origin, scale
        self.kernel, self.epsilon = kernel, epsilon
        self.weights, self.coefficients, self.powers = weights, coefficients, powers
        self.condition = condition
        self._scaled = np.ascontiguousarray(((centres - origin) / scale).T)
        self._rows = np.ascontiguousarray(weights.reshape(len(centres), -1).T)
        self._shape = np.full(len(centres), epsilon * scale if kernel.has_epsilon else 1.0)

    @classmethod
    def fit(cls, points, values, *, kernel="cubic", epsilon=1.0, degree=None, smoothing=0.0):
        """Interpolate values at points.

        Parameters
        ----------
        points : (K, 3) array_like
            Centres [scene unit].
        values : (K,) array_like
        kernel : str or Kernel
        epsilon : float
            Shape parameter [1/scene unit]; without effect on the interpolant of polyharmonic kernels.
        degree : int, optional
            Of the polynomial part, -1 for none; the kernel's least by default.
        smoothing : float
            Added to the diagonal, in coordinates scaled to order one; 0 interpolates.

        Returns
        -------
        RBFField

        Raises
        ------
        UsageError
            For an unknown kernel or a degree below the kernel's least.
        numpy.linalg.LinAlgError
            If the system is singular; the message names the likely cause.
        """
        points = check_points(points)
        values = check_values(values, len(points))
        kernel, epsilon = get_kernel(kernel), check_positive(epsilon, name="epsilon")
        degree = _check_degree(kernel, degree, len(points))
        origin, scale = _frame(points)
        shape = epsilon * scale if kernel.has_epsilon else 1.0
        basis = Basis((points - origin) / scale, kernel, shape, degree, hermite=False)
        weights, coefficients, condition = solve(basis, values, smoothing=_check_smoothing(smoothing))
        _warn_doubtful(condition, kernel, epsilon)
        return cls(points, origin, scale, kernel, epsilon, weights, coefficients, basis.powers, condition)

    @classmethod
    def fit_hermite(cls, points, normals, *, kernel="cubic", epsilon=1.0, smoothing=0.0):
        """Fit f = 0 and grad f = normal at every point (Hermite RBF, Macedo 2011).

        Parameters
        ----------
        points : (K, 3) array_like
            Points of the surface [scene unit].
        normals : (K, 3) array_like
            Gradients wanted there, outward; unit vectors make f a distance near the surface.
        kernel, epsilon, smoothing
            As in `fit`; the kernel must be C2.

        Raises
        ------
        UsageError
            For a kernel that is not smooth enough.
        numpy.linalg.LinAlgError
            If the system is singular.
        """
        points = check_points(points)
        normals = check_vectors(normals, len(points))
        kernel, epsilon = get_kernel(kernel), check_positive(epsilon, name="epsilon")
        if not kernel.hermite:
            raise UsageError(
                f"kernel '{kernel.name}' is C{kernel.smoothness} only and a Hermite fit needs C2; use fit"
            )
        origin, scale = _frame(points)
        shape = epsilon * scale if kernel.has_epsilon else 1.0
        basis = Basis((points - origin) / scale, kernel, shape, kernel.degree, hermite=True)
        right = np.concatenate([np.zeros(len(points)), normals.T.ravel()]) * scale
        weights, coefficients, condition = solve(basis, right, smoothing=_check_smoothing(smoothing))
        _warn_doubtful(condition, kernel, epsilon)
        weights = weights.reshape(4, -1).T.copy()
        return cls(points, origin, scale, kernel, epsilon, weights, coefficients, basis.powers, condition)

    def __call__(self, points):
        """Field value at (n, 3) points: (n,), negative inside."""
        points = check_points(points)
        out = self._radial(points, 0)[0]
        if len(self.powers):
            out += self.coefficients @ assembly.monomials((points - self.origin) / self.scale, self.powers)
        return out

    def gradient(self, points):
        """Gradient at (n, 3) points: (n, 3)."""
        return self.value_and_gradient(points)[1]

    def value_and_gradient(self, points):
        """Value (n,) and gradient (n, 3) at (n, 3) points, for little more than the value alone."""
        points = check_points(points)
        out = self._radial(points, 1)
        value, gradient = out[0], out[1:].T
        if len(self.powers):
            scaled = (points - self.origin) / self.scale
            value += self.coefficients @ assembly.monomials(scaled, self.powers)
            gradient = gradient + np.einsum(
                "q,cqn->nc", self.coefficients, assembly.monomial_gradients(scaled, self.powers)
            )
        return value, np.ascontiguousarray(gradient / self.scale)

    def _radial(self, points, order):
        return evaluate(
            points, self.origin, self.scale, self._scaled, self._rows, self.kernel, self._shape, order
        )


def _frame(points):
    """Origin (3,) and scale: the points lie in the unit ball of (x - origin) / scale."""
    if not len(points):
        raise UsageError("a fit needs at least one point, got none")
    origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = float(np.sqrt(((points - origin) ** 2).sum(axis=1).max()))
    return origin, scale if scale > 0 else 1.0


def _check_degree(kernel, degree, count):
    least = kernel.degree
    degree = least if degree is None else int(degree)
    if degree < least:
        raise UsageError(f"degree of kernel '{kernel.name}' must be at least {least}, got {degree}")
    terms = (degree + 1) * (degree + 2) * (degree + 3) // 6
    if terms > count:
        raise np.linalg.LinAlgError(
            f"degree {degree} has {terms} polynomial terms, more than the {count} points; lower it or add points"
        )
    return degree


def _check_smoothing(smoothing):
    smoothing = float(smoothing)
    if not (np.isfinite(smoothing) and smoothing >= 0):
        raise UsageError(f"smoothing must be a number of at least 0, got {smoothing}")
    return smoothing


def _warn_doubtful(condition, kernel, epsilon):
    if condition > _DOUBTFUL:
        raised = "raise epsilon, " if kernel.has_epsilon else ""
        warnings.warn(
            f"fit with kernel '{kernel.name}' (epsilon {epsilon:.3g}) has condition {condition:.1e}: about "
            f"{max(0, 16 - int(np.log10(condition)))} digits remain; {raised}spread the centres or add smoothing",
            NumericalWarning,
            stacklevel=3,
        )
