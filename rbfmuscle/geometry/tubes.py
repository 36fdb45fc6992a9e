"""Lines of points, and closed tubes of varying radius about them."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.vectors import unit

# Vertices around a tube, where nothing else is asked for.
SIDES = 12


def distance_along(line: Floats) -> Floats:
    """Distance along a line (n, 3) from its first point to each (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def line_length(line: Floats) -> float:
    """Length of a line (n, 3)."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def points_along(line: Floats, places: Floats) -> Floats:
    """Points (k, 3) at distances (k,) along a line (n, 3) from its first point."""
    along = distance_along(line)
    return np.stack([np.interp(places, along, line[:, axis]) for axis in range(3)], axis=1)


def tube_mesh(line: Floats, radii: Floats, sides: int = SIDES) -> tuple[Floats, Integers]:
    """Rings of so many ``sides`` about the points (n, 3) of a line, closed by a vertex at either
    end; and outward faces (m, 3).

    Vertices are ring by ring, then both ends; neighbouring rings are turned as little as they can
    be.
    """
    first, second = _frames(line)
    angles = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    spokes = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    rings = line[:, None] + radii[:, None, None] * spokes
    return np.concatenate([rings.reshape(-1, 3), line[[0, -1]]]), _tube_faces(len(line), sides)


def _frames(line: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (n, 3) across a line that turn with it as little as they can, and those across
    both.
    """
    ahead = unit(np.gradient(line, axis=0))
    across = np.empty_like(line)
    before = np.eye(3)[np.argmin(np.abs(ahead[0]))]
    for k, direction in enumerate(ahead):
        before = before - (before @ direction) * direction
        before = across[k] = before / max(float(np.linalg.norm(before)), 1e-300)
    return across, np.cross(ahead, across)


def _tube_faces(rings: int, sides: int) -> Integers:
    """Outward faces of so many rings, then of the fans at both ends."""
    side = np.arange(sides)
    after = np.roll(side, -1)
    base = sides * np.arange(rings - 1)[:, None]
    a, b, c, d = (base + k for k in (side, after, sides + side, sides + after))
    wall = np.concatenate([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(
        -1, 3
    )
    last, tips = sides * (rings - 1), sides * rings
    fans = [
        np.stack([np.full(sides, tips), after, side], axis=-1),
        np.stack([np.full(sides, tips + 1), last + side, last + after], axis=-1),
    ]
    return np.concatenate([wall, *fans])
