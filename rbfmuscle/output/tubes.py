"""Tendons as closed tubes that taper from the end of a muscle's belly."""

from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.tubes import tube_mesh
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.tendons import TendonLine

# Length over which a tube tapers, in radii of the belly's end.
TAPER = 2.5
# No taper is longer than this share of the tendon.
LONGEST_TAPER = 0.6


def tendon_name(muscle: str) -> str:
    """Name of the mesh of a muscle's tendons in files and viewers."""
    return f"{muscle}_tendon"


def tendon_mesh(muscle: Muscle, tendons: Mapping[str, TendonLine]) -> tuple[Floats, Integers] | None:
    """Vertices (n, 3) and outward faces (m, 3) of all tendons of a muscle; None where it has none.

    ``tendons`` are by end, as a frame holds them. The faces are the same in all frames.
    """
    tubes = [_tube(tendons[end.name]) for end in muscle.tendons if end.name in tendons]
    if not tubes:
        return None
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in tubes[:-1])])
    return np.concatenate([v for v, _ in tubes]), np.concatenate([f + n for (_, f), n in zip(tubes, starts)])


def _tube(tendon: TendonLine) -> tuple[Floats, Integers]:
    """One tendon, tapering from the belly's end on."""
    line, (wide, thin) = tendon.points, tendon.radii
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    share = np.clip(along / max(min(TAPER * wide, LONGEST_TAPER * along[-1]), 1e-300), 0.0, 1.0)
    radii = wide + (thin - wide) * share**2 * (3.0 - 2.0 * share)
    return tube_mesh(line, radii)
