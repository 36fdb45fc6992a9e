"""The field of a muscle that moved: its local fits made anew where its centres are now."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.implicit.evaluation import Blend, Terms, evaluate_blend, weigh
from rbfmuscle.implicit.field import FieldFit, RBFField

# Fits of less weight than this at a vertex are left out there.
LEAST_WEIGHT = 2e-2


class MovingField:
    """The field through centres that move.

    Points of the material keep the weights of the local fits that they have at rest (`weights`):
    a fit to another part of the muscle that has come near has no part in their field.

    Parameters
    ----------
    fit : FieldFit
    parts : (P, n) ndarray of int
        Centres of each local fit.
    centres, normals : (K, 3) ndarray
        At rest.

    Attributes
    ----------
    condition : float
        Of the worst matrix of the last fit, infinite where there is none.
    """

    def __init__(self, fit: FieldFit, parts: Integers, centres: Floats, normals: Floats) -> None:
        self._fit, self._parts = fit, parts
        self._terms: Terms | None = None
        self.condition = np.inf
        self.move(centres, normals)

    def through(self, centres: Floats, normals: Floats) -> RBFField:
        """The field through centres (K, 3) with unit normals (K, 3); ValueError or LinAlgError
        where there is none.
        """
        return self._fit.fit(centres, normals, self._parts)

    def move(self, centres: Floats, normals: Floats) -> None:
        """Fit anew through centres (K, 3) with unit normals (K, 3)."""
        self.condition = np.inf
        if not (np.isfinite(centres).all() and np.isfinite(normals).all()):
            return
        try:
            field = self.through(centres, normals)
        except (ValueError, np.linalg.LinAlgError):
            return
        self._terms, self.condition = field.terms, field.condition

    def weights(self, points: Floats) -> Blend:
        """Weights of the local fits at points (n, 3) of the material, where it is now."""
        assert self._terms is not None
        return weigh(points, self._terms).without(LEAST_WEIGHT, len(points))

    def __call__(
        self, points: Floats, weights: Blend, todo: Booleans | None = None
    ) -> tuple[Floats, Floats]:
        """Values (n,) and gradients (n, 3) at points (n, 3) with some weights; 0 where ``todo``
        (n,) leaves a point out.
        """
        assert self._terms is not None
        return evaluate_blend(points, self._terms, self._fit.kernel, weights, todo)
