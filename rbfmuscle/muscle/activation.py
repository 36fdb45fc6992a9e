"""The fibres of an RBF muscle that contracts: springs along the solid's fibres, in its shear
modulus.

A fibre that is stretched by λ against the scan bears, beside the tension of the passive solid,

    a d PEAK μ (λ - l) / (1/s - l),   l = 0.5 / s,

with a the activation, s the stretch in the scan, l the stretch at which active fibres bear nothing
and d the number of fibres through a unit area, 1 where the belly is widest: fibres run from end to
end, so where it narrows each area bears more. At the slack length a fully active fibre bears `PEAK`
shear moduli (Blemker, Pinsky & Delp 2005). Tendon is a spring that this tension stretches by
``tendon_strain``.
"""

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.muscle.fibres import flux
from rbfmuscle.muscle.solid import EmbeddedSolid
from rbfmuscle.scene.activation.contraction import resolve_contraction
from rbfmuscle.scene.objects import Muscle

PEAK = 30.0  # greatest isometric tension of active fibres, in shear moduli
WIDEST = 0.2  # share of the belly that counts as its widest part
# fibres through a unit area, in those of the widest part: the rims of attachments draw more
# together
DENSEST = 10.0
LEAST_STRAIN = 1e-3


class FibrePull:
    """Gives the solid's fibres the stiffness and the slack length of an activation."""

    def __init__(self, solid: EmbeddedSolid, muscle: Muscle) -> None:
        self.solid, self.passive = solid, solid.fibres
        self.given = resolve_contraction(muscle)
        vertices = np.asarray(muscle.mesh.vertices)
        self.tendon = self.given.tendon[cKDTree(vertices).query(solid.quad_points)[1]]
        self.density = fibre_density(solid, ~self.tendon)
        lower, upper = (
            self.passive.lower.copy(),
            np.full(len(self.tendon), max(1.0, 1.0 / self.given.stretch_at_rest)),
        )
        if self.given.slack:
            lower[:] = min(1.0, 1.0 / self.given.stretch_at_rest)
        lower[self.tendon] = upper[self.tendon] = 1.0
        self.passive = self.passive._replace(lower=lower, upper=upper)
        self.activation = np.nan
        self.activate(0.0)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, for the next solve."""
        if activation == self.activation:
            return
        self.activation, given = float(activation), self.given
        slack, content = 1.0 / given.stretch_at_rest, given.shortest
        active = self.density * self.activation * 0.5 * PEAK / max(slack - content, 0.05)
        active[self.tendon] = 0.0
        passive, strain = self.passive.passive.copy(), max(given.tendon_strain, LEAST_STRAIN)
        passive[self.tendon] = self.density[self.tendon] * 0.5 * PEAK / strain
        self.solid.take_fibres(
            self.passive._replace(
                passive=passive, active=active, content=np.full(len(active), content)
            )
        )


def fibre_density(solid: EmbeddedSolid, belly: Booleans) -> Floats:
    """Fibres through a unit area at the quadrature points (Q,), 1 where the belly is widest.

    They run as a flux without sources from one end to the other, spread evenly over both.
    """
    size = np.linalg.norm(flux(solid), axis=1)
    order = np.argsort(size[belly], kind="stable")
    weight = np.cumsum(solid.weights[belly][order])
    widest = size[belly][order][np.searchsorted(weight, 0.5 * WIDEST * weight[-1])]
    return np.minimum(size / max(float(widest), 1e-300), DENSEST)
