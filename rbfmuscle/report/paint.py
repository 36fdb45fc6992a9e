"""What pictures of a run may colour its muscles by: themselves or their activation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import muscle_colours
from rbfmuscle.validation import UsageError

COLOURINGS = ("muscle", "activation")
PAINT_COLOURS = "viridis"
CHIPS = 5

Paint = Callable[[SavedRun, str, int, Floats], Floats]


def check_colouring(saved: SavedRun, colour: str) -> None:
    """Raise UsageError where a run has not what its muscles shall be coloured by."""
    if colour not in COLOURINGS:
        raise UsageError(f"unknown colouring {colour!r}; known: {', '.join(COLOURINGS)}")
    if colour == "activation" and not activations(saved):
        raise UsageError(f"{saved.directory} has no activation: none of its muscles contracts")


def painting(saved: SavedRun, colour: str, frames: list[int]) -> tuple[Paint | None, dict[str, Any]]:
    """Return what paints muscles, and what its colours mean.

    Parameters
    ----------
    saved : SavedRun
    colour : str
        Of `COLOURINGS`.
    frames : list of int
        Those that are drawn.

    Returns
    -------
    paint : callable or None
        ``paint(saved, muscle, frame, vertices)`` gives values (n,) from 0 to 1; None for plain colours.
    chips : dict of str to colour
        The legend.
    """
    if colour == "activation":
        return _Activation(saved), scale_chips(
            [f"activation {share:g}" for share in np.linspace(0, 1, CHIPS)]
        )
    return None, muscle_colours(saved.muscles)


def scale_chips(texts: list[str]) -> dict[str, Any]:
    """Texts along the scale of colours, from its one end to the other, each with its colour."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    shares = np.linspace(0, 1, len(texts))
    return {text: to_hex(colormaps[PAINT_COLOURS](share)) for text, share in zip(texts, shares)}


def activations(saved: SavedRun) -> dict[tuple[str, int], float]:
    """Activation of each muscle that contracts, by muscle and frame."""
    return {(row.muscle, row.frame): row.value for row in saved.metrics if row.quantity == "activation"}


class _Activation:
    """Each muscle by its activation, 0 where it does not contract."""

    def __init__(self, saved: SavedRun) -> None:
        self.known = activations(saved)

    def __call__(self, _saved: SavedRun, muscle: str, frame: int, vertices: Floats) -> Floats:
        return np.full(len(vertices), self.known.get((muscle, frame), 0.0))
