"""Colours of muscles and bones in exported files, pictures, plots and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats

BONE_COLOUR, TENDON_COLOUR = "#e9e0cd", "#cfd8dc"
# People who are colour-blind can distinguish them (P. Tol, "muted"); its sand is left out, as bones have that colour.
MUSCLE_COLOURS = ("#cc6677", "#332288", "#44aa99", "#882255", "#88ccee", "#117733", "#aa4499", "#999933")
# How much nearer to white or black the muscles of one group are, one after the other.
_SHADES = (0.0, 0.3, -0.25)


def muscle_colours(names: Sequence[str], groups: Mapping[str, str] | None = None) -> dict[str, str]:
    """Dict of muscle name to its colour in pictures and plots; of many muscles a hue for each group.

    Parameters
    ----------
    names : sequence of str
    groups : dict of str to str, optional
        Of each muscle.
    """
    if groups is None or len(names) <= len(MUSCLE_COLOURS):
        return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}
    kinds = list(dict.fromkeys(groups[name] for name in names))
    found, seen = {}, dict.fromkeys(kinds, 0)
    for name in names:
        kind = groups[name]
        hue = MUSCLE_COLOURS[kinds.index(kind) % len(MUSCLE_COLOURS)]
        found[name] = mixed_colour(hue, _SHADES[seen[kind] % len(_SHADES)])
        seen[kind] += 1
    return found


def mixed_colour(colour: str, share: float) -> str:
    """A colour brought nearer to white (share above 0) or to black (below)."""
    values = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    end = 255 if share > 0 else 0
    return "#" + "".join(f"{round(value + abs(share) * (end - value)):02x}" for value in values)


def rgb(colour: str) -> Floats:
    """Red, green and blue (3,) of a colour like "#cc6677", 0 to 1."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0


def linear_rgb(colour: Floats) -> Floats:
    """A colour (3,) as screens show it in the linear light that USD and glTF count in."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
