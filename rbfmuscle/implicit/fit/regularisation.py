"""Tikhonov regularisation: how much smoothing noisy or ill-conditioned data ask for."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.cross_validation import LeastSquaresPath, SmoothingPath
from rbfmuscle.validation import NumericalWarning, UsageError

if TYPE_CHECKING:
    from rbfmuscle.implicit.fit.fitting import Basis


SMOOTHING_CRITERIA = ("gcv", "loo")
_PER_DECADE = 4


@dataclass(frozen=True)
class SmoothingChoice:
    """A chosen smoothing and the way to it.

    Attributes
    ----------
    smoothing : float
        As `RBFField.fit` takes it: added to the diagonal in coordinates scaled to order one.
    objective : float
        The criterion there: root mean square of the left-out residuals, or of those with the mean block (GCV).
    tried : (n, 2) ndarray
        smoothing and objective of all evaluations, by smoothing.
    """

    smoothing: float
    objective: float
    tried: np.ndarray


def search_smoothing(path: SmoothingPath | LeastSquaresPath, criterion: str = "gcv") -> SmoothingChoice:
    """The smoothing that makes a criterion least along a decomposition: a scan, then a refinement.

    Parameters
    ----------
    path : cross_validation.SmoothingPath or cross_validation.LeastSquaresPath
    criterion : {"gcv", "loo"}
        Generalised cross-validation (Golub, Heath & Wahba 1979) or leave-one-out.

    Returns
    -------
    SmoothingChoice

    Warns
    -----
    NumericalWarning
        Where nothing but the polynomial would be left of a surface.
    """
    check_criterion(criterion)

    def objective(exponent: float) -> float:
        return path.residuals(10.0**exponent).score(criterion, path.lever)

    low, high = (math.log10(end) for end in path.span)
    exponents = np.linspace(low, high, max(round(_PER_DECADE * (high - low)), 2) + 1)
    tried = [(exponent, objective(exponent)) for exponent in exponents]
    best = int(np.argmin([score for _, score in tried]))
    ends = exponents[max(best - 1, 0)], exponents[min(best + 1, len(exponents) - 1)]
    from scipy.optimize import minimize_scalar  # a fifth of a second, which few fits ask for

    found = minimize_scalar(objective, bounds=ends, method="bounded", options={"xatol": 1e-3})
    scores = np.array(sorted([*tried, (float(found.x), float(found.fun))]))
    scores[:, 0] = 10.0 ** scores[:, 0]
    best = scores[np.argmin(scores[:, 1])]
    if path.lever and best[0] > 0.1 * path.span[1]:
        warnings.warn(
            f"the smoothing chosen by '{criterion}' ({best[0]:.2g}) leaves hardly anything of the surface: points and "
            "normals contradict each other; use fewer or better ones, or give smoothing as a number",
            NumericalWarning,
            stacklevel=2,
        )
    return SmoothingChoice(float(best[0]), float(best[1]), scores)


def check_criterion(criterion: str) -> None:
    """Raise UsageError for a criterion that does not choose smoothing."""
    if criterion not in SMOOTHING_CRITERIA:
        raise UsageError(f"smoothing is a number or chosen by 'gcv' or 'loo', got {criterion!r}")


def resolve_smoothing(smoothing: float | str, path: Callable[..., Any]) -> float:
    """Smoothing as a number: as given, or chosen where a criterion is named.

    Parameters
    ----------
    smoothing : float or str
    path : callable
        Makes the path to search, if it is needed.

    Raises
    ------
    UsageError
        For a negative or infinite number or an unknown criterion.
    """
    if isinstance(smoothing, str):
        check_criterion(smoothing)
        return search_smoothing(path(), smoothing).smoothing
    smoothing = float(smoothing)
    if not (np.isfinite(smoothing) and smoothing >= 0):
        raise UsageError(f"smoothing must be a number of at least 0, 'gcv' or 'loo', got {smoothing}")
    return smoothing


def basis_smoothing(smoothing: float | str, basis: Basis, right: Floats) -> float:
    """`resolve_smoothing` for a square system with this right side."""
    return resolve_smoothing(smoothing, lambda: SmoothingPath(basis, right))
