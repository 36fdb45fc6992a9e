"""Values as colours: activation of muscles, distances of surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.output.colours import rgb
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.validation import UsageError

COLOURINGS = ("muscle", "activation")
# Viridis, which people who are colour-blind can read and which prints in grey.
_SCALE = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")


def scale_colours(values: Floats) -> Floats:
    """Colours (n, 3) of values (n,) from 0 to 1."""
    table = np.array([rgb(colour) for colour in _SCALE])
    places = np.linspace(0.0, 1.0, len(table))
    return np.stack([np.interp(values, places, column) for column in table.T], axis=1)


def scale_chips(texts: Sequence[str]) -> dict[str, str]:
    """Texts for the five colours along the scale, from its one end to the other."""
    return dict(zip(texts, _SCALE, strict=True))


def check_colouring(saved: SavedRun, colour: str) -> None:
    """Raise UsageError where a run has not what its muscles shall be coloured by."""
    if colour not in COLOURINGS:
        raise UsageError(f"unknown colouring {colour!r}; known: {', '.join(COLOURINGS)}")
    if colour == "activation" and not activations(saved):
        raise UsageError(f"{saved.directory} has no activation: none of its muscles contracts")


def activations(saved: SavedRun) -> dict[tuple[str, int], float]:
    """Activation of each muscle that contracts, by muscle and frame."""
    return {(row.muscle, row.frame): row.value for row in saved.metrics if row.quantity == "activation"}
