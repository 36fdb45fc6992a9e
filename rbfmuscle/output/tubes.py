"""Tendons as closed tubes that taper from the end of a muscle's belly."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.tendons import TendonLine

# Vertices around a tube, and the length over which it tapers, in radii of the belly's end.
SIDES, TAPER = 12, 2.5
# No taper is longer than this share of the tendon.
LONGEST_TAPER = 0.6


def tendon_name(muscle: str) -> str:
    """Name of the mesh of a muscle's tendons in files and viewers."""
    return f"{muscle}_tendon"


def tendon_mesh(muscle: Muscle, tendons: Mapping[str, TendonLine]) -> tuple[Floats, Integers] | None:
    """Vertices (n, 3) and outward faces (m, 3) of all tendons of a muscle; None where it has none.

    Parameters
    ----------
    muscle : Muscle
    tendons : mapping of str to TendonLine
        By end, as a frame holds them. The faces are the same in all frames.
    """
    tubes = [_tube(tendons[end.name]) for end in muscle.tendons if end.name in tendons]
    if not tubes:
        return None
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in tubes[:-1])])
    return np.concatenate([v for v, _ in tubes]), np.concatenate([f + n for (_, f), n in zip(tubes, starts)])


def _tube(tendon: TendonLine) -> tuple[Floats, Integers]:
    """One tendon: rings about its points, closed by a vertex at either end."""
    line, (wide, thin) = tendon.points, tendon.radii
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    share = np.clip(along / max(min(TAPER * wide, LONGEST_TAPER * along[-1]), 1e-300), 0.0, 1.0)
    radii = wide + (thin - wide) * share**2 * (3.0 - 2.0 * share)
    first, second = _frames(line)
    angles = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
    spokes = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    rings = line[:, None] + radii[:, None, None] * spokes
    return np.concatenate([rings.reshape(-1, 3), line[[0, -1]]]), _tube_faces(len(line))


def _frames(line: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (n, 3) across a line that turn with it as little as they can, and those across both."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-300)
    across = np.empty_like(line)
    before = np.eye(3)[np.argmin(np.abs(ahead[0]))]
    for k, direction in enumerate(ahead):
        before = before - (before @ direction) * direction
        before = across[k] = before / max(float(np.linalg.norm(before)), 1e-300)
    return across, np.cross(ahead, across)


def _tube_faces(rings: int) -> Integers:
    """Outward faces of so many rings, then of the fans at both ends."""
    side = np.arange(SIDES)
    after = np.roll(side, -1)
    base = SIDES * np.arange(rings - 1)[:, None]
    a, b, c, d = (base + k for k in (side, after, SIDES + side, SIDES + after))
    wall = np.concatenate([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(-1, 3)
    last, tips = SIDES * (rings - 1), SIDES * rings
    fans = [
        np.stack([np.full(SIDES, tips), after, side], axis=-1),
        np.stack([np.full(SIDES, tips + 1), last + side, last + after], axis=-1),
    ]
    return np.concatenate([wall, *fans])
