"""Where a muscle will settle: its prediction, moved on as settling moved it in its last step."""

from __future__ import annotations

from collections.abc import Mapping

from rbfmuscle.geometry.arrays import Floats


def way_between(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """How coordinates change from one place to another."""
    return {name: value - before.get(name, 0.0) for name, value in after.items()}


class MotionExtrapolator:
    """How far settling takes a muscle from where its bones took it, known from its last step.

    Bones' motions, blended, leave a muscle a millimetre or two in a sub-step from where it settles. Neighbours that see
    each other's predictions are pushed and pulled by these errors, more in every sub-step.

    Attributes
    ----------
    way : dict of str to float
        How the coordinates changed in that step [radian, translations in scene unit]. Where both kinds move the larger
        numbers decide the share: a translation in millimetres, as a rule.
    parts : list of (n, 3) ndarray
        How far points were moved by settling, for each array of them; empty before the first step.
    """

    def __init__(self) -> None:
        self.way: dict[str, float] = {}
        self.parts: list[Floats] = []

    def learn(self, way: Mapping[str, float], before: list[Floats], after: list[Floats]) -> None:
        """Take over a step: arrays of points as predicted, and as settled."""
        self.way = dict(way)
        self.parts = [settled - predicted for predicted, settled in zip(before, after)]

    def share(self, way: Mapping[str, float]) -> float:
        """How much of it a step asks for: 1 where it goes on like the last one, 0 across or back."""
        square = sum(value**2 for value in self.way.values())
        if square == 0.0:
            return 0.0
        along = sum(value * self.way.get(name, 0.0) for name, value in way.items())
        return min(max(along / square, 0.0), 1.0)

    def ahead(self, parts: list[Floats], way: Mapping[str, float]) -> list[Floats]:
        """Arrays of predicted points, moved on to where a step will settle them."""
        share = self.share(way) if self.parts else 0.0
        return [part + share * moved for part, moved in zip(parts, self.parts)] if share else parts
