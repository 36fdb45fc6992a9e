"""Interpolants and least-squares fits with flat kernels, down to epsilon = 0, without the ill-conditioned solve.

The weights of a flat kernel grow without bound, the field itself does not; `contour` says how it is found.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.contour import System, choose_circles
from rbfmuscle.validation import NumericalWarning, UsageError, check_points, check_values

if TYPE_CHECKING:
    from rbfmuscle.implicit.fit.contour import Circle
    from rbfmuscle.implicit.kernels.table import Kernel


DOUBTFUL = 1e-3
"""Estimated error, as a share of the values, above which a flat fit is reported as doubtful."""


class FlatField:
    """A field of a flat analytic kernel; made by `fit` or `fit_least_squares`.

    Attributes
    ----------
    centres : (K, 3) ndarray
    kernel : Kernel
    epsilon : float
        Shape parameter [1/length]; 0 is the limit.
    error : float
        Estimated error of the field as a share of the largest value: how far the results from two circles differ.
    radius : float
        Below which epsilon is flat [1/length]: of the smaller circle. From there on `RBFField.fit` is as good.
    condition : float
        The worst on the circle, 1-norm, estimated.

    Examples
    --------
    >>> points = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> field = FlatField.fit(points, [1.0, 2.0, 3.0, 4.0], kernel="gaussian", epsilon=0.0)
    >>> float(field([[0.5, 0.5, 0.0]]).round(6)[0])
    2.5
    """

    def __init__(
        self,
        centres: Floats,
        kernel: Kernel,
        epsilon: float,
        frame: tuple[Floats, float],
        circles: tuple[Circle, Circle],
    ) -> None:
        self.centres, self.kernel, self.epsilon = centres, kernel, epsilon
        self._origin, self._scale = frame
        self._circles = circles
        circle, other = circles
        self.radius, self.condition = other.radius / self._scale, circle.condition
        self.error = circle.difference(other, epsilon * self._scale)

    @classmethod
    def fit(
        cls,
        points: ArrayLike,
        values: ArrayLike,
        *,
        kernel: str = "gaussian",
        epsilon: float = 0.0,
        degree: int | None = None,
        reach: float = 1.1,
    ) -> FlatField:
        """Interpolate values at points with a kernel as flat as one likes.

        Parameters
        ----------
        points : (K, 3) array_like
            Centres [scene unit]; 200 are well served, more than 600 refused.
        values : (K,) array_like
        kernel : str or Kernel
            An analytic one: gaussian or a multiquadric, inverse or not.
        epsilon : float
            Shape parameter [1/scene unit]; 0 is the limit, for points on a line the polynomial interpolant.
        degree : int, optional
            Of the polynomial part, -1 for none; the kernel's least by default.
        reach : float
            How far out the field may be evaluated, in units of the radius of the ball round the points.

        Returns
        -------
        FlatField

        Raises
        ------
        UsageError
            For a kernel that is not analytic, or an epsilon that is not flat.
        numpy.linalg.LinAlgError
            If the system is singular on the circle (coinciding centres).

        Warns
        -----
        NumericalWarning
            Where the estimated error exceeds 1e-3 of the values: too many centres, or no limit exists.
        """
        points = check_points(points)
        values = check_values(values, len(points))
        system, place = System.of(points, kernel, degree, reach)
        return cls._best(points, system, place, values, _check_epsilon(epsilon))

    @classmethod
    def fit_least_squares(
        cls,
        points: ArrayLike,
        values: ArrayLike,
        centres: ArrayLike,
        *,
        kernel: str = "gaussian",
        epsilon: float = 0.0,
        degree: Any = None,
        reach: float = 1.1,
    ) -> FlatField:
        """Fit values at more points than centres, in the space of the flat interpolants of `fit`.

        The unknowns are the values at the centres, whose influence on the field stays bounded where weights do not.

        Parameters
        ----------
        points : (n, 3) array_like
            Where the values are known, n >= K, within reach.
        values : (n,) array_like
        centres : (K, 3) array_like
        kernel, epsilon, degree, reach
            As in `fit`.

        Returns
        -------
        FlatField
        """
        points, centres = check_points(points), check_points(centres, name="centres")
        values, epsilon = check_values(values, len(points)), _check_epsilon(epsilon)
        if len(points) < len(centres):
            raise UsageError(
                f"least squares needs at least {len(centres)} points (one a centre), got {len(points)}"
            )
        system, (origin, scale) = System.of(centres, kernel, degree, reach)
        at = system.check_reach((points - origin) / scale)
        # any values at the centres lead to the common poles
        sought = np.random.default_rng(0).normal(size=len(centres))
        circle, _ = choose_circles(system, sought, epsilon * scale)
        influence = circle.influence(at, epsilon * scale)
        solution = linalg.lstsq(influence, values, cond=1e-13)[0]
        return cls._best(centres, system, (origin, scale), solution, epsilon)

    @classmethod
    def _best(
        cls, centres: Floats, system: System, place: tuple[Floats, float], values: Floats, epsilon: float
    ) -> FlatField:
        circles = choose_circles(system, values, epsilon * place[1])
        fitted = cls(centres, system.kernel, epsilon, place, circles)
        if fitted.error > DOUBTFUL:
            warnings.warn(
                f"flat fit with kernel '{system.kernel.name}' at epsilon {epsilon:.3g} is uncertain by "
                f"{fitted.error:.1e} of its values: {len(centres)} centres are too many, or lie so that no limit "
                "exists; take fewer or raise epsilon",
                NumericalWarning,
                stacklevel=3,
            )
        return fitted

    def at(self, epsilon: float) -> FlatField:
        """The same data with another epsilon, without another solve: FlatField."""
        epsilon = _check_epsilon(epsilon)
        place = self._origin, self._scale
        return FlatField(self.centres, self.kernel, epsilon, place, self._circles)

    def __call__(self, points: ArrayLike) -> Floats:
        """Field value at (n, 3) points: (n,)."""
        return self._evaluate(points, False)[0]

    def gradient(self, points: Floats) -> Floats:
        """Gradient at (n, 3) points: (n, 3)."""
        return self.value_and_gradient(points)[1]

    def value_and_gradient(self, points: Floats) -> tuple[Floats, Floats]:
        """Value (n,) and gradient (n, 3) at (n, 3) points."""
        out = self._evaluate(points, True)
        return out[0], np.ascontiguousarray(out[1:].T / self._scale)

    def _evaluate(self, points: ArrayLike, gradient: bool) -> Floats:
        circle = self._circles[0]
        at = circle.system.check_reach((check_points(points) - self._origin) / self._scale)
        return circle.evaluate(at, self.epsilon * self._scale, gradient)


def _check_epsilon(epsilon: float) -> float:
    epsilon = float(epsilon)
    if not (np.isfinite(epsilon) and epsilon >= 0):
        raise UsageError(f"epsilon must be a number of at least 0, got {epsilon}")
    return epsilon
