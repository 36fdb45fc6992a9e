"""How muscles are coloured, and what the colours mean."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import edge_lengths, unique_edges
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.metrics.penetration import BoneProbe, surface_depth
from rbfmuscle.viewer.sources import Picture


class Colouring(NamedTuple):
    """A quantity's title, the limits of its scale (of lengths in mm), and its colour map."""

    title: str
    low: float
    high: float
    colours: str
    length: bool = False


COLOURINGS = {
    "group": None,
    "activation": Colouring("Activation", 0.0, 1.0, "viridis"),
    "stretch": Colouring("Stretch of the edges", -0.5, 0.5, "coolwarm"),
    "penetration": Colouring("Depth in a bone", 0.0, 2.0, "inferno", length=True),
    "distance": Colouring("Distance to the other model", 0.0, 5.0, "viridis", length=True),
}


class Look(NamedTuple):
    """What of a picture is shown, and how: colouring, hidden muscles and bones, axis and place [scene unit] of a cut.

    Nothing is shown beyond the cut; ``others`` are choices that ask for a new picture too.
    """

    colour: str
    hidden: frozenset[str]
    cut: tuple[int, float] | None
    others: tuple[str, ...]


def vertex_values(
    colouring: str, name: str, picture: Picture, rest: Picture, probes: list[BoneProbe], other: Picture | None
) -> Floats:
    """One number for each vertex of a muscle, NaN where it is not known; ``other`` is the model beside it."""
    vertices, faces = picture.surfaces[name]
    if colouring == "activation":
        return np.full(len(vertices), picture.activation.get(name, np.nan))
    if colouring == "stretch" and np.array_equal(faces, rest.surfaces[name][1]):
        return _stretch(vertices, *rest.surfaces[name])
    if colouring == "penetration":
        return surface_depth(vertices, probes, picture.poses)
    if colouring == "distance" and other is not None:
        return MeshDistance(*other.surfaces[name]).unsigned(vertices)
    return np.full(len(vertices), np.nan)


def _stretch(now: Floats, rest: Floats, faces: Integers) -> Floats:
    """Mean change of length of the edges about each vertex, relative to rest."""
    edges = unique_edges(faces)
    change = edge_lengths(now, edges) / edge_lengths(rest, edges) - 1.0
    total, count = (np.bincount(edges.T.ravel(), x, len(now)) for x in (np.tile(change, 2), None))
    return total / np.maximum(count, 1)


def shades(colouring: Colouring, values: Floats, millimetre: float) -> Floats:
    """Colours (n, 3) from 0 to 1 of values (n,); grey for NaN."""
    from matplotlib import colormaps

    low, high = _limits(colouring, millimetre)
    return colormaps[colouring.colours].with_extremes(bad="#b3b3b3")((values - low) / (high - low))[:, :3]


def legend(colouring: Colouring, units: str, millimetre: float) -> str:
    """The scale of a colouring as HTML."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    low, high = _limits(colouring, millimetre)
    stops = ",".join(to_hex(colormaps[colouring.colours](share)) for share in np.linspace(0, 1, 9))
    ends = "".join(f"<span>{value:.3g}</span>" for value in (low, (low + high) / 2, high))
    return (
        f"<b>{colouring.title}{f' [{units}]' if colouring.length else ''}</b>"
        f"<div style='height:12px;background:linear-gradient(90deg,{stops})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ends}</div>"
    )


def _limits(colouring: Colouring, millimetre: float) -> Floats:
    return np.array([colouring.low, colouring.high]) * (millimetre if colouring.length else 1.0)
