"""Variable shape parameters: one epsilon a centre.

Afiatdoust & Esmaeilbeigi (2015) index their families by the order of 1-D points. Scattered points have no
such order, so centres are ranked here by local spacing, sparse ones first (small epsilon). The matrix is no
longer symmetric and its definiteness is not guaranteed: it is solved by truncated SVD with a rank check.
"""

import warnings

import numpy as np
from scipy import linalg
from scipy.optimize import differential_evolution

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import solve_least_squares
from rbfmuscle.implicit.fit.systems import collocation, frame
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.selection import spacing
from rbfmuscle.validation import NumericalWarning, UsageError, check_points, check_positive, check_values

FAMILIES = ("spacing", "exponential", "linear", "sinusoidal", "random")


def variable_epsilon(points, low, high, *, family="spacing", seed=0):
    """Shape parameters (K,) between low and high [1/length].

    Parameters
    ----------
    points : (K, 3) array_like
    low, high : float
        For "spacing" epsilon_j = c / h_j, clipped to [low, high], c such that the median is sqrt(low high).
    family : {"spacing", "exponential", "linear", "sinusoidal", "random"}
    seed : int
        For "random".
    """
    low, high = check_positive(low, name="low"), check_positive(high, name="high")
    if family not in FAMILIES:
        raise UsageError(f"family must be one of {', '.join(FAMILIES)}, got '{family}'")
    if low > high:
        raise UsageError(f"low must not exceed high, got {low} and {high}")
    local = spacing(check_points(points), neighbours=min(6, len(points) - 1))
    if family == "spacing":
        return np.clip(np.sqrt(low * high) * np.median(local) / local, low, high)
    rank = np.empty(len(local))
    rank[np.argsort(-local, kind="stable")] = np.linspace(0.0, 1.0, len(local))
    if family == "exponential":
        return low * (high / low) ** rank
    if family == "random":
        rank = np.random.default_rng(seed).uniform(size=len(local))
    elif family == "sinusoidal":
        rank = np.sin(0.5 * np.pi * rank)
    return low + (high - low) * rank


def fit_variable(points, values, epsilon, *, kernel="gaussian", degree=None):
    """Fit values at points with one epsilon a centre.

    Parameters
    ----------
    points : (K, 3) array_like
    values : (K,) array_like
    epsilon : (K,) array_like
        [1/length]
    kernel, degree
        As in `RBFField.fit`.

    Warns
    -----
    NumericalWarning
        Where the matrix is rank deficient to 1e-14; the solution is then the least-squares one.
    """
    points, values, kernel, epsilon, degree = _checked(points, values, epsilon, kernel, degree)
    matrix, powers, origin, scale = _system(points, epsilon, kernel, degree)
    count = len(points)
    solution, condition, rank = solve_least_squares(matrix, np.append(values, np.zeros(len(powers))))
    if rank < len(matrix):
        warnings.warn(
            f"variable epsilon between {epsilon.min():.3g} and {epsilon.max():.3g}: rank {rank} of "
            f"{len(matrix)}, the values are met in the least-squares sense only; raise epsilon",
            NumericalWarning,
            stacklevel=2,
        )
    polynomial = solution[count:], powers
    return RBFField(points, (origin, scale), kernel, epsilon, solution[:count], polynomial, condition)


def search_variable(
    points, values, *, kernel="gaussian", family="spacing", span=(0.1, 3.0), seed=0, generations=12
):
    """Evolutionary search of low and high by the leave-one-out error (differential evolution).

    Parameters
    ----------
    points, values, kernel, family
        As in `fit_variable` and `variable_epsilon`.
    span : (float, float)
        Range of low and high in multiples of 1 / (mean distance to the nearest neighbour).
    seed, generations : int

    Returns
    -------
    epsilon : (K,) ndarray
    objective : float
        Root mean square of the leave-one-out residuals.
    """
    points = check_points(points)
    unit = 1.0 / spacing(points).mean()
    kernel = get_kernel(kernel)
    bounds = [tuple(np.log(np.array(span) * unit))] * 2

    def shapes(ends):
        return variable_epsilon(points, *np.exp(np.sort(ends)), family=family, seed=seed)

    def objective(ends):
        return np.log(variable_leave_one_out(points, values, shapes(ends), kernel=kernel))

    found = differential_evolution(objective, bounds, seed=seed, popsize=6, maxiter=generations, polish=False)
    return shapes(found.x), float(np.exp(found.fun))


def variable_leave_one_out(points, values, epsilon, *, kernel="gaussian", degree=None):
    """Root mean square leave-one-out residual: Rippa's formula holds without symmetry."""
    points, values, kernel, epsilon, degree = _checked(points, values, epsilon, kernel, degree)
    matrix, _, _, _ = _system(points, epsilon, kernel, degree)
    inverse = linalg.pinv(matrix, rtol=1e-14)
    weights = inverse[: len(points), : len(points)] @ values
    diagonal = np.diagonal(inverse)[: len(points)]
    return float(np.sqrt(np.mean((weights / diagonal) ** 2)))


def _checked(points, values, epsilon, kernel, degree):
    points = check_points(points)
    values = check_values(values, len(points))
    epsilon = check_values(epsilon, len(points), name="epsilon")
    if epsilon.min() <= 0:
        raise UsageError(f"epsilon must be positive, row {int(epsilon.argmin())} is {epsilon.min()}")
    kernel = get_kernel(kernel)
    if not kernel.has_epsilon:
        raise UsageError(f"kernel '{kernel.name}' has no shape parameter")
    return points, values, kernel, epsilon, kernel.degree if degree is None else degree


def _system(points, epsilon, kernel, degree):
    origin, scale = frame(points)
    matrix, powers = collocation(points, points, kernel, epsilon, degree, origin, scale)
    q = len(powers)
    block = np.hstack([matrix[:, len(points) :].T, np.zeros((q, q))])
    return np.vstack([matrix, block]), powers, origin, scale
