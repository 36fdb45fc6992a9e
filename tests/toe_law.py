"""Energies by which slack fibres and the material along them begin to resist lengthening."""

import numpy as np

from rbfmuscle.solid.kernels import TOE


def toe_energy(t):
    """Energy e of a stretch t beyond 1: the integral of 3/2 y² / (TOE - y) over y to t - 1."""
    y = np.maximum(t - 1.0, 0.0)
    return -1.5 * (y**2 / 2 + TOE * y + TOE**2 * np.log1p(-y / TOE))


def spring_energy(x):
    """Energy of a spring of unit stiffness at an extension x: the integral of x² / (x + TOE)."""
    return x**2 / 2 - TOE * x + TOE**2 * np.log1p(x / TOE)
