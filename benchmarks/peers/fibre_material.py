"""Transversely isotropic fibre with active stress, for `finite_element.HexSolid`.

The law is that of Blemker, Pinsky and Delp (Journal of Biomechanics 38, 2005), with the fibre's
stress along the stretch λ = |F a| itself:

    dW/dλ = peak (passive(x) + activation active(x)) / optimal,    x = λ / optimal,

    active(x)  = 9 (x - 0.4)² for 0.4 <= x < 0.6,  1 - 4 (1 - x)² for 0.6 <= x < 1.4,  9 (x - 1.6)²
    to 1.6, else 0, passive(x) = 0.05 (exp(6.6 (x - 1)) - 1) for 1 < x < 1.4, straight beyond,

and for tendon dW/dλ = stiffness (λ - 1) where stretched. ``density`` is the number of fibres
through a unit area, in units of that where the peak stress holds: where fibres converge it rises,
and with it what they pull.
"""

from dataclasses import dataclass

import numpy as np

_P1 = 0.05
_P2 = 6.6
_STRAIGHT = 1.4


@dataclass(frozen=True)
class FibreMaterial:
    """Fibres of the bricks of a solid.

    Attributes
    ----------
    direction : (m, 3) ndarray
        Unit directions at rest.
    tendon : (m,) ndarray of bool
    density : (m,) ndarray
    peak : float
        Greatest active stress [shear modulus of the solid].
    stiffness : float
        Of the tendon, along [the same].
    optimal : float
        Stretch, against rest, at which fibres pull most.
    """

    direction: np.ndarray
    tendon: np.ndarray
    density: np.ndarray
    peak: float = 30.0
    stiffness: float = 300.0
    optimal: float = 1.0

    def evaluate(self, stretch, activation):
        """Energy and its first two derivatives by the stretch (m, q), each (m, q)."""
        x = stretch / self.optimal
        active, passive = active_curve(x), passive_curve(x)
        scale = self.peak * self.density[:, None]
        energy = scale * (passive[0] + activation * active[0])
        slope = scale * (passive[1] + activation * active[1]) / self.optimal
        bend = scale * (passive[2] + activation * active[2]) / self.optimal**2
        taut = np.maximum(stretch - 1.0, 0.0)
        pull = self.stiffness * self.density[:, None]
        tendon = self.tendon[:, None]
        return (
            np.where(tendon, 0.5 * pull * taut**2, energy),
            np.where(tendon, pull * taut, slope),
            np.where(tendon, pull * (taut > 0.0), bend),
        )


@dataclass(frozen=True)
class PassiveFibres:
    """Fibres that make a solid stiffer along them, alike in tension and compression: W = stiffness
    (λ - 1)².

    For small strains Young's modulus along them is 3 μ + 2 stiffness, in an incompressible ground
    of shear modulus μ.

    Attributes
    ----------
    direction : (m, 3) ndarray
        Unit directions at rest.
    stiffness : float
        [shear modulus of the solid].
    """

    direction: np.ndarray
    stiffness: float

    @classmethod
    def of_ratio(cls, direction, ratio):
        """Fibres along which Young's modulus is ``ratio`` times that across."""
        return cls(direction, 1.5 * (ratio - 1.0))

    def evaluate(self, stretch, activation):
        """Energy and its first two derivatives by the stretch (m, q), each (m, q)."""
        twice = 2.0 * self.stiffness
        away = stretch - 1.0
        return self.stiffness * away**2, twice * away, np.full_like(stretch, twice)


def active_curve(x):
    """Integral from 0, value and slope of the active curve at x (stretch over the optimal one)."""
    low, high = (x >= 0.4) & (x < 0.6), (x > 1.4) & (x <= 1.6)
    middle = (x >= 0.6) & (x <= 1.4)
    rise = 3.0 * 0.2**3
    top = rise + 0.8 - (8.0 / 3.0) * 0.4**3
    integral = np.select(
        [low, middle, high, x > 1.6],
        [
            3.0 * (x - 0.4) ** 3,
            rise + (x - 0.6) - (4.0 / 3.0) * ((x - 1.0) ** 3 + 0.4**3),
            top + 3.0 * ((x - 1.6) ** 3 + 0.2**3),
            top + 3.0 * 0.2**3,
        ],
        0.0,
    )
    value = np.select(
        [low, middle, high], [9 * (x - 0.4) ** 2, 1 - 4 * (1 - x) ** 2, 9 * (x - 1.6) ** 2], 0.0
    )
    slope = np.select([low, middle, high], [18 * (x - 0.4), 8 * (1 - x), 18 * (x - 1.6)], 0.0)
    return integral, value, slope


def passive_curve(x):
    """Integral from 1, value and slope of the passive curve at x."""
    grown = np.exp(_P2 * (np.clip(x, 1.0, _STRAIGHT) - 1.0))
    beyond = np.maximum(x - _STRAIGHT, 0.0)
    value = _P1 * (grown - 1.0)
    slope = np.where(x > 1.0, _P1 * _P2 * grown, 0.0)
    integral = _P1 * ((grown - 1.0) / _P2 - (np.clip(x, 1.0, _STRAIGHT) - 1.0))
    return integral + beyond * value + 0.5 * slope * beyond**2, value + slope * beyond, slope


def free_stretch(peak, activation=1.0, *, optimal=1.0):
    """Stretch at which fibres and an incompressible neo-Hookean ground balance under no load.

    The closed form of a free bar: dW/dλ + λ - 1 / λ² = 0, in units of the shear modulus.
    """
    from scipy.optimize import brentq

    one = np.ones(1)
    material = FibreMaterial(
        np.eye(3)[:1], np.zeros(1, dtype=bool), one, peak=peak, optimal=optimal
    )

    def pull(stretch):
        slope = material.evaluate(np.array([[stretch]]), activation)[1][0, 0]
        return slope + stretch - stretch**-2

    return brentq(pull, 0.3, 1.5)
