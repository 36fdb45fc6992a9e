"""How a field through centres with normals is fitted, again and again, as in motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.implicit.field import RBFField, warn_if_narrow
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.implicit.placement.off_surface import off_surface_points

# With more centres than these a fit to normal derivatives alone errs less for the same time.
MOST_WITH_ALL_DERIVATIVES = 200


@dataclass(frozen=True)
class FieldFit:
    """How the field through a muscle's centres is fitted.

    Attributes
    ----------
    kernel : Kernel
    epsilon : float
        Its shape parameter [1 / length].
    derivatives : {"all", "normal"}
        What the fit meets at a centre.
    condition : float
        Bound of its condition, which a ridge keeps.
    """

    kernel: Kernel
    epsilon: float
    derivatives: str
    condition: float = np.inf

    def fit(self, centres: Floats, normals: Floats) -> RBFField:
        """The field through centres (K, 3) with unit normals (K, 3).

        A Hermite fit where the kernel is C2. Else a fit to values on the surface and off it: three centres for each
        point, and normals only as good as finite differences.
        """
        if self.kernel.hermite:
            return RBFField.fit_hermite(
                centres, normals, kernel=self.kernel, epsilon=self.epsilon, derivatives=self.derivatives,
                condition=self.condition,
            )  # fmt: skip
        points, values = off_surface_points(centres, normals)
        fitted = RBFField.fit(
            points, values, kernel=self.kernel, epsilon=self.epsilon, condition=self.condition
        )
        if self.kernel.has_epsilon:
            warn_if_narrow(fitted, centres, normals)
        return fitted


def wanted_derivatives(count: int, *, fitted: bool) -> str:
    """What a fit to so many centres meets: all derivatives of few ones and of those fitted to the whole surface."""
    return "all" if fitted or count <= MOST_WITH_ALL_DERIVATIVES else "normal"
