"""Extrapolation of a muscle's solve: its prediction plus the correction of its last sub-step."""

from __future__ import annotations

from collections.abc import Mapping

from rbfmuscle.geometry.arrays import Floats


def coordinate_change(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Change of each coordinate."""
    return {name: value - before.get(name, 0.0) for name, value in after.items()}


class MotionExtrapolator:
    """Predicts where the solve will move a muscle, from its last sub-step.

    The blended motion of the bones leaves a muscle a millimetre or two from its equilibrium. Neighbours that react to
    the plain predictions accumulate these errors.

    Attributes
    ----------
    way : dict of str to float
        Change of the coordinates in that sub-step [radian, scene unit].
    parts : list of (n, 3) ndarray
        Correction of each array of points in that sub-step; empty before the first.
    """

    def __init__(self) -> None:
        self.way: dict[str, float] = {}
        self.parts: list[Floats] = []

    def learn(self, way: Mapping[str, float], before: list[Floats], after: list[Floats]) -> None:
        """Record a sub-step: arrays of points as predicted and as solved."""
        self.way = dict(way)
        self.parts = [settled - predicted for predicted, settled in zip(before, after)]

    def share(self, way: Mapping[str, float]) -> float:
        """Fraction of the last correction to apply: 1 for the same change of coordinates, 0 across or back."""
        square = sum(value**2 for value in self.way.values())
        if square == 0.0:
            return 0.0
        along = sum(value * self.way.get(name, 0.0) for name, value in way.items())
        return min(max(along / square, 0.0), 1.0)

    def ahead(self, parts: list[Floats], way: Mapping[str, float]) -> list[Floats]:
        """Arrays of predicted points plus the extrapolated correction."""
        share = self.share(way) if self.parts else 0.0
        return [part + share * moved for part, moved in zip(parts, self.parts)] if share else parts
