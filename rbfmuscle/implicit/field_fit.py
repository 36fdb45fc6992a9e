"""How a field through centres with normals is fitted, again and again, as in motion."""

from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.surfaces import touching_balls
from rbfmuscle.implicit.field import RBFField, warn_if_narrow
from rbfmuscle.implicit.kernels.table import Kernel

# With more centres than these a fit to normal derivatives alone errs less for the same time.
MOST_WITH_ALL_DERIVATIVES = 200
# Part of the touching ball's radius that a step off the surface may use.
SAFETY = 0.5


@dataclass(frozen=True)
class FieldFit:
    """How the field through a muscle's centres is fitted.

    ``epsilon`` is the kernel's shape parameter [1 / length], ``derivatives`` ("all" or "normal") what the fit meets at
    a centre, ``condition`` the bound that a ridge keeps.
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


def off_surface_points(points: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Points (3K, 3) on, outside and inside a surface with signed distances (3K,) 0, +d and -d, for fits to values.

    Each point x (K, 3), two or more, with unit outward normal n gives f(x) = 0, f(x + d n) = d and f(x - d n) = -d
    (Carr et al. 2001). The step d is half the median distance to the nearest other point, and at most half the radius
    of the empty ball that touches the surface in x, so that x stays the nearest of all points to x + d n.
    """
    steps = np.empty((2, len(points)))
    nearest = np.empty(len(points))
    touching_balls(points, normals, steps, nearest)
    outside, inside = np.minimum(SAFETY * steps, 0.5 * np.median(nearest))
    where = np.vstack([points, points + outside[:, None] * normals, points - inside[:, None] * normals])
    return where, np.concatenate([np.zeros(len(points)), outside, -inside])
