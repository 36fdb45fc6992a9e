"""The fibres of a muscle with an inside that contracts: springs along the solid's fibres, in its shear modulus.

A fibre of muscle that is stretched by λ against the scan bears

    passive   2 μ c (λ - λ*),                   c = 3/2 (fibre_ratio - 1), λ* the nearest place of its slack band,
    active    a d PEAK μ (λ - l) / (1/s - l),   l = shortening / s,

with a the activation, s the stretch in the scan, l the stretch at which active fibres are content and d the number of
fibres through a unit area, 1 where the belly is widest: fibres run from end to end, so where it narrows each area bears
more. At the slack length a fully active fibre bears `PEAK` shear moduli (Blemker, Pinsky & Delp 2005). Tendon is a
spring that this tension stretches by ``tendon_strain``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.model.inside.loops import Fibres
from rbfmuscle.model.inside.solid import Interior
from rbfmuscle.sim.contraction.resolve import resolve_contraction
from rbfmuscle.sim.scene.objects import Muscle

PEAK = 30.0  # greatest isometric tension of active fibres, in shear moduli
WIDEST = 0.2  # share of the belly that counts as its widest part
DENSEST = 10.0  # fibres through a unit area, in those of the widest part: the rims of attachments draw more together
LEAST_STRAIN = 1e-3


class FibrePull:
    """Gives the solid's fibres the stiffness and the content length of an activation.

    Parameters
    ----------
    interior : Interior
        With fibres along their directions.
    muscle : Muscle
        With keys of contraction.
    passive : float
        Stiffness c of the passive fibres.

    Attributes
    ----------
    activation : float
    """

    def __init__(self, interior: Interior, muscle: Muscle, *, passive: float) -> None:
        self.interior, self.passive = interior, passive
        self.given: Any = resolve_contraction(muscle)
        vertices = np.asarray(muscle.mesh.vertices)
        self.tendon = self.given.tendon[cKDTree(vertices).query(interior.quad_points)[1]]
        self.density = fibre_density(interior, ~self.tendon)
        self.activation = np.nan
        self.activate(0.0)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next solve settles under."""
        if activation == self.activation:
            return
        self.activation, given, count = float(activation), self.given, len(self.tendon)
        slack, content = 1.0 / given.stretch_at_rest, given.shortening / given.stretch_at_rest
        active = self.density * self.activation * 0.5 * PEAK / max(slack - content, 0.05)
        passive = np.full(count, float(self.passive))
        strain = max(given.tendon_strain, LEAST_STRAIN)
        passive[self.tendon] = self.density[self.tendon] * 0.5 * PEAK / strain
        active[self.tendon] = 0.0
        lower, upper = np.full((2, count), [[min(1.0, slack)], [max(1.0, slack)]])
        lower[self.tendon] = upper[self.tendon] = 1.0
        self.interior.take_fibres(
            Fibres(self.interior.fibres.direction, passive, active, lower, upper, np.full(count, content))
        )


def fibre_density(interior: Interior, belly: Any) -> Floats:
    """Fibres through a unit area at the quadrature points (Q,), 1 where the belly is widest.

    They run as a flux without sources from one end to the other, spread evenly over both.
    """
    flux = interior.flux()
    size = np.linalg.norm(flux, axis=1)
    order = np.argsort(size[belly])
    weight = np.cumsum(interior.weights[belly][order])
    widest = size[belly][order][np.searchsorted(weight, 0.5 * WIDEST * weight[-1])]
    return np.minimum(size / max(float(widest), 1e-300), DENSEST)
