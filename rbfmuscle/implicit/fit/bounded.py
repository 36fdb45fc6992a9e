"""Fits whose condition is bounded: unknowns in units of the spacing, and a ridge that keeps the bound.

Values and derivatives are unknowns of different units. Cholesky's digits do not depend on the choice (van der Sluis
1969), an estimate of the condition does: with derivatives in units of the centres' spacing, and on the weights that
annihilate polynomials alone, `quintic` with 300 centres has 2e9 where unit-ball coordinates say 4e11. Every such fit
gets a ridge of the largest eigenvalue over the bound, in the same units: one part in so many where it was not needed.
"""

from __future__ import annotations

import math

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.fit.fitting import Basis, factorise_matrix, raise_if_singular


def solve_bounded(basis: Basis, right: Floats, condition: float) -> tuple[Floats, Floats, float]:
    """Weights, polynomial coefficients and an estimate of the condition, which is at most the given one.

    Parameters
    ----------
    basis : Basis
    right : (size,) ndarray
    condition : float
        Bound [1]; the conditions of the fit are met to about one part in so many.

    Returns
    -------
    weights : (size,) ndarray
    coefficients : (q,) ndarray
    condition : float
        Of the matrix with its ridge, in units of the spacing, on the weights that annihilate polynomials.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the system is singular, or the bound is more than floating-point numbers hold.
    """
    count, unit = len(basis.points), _unit(basis)
    matrix = basis.matrix()
    with np.errstate(all="ignore"):  # the upper triangle, which is never read, holds anything
        matrix[count:, :count] *= unit
        matrix[count:, count:] *= unit**2
    scale = np.ones(basis.size)
    scale[count:] = unit
    factor = factorise_matrix(matrix, np.ascontiguousarray(basis.polynomials * scale), condition=condition)
    if factor is None:
        raise_if_singular(basis)
        raise np.linalg.LinAlgError(f"no Cholesky factor with a condition of {condition:g}; lower the bound")
    weights, coefficients, found = factor.solve(scale * right)
    return scale * weights, coefficients, min(found, condition)


def _unit(basis: Basis) -> float:
    """About the spacing of so many centres in the unit ball; a factor of three either way changes little."""
    return 1.0 / math.sqrt(len(basis.points))
