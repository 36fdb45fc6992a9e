"""RBFField: a scalar field f, negative inside, whose zero set is the surface; how those of muscles
are fitted.

f(x) = sum_j a_j phi(|x - c_j|) - B_j . grad phi(x - c_j) + p(x), with B = 0 for a fit to values.
The field of a muscle is a blend of such fits, each to a few centres that are near each other at
rest: sum_p w_p f_p / sum_p w_p with weights that fall from the middle of a fit to zero at its
farthest centre (a partition of unity; Wendland 2002, "Fast evaluation of radial basis functions:
methods based on partition of unity"). Its time grows as the number of centres does.
"""

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import touching_balls
from rbfmuscle.implicit.evaluation import Terms, evaluate
from rbfmuscle.implicit.fitting import Basis, solve
from rbfmuscle.implicit.kernels import Kernel, get_kernel
from rbfmuscle.validation import (
    NumericalWarning,
    UsageError,
    check_points,
    check_positive,
    check_values,
    check_vectors,
)

if TYPE_CHECKING:
    import trimesh

# Centres of each local fit of a muscle's field, and how many of these count as covered by it.
PART, COVERED = 24, 14
# The same for the cubic kernel, whose fits take half the time then; others break into more sheets.
SMALL = (15, 8)
# Part of the touching ball's radius that a step off the surface may use.
SAFETY = 0.5


class RBFField:
    """An RBF field; made by `fit` or `fit_hermite`.

    Attributes
    ----------
    centres : (K, 3) ndarray
        In the coordinates of the caller.
    kernel, epsilon : Kernel, float
        Its shape parameter [1/length] multiplies r.
    terms : Terms
        Weights and polynomials of the local fits.
    condition : float
        Estimate for the worst matrix that was factored.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(2, 1.0)
    >>> field = RBFField.fit_hermite(ball.vertices, ball.vertex_normals)
    >>> bool(field([[0.0, 0.0, 0.0]])[0] < 0.0)
    True
    >>> bool(abs(field.surface(resolution=24).volume - 4.19) < 0.1)
    True
    """

    def __init__(
        self, basis: Basis, right: Floats, epsilon: float, smoothing: float, condition: float
    ) -> None:
        if not (np.isfinite(smoothing) and smoothing >= 0.0):
            raise UsageError(f"smoothing must be a number of at least 0, got {smoothing}")
        if not condition >= 1.0:
            raise UsageError(f"condition must be at least 1, got {condition}")
        weights, coefficients, self.condition = solve(
            basis, right, smoothing=smoothing, condition=condition
        )
        self.centres = basis.centres
        self.kernel = basis.kernel
        self.epsilon = epsilon
        fits, count = basis.parts.shape
        rows = weights.reshape(fits, -1, count)
        middle = basis.centres[basis.parts[:, 0]]
        away = basis.centres[basis.parts] - middle[:, None]
        self.terms = Terms(
            basis.origin,
            basis.scale,
            basis.points,
            rows.copy() if basis.hermite else np.pad(rows, ((0, 0), (0, 3), (0, 0))),
            basis.hermite,
            basis.epsilon,
            coefficients,
            basis.powers,
            middle,
            np.sqrt(np.einsum("pnc,pnc->pn", away, away).max(axis=1)),
        )

    @classmethod
    def fit(
        cls,
        points: ArrayLike,
        values: ArrayLike,
        *,
        kernel: Kernel | str = "cubic",
        epsilon: float = 1.0,
        smoothing: float = 0.0,
        condition: float = np.inf,
        parts: Integers | None = None,
    ) -> "RBFField":
        """Interpolate values at points.

        Parameters
        ----------
        points : (K, 3) array_like
            Centres [scene unit].
        values : (K,) array_like
        kernel : str or Kernel
        epsilon : float
            Shape parameter [1/scene unit]; without effect on the interpolant of polyharmonic
            kernels.
        smoothing : float
            Added to the diagonal, in coordinates scaled to order one; 0 interpolates.
        condition : float
            Bound, at least 1 [1]: a ridge keeps it (see `solve`).
        parts : (P, n) array_like of int, optional
            Points of each local fit, its middle first; by default there is one, to all.

        Raises
        ------
        UsageError, numpy.linalg.LinAlgError
            For an unknown kernel; if the system is singular (the message names the likely cause).
        """
        points = check_points(points)
        values = check_values(values, len(points))
        kernel, epsilon = get_kernel(kernel), check_positive(epsilon, name="epsilon")
        basis = Basis(points, kernel, epsilon, parts=parts)
        return cls(basis, values[basis.parts], epsilon, smoothing, condition)

    @classmethod
    def fit_hermite(
        cls,
        points: ArrayLike,
        normals: ArrayLike,
        *,
        kernel: Kernel | str = "cubic",
        epsilon: float = 1.0,
        smoothing: float = 0.0,
        condition: float = np.inf,
        parts: Integers | None = None,
    ) -> "RBFField":
        """Fit f = 0 and grad f = normal at every point (Hermite RBF, Macedo 2011).

        Parameters
        ----------
        points : (K, 3) array_like
            Points of the surface [scene unit].
        normals : (K, 3) array_like
            Gradients wanted there, outward; unit vectors make f a distance near the surface.
        kernel, epsilon, smoothing, condition, parts
            As in `fit`; the kernel must be C2.

        Raises
        ------
        UsageError, numpy.linalg.LinAlgError
            For a kernel that is not smooth enough, or a condition below 1; as in `fit`.
        """
        points = check_points(points)
        normals = check_vectors(normals, len(points))
        kernel, epsilon = get_kernel(kernel), check_positive(epsilon, name="epsilon")
        if not kernel.hermite:
            raise UsageError(
                f"kernel '{kernel.name}' is C{kernel.smoothness}: use fit, as fit_hermite needs C2"
            )
        basis = Basis(points, kernel, epsilon, hermite=True, parts=parts)
        right = np.zeros((len(basis.parts), 4, basis.parts.shape[1]))
        right[:, 1:] = np.swapaxes(normals[basis.parts], 1, 2) * basis.scale[:, None, None]
        fitted = cls(basis, right.reshape(len(right), -1), epsilon, smoothing, condition)
        if kernel.has_epsilon:
            _warn_if_narrow(fitted, points, normals)
        return fitted

    def __call__(self, points: ArrayLike) -> Floats:
        """Field value at (n, 3) points: (n,), negative inside."""
        return evaluate(check_points(points), self.terms, self.kernel, False)[0]

    def gradient(self, points: Floats) -> Floats:
        """Gradient at (n, 3) points: (n, 3)."""
        return self.value_and_gradient(points)[1]

    def value_and_gradient(self, points: Floats) -> tuple[Floats, Floats]:
        """Value (n,) and gradient (n, 3) at (n, 3) points, for little more than the value alone."""
        return evaluate(check_points(points), self.terms, self.kernel, True)

    def surface(self, resolution: int = 64) -> "trimesh.Trimesh":
        """Zero set as a closed outward ``trimesh.Trimesh``; resolution in cells along the longest
        side.
        """
        import trimesh

        from rbfmuscle.implicit.extraction import extract_surface

        result = extract_surface(self, points=self.centres, resolution=resolution)
        return trimesh.Trimesh(result.vertices, result.faces, process=False)


def _warn_if_narrow(fitted: RBFField, points: Floats, normals: Floats) -> None:
    """Warn where the field does not rise outwards between its centres: the kernel does not reach
    that far.
    """
    if len(points) < 20:
        return  # too few to say what lies between them
    near = cKDTree(points).query(points, k=6)[1][:, 5]
    slope = np.einsum("ij,ij->i", fitted.gradient(0.5 * (points + points[near])), normals)
    if np.median(slope) < 0.5 * np.median(np.linalg.norm(normals, axis=1)):
        warnings.warn(
            f"kernel '{fitted.kernel.name}' with epsilon {fitted.epsilon:.3g} does not reach from "
            "centre to centre: "
            "the field is flat between them and shows no surface; lower epsilon or add centres",
            NumericalWarning,
            stacklevel=4,
        )


@dataclass(frozen=True)
class FieldFit:
    """How the field through a muscle's centres is fitted.

    ``epsilon`` is the kernel's shape parameter [1 / length], ``condition`` the bound that a ridge
    keeps.
    """

    kernel: Kernel
    epsilon: float
    condition: float = np.inf

    def parts(self, points: Floats) -> Integers:
        """Parts (P, n) of points (K, 3) for local fits with this kernel, as `overlapping_parts`."""
        return overlapping_parts(points, *(SMALL if self.kernel.plain_cube else (PART, COVERED)))

    def fit(self, centres: Floats, normals: Floats, parts: Integers | None = None) -> RBFField:
        """The field through centres (K, 3) with unit normals (K, 3), of local fits to ``parts`` (P,
        n) of them.

        The parts are `parts` of the centres, or of where these are at rest. Hermite
        fits where the kernel is C2. Else fits to values on the surface and off it: three centres
        for each point, and normals only as good as finite differences.
        """
        parts = self.parts(centres) if parts is None else parts
        if self.kernel.hermite:
            return RBFField.fit_hermite(
                centres,
                normals,
                kernel=self.kernel,
                epsilon=self.epsilon,
                condition=self.condition,
                parts=parts,
            )
        points, values = off_surface_points(centres, normals)
        fitted = RBFField.fit(
            points,
            values,
            kernel=self.kernel,
            epsilon=self.epsilon,
            condition=self.condition,
            parts=np.hstack([parts + k * len(centres) for k in range(3)]),
        )
        if self.kernel.has_epsilon:
            _warn_if_narrow(fitted, centres, normals)
        return fitted


def overlapping_parts(points: Floats, part: int = PART, covered: int = COVERED) -> Integers:
    """Parts (P, n) of points (K, 3): ``part`` nearest to one of them, which comes first, or all
    where there are few.

    Every point is among the first ``covered`` of a part: the middle of the next is always the point
    without one that is farthest from the middles so far.
    """
    if len(points) <= part:
        return np.arange(len(points))[None]
    near = cKDTree(points).query(points, part)[1]
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    middles: list[int] = []
    while (away >= 0.0).any():
        middles.append(int(np.argmax(away)))
        distance = np.linalg.norm(points - points[middles[-1]], axis=1)
        away = distance if len(middles) == 1 else np.minimum(away, distance)
        away[near[middles[-1], :covered]] = away[middles[-1]] = -1.0
    return np.asarray(near[middles])


def off_surface_points(points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Points (3K, 3) on, outside and inside a surface with signed distances (3K,) 0, +d and -d, for
    fits to values.

    Each point x (K, 3), two or more, with unit outward normal n gives f(x) = 0, f(x + d n) = d and
    f(x - d n) = -d (Carr et al. 2001). The step d is half the median distance to the nearest other
    point, and at most half the radius of the empty ball that touches the surface in x, so that x
    stays the nearest of all points to x + d n.
    """
    steps = np.empty((2, len(points)))
    nearest = np.empty(len(points))
    touching_balls(points, normals, steps, nearest)
    outside, inside = np.minimum(SAFETY * steps, 0.5 * np.median(nearest))
    where = np.vstack(
        [points, points + outside[:, None] * normals, points - inside[:, None] * normals]
    )
    return where, np.concatenate([np.zeros(len(points)), outside, -inside])
