"""What pictures of a run may colour its muscles by: themselves, their activation, the stretch of their fibres."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.show.appearance import muscle_colours
from rbfmuscle.validation import UsageError

COLOURINGS = ("muscle", "activation", "stretch")
PAINT_COLOURS = "viridis"
CHIPS = 5
# Stretch of 1 is the middle of its colours; they end so far from it where no fibre goes farther.
LEAST_SPAN = 0.05
# Segments of fibres that a point takes its stretch from. Over a few: one fibre's edge beside another's would be a
# pattern of the fibres, not of the muscle.
NEAREST = 4

Paint = Callable[[SavedRun, str, int, Floats], Floats]


def check_colouring(saved: SavedRun, colour: str) -> None:
    """Raise UsageError where a run has not what its muscles shall be coloured by."""
    if colour not in COLOURINGS:
        raise UsageError(f"unknown colouring {colour!r}; known: {', '.join(COLOURINGS)}")
    if colour == "activation" and not activations(saved):
        raise UsageError(f"{saved.directory} has no activation: none of its muscles contracts")
    if colour == "stretch" and not saved.has_fibres():
        raise UsageError(f"{saved.directory} has no fibres: set output.fibres = true in the run's scene")


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
    if colour == "stretch":
        away = [
            np.abs(saved.fibres(m, frame)[1]["stretch"] - 1.0).max()
            for m in saved.muscles
            for frame in frames
        ]
        span = max(LEAST_SPAN, *away)
        texts = [f"stretch {1.0 + span * place:.2f}" for place in np.linspace(-1, 1, CHIPS)]
        return _Stretch(span), scale_chips(texts)
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


def local_stretch(saved: SavedRun, muscle: str, frame: int) -> Floats:
    """Stretch (count, segments) along each fibre of a run, against its first frame."""
    ends = [
        np.linalg.norm(np.diff(saved.fibres(muscle, f)[0], axis=1), axis=2) for f in (saved.frames[0], frame)
    ]
    return ends[1] / ends[0]


def near_segments(saved: SavedRun, muscle: str, frame: int, vertices: Floats) -> tuple[Integers, Floats]:
    """Segments of fibres (n, k) near each of some points (n, 3) of a muscle, by their place, and their shares."""
    points = saved.fibres(muscle, frame)[0]
    middles = (0.5 * (points[:, 1:] + points[:, :-1])).reshape(-1, 3)
    from scipy.spatial import cKDTree

    away, nearest = cKDTree(middles).query(vertices, k=[*range(1, min(NEAREST, len(middles)) + 1)])
    weight = 1.0 / np.maximum(away, 1e-9)
    return nearest, weight / weight.sum(axis=1, keepdims=True)


class _Stretch:
    """Each point by the stretch of the nearest segment of a fibre."""

    def __init__(self, span: float) -> None:
        self.span = span

    def __call__(self, saved: SavedRun, muscle: str, frame: int, vertices: Floats) -> Floats:
        nearest, shares = near_segments(saved, muscle, frame, vertices)
        mean = (local_stretch(saved, muscle, frame).ravel()[nearest] * shares).sum(axis=1)
        return np.clip(0.5 + 0.5 * (mean - 1.0) / self.span, 0.0, 1.0)
