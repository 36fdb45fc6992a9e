"""Lines of points, closed tubes of varying radius about them, taut lines past obstacles, and the
directions of fibres that follow lines.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers, unit
from rbfmuscle.geometry.frames import dot, row_of
from rbfmuscle.loops import loop

# Vertices around a tube, where nothing else is asked for.
SIDES = 12
STEEPEST = 2.0  # greatest slope of a line against the chord of its ends
LEAST_BEND = 1e-9  # height of an obstacle above a chord, over its length, from which on it counts


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
    side = np.arange(sides)
    after = np.roll(side, -1)
    base = sides * np.arange(len(line) - 1)[:, None]
    a, b, c, d = (base + k for k in (side, after, sides + side, sides + after))
    wall = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]).reshape(-1, 3)
    last, tips = sides * (len(line) - 1), sides * len(line)
    fans = [
        np.stack([np.full(sides, tips), after, side], axis=-1),
        np.stack([np.full(sides, tips + 1), last + side, last + after], axis=-1),
    ]
    vertices = np.concatenate([rings.reshape(-1, 3), line[[0, -1]]])
    return vertices, np.concatenate([wall, *fans])


def _frames(line: Floats) -> tuple[Floats, Floats]:
    """Unit vectors (n, 3) across a line that turn with it as little as they can, and those across
    both.
    """
    ahead = unit(np.gradient(line, axis=0))
    across = np.empty_like(line)
    before = np.eye(3)[np.argmin(np.abs(ahead[0]))]
    for k, direction in enumerate(ahead):
        before = before - (before @ direction) * direction
        before = across[k] = unit(before)
    return across, np.cross(ahead, across)


def taut_line(
    start: Floats, end: Floats, side: Floats, bones: Sequence[tuple[Floats, Floats]], width: float
) -> Floats:
    """Points (n, 3) of the taut line between two points (3,) that passes bones on one side, a
    direction (3,).

    The line lies in the plane of its ends and ``side``. A point of a bone at a distance z from the
    plane is an obstacle in it, lower by z² / (2 ``width``), as for a round band. One that the line
    could only pass by leaving an end more steeply than `STEEPEST` is lowered below that slope by as
    much as it is above. So the line changes continuously where the plane comes to meet a bone, and
    parts of bones that lie far to the side do not count. ``bones`` are poses (4, 4) and points (n,
    3) at rest.
    """
    size = float(np.linalg.norm(end - start))
    along = (end - start) / max(size, 1e-300)
    up = unit(side - (side @ along) * along)
    axes = np.stack([along, up, np.cross(along, up)])
    profile = []
    for pose, points in bones:
        turn = axes @ pose[:3, :3]
        shift = axes @ (pose[:3, 3] - start)
        found = np.empty((len(points), 2))
        profile.append(found[: _profile_loop(points, turn, shift, size, max(width, 1e-300), found)])
    if not any(len(found) for found in profile):
        return np.stack([start, end])
    # All obstacles lie above the chord, which is the lower side of their hull with both ends.
    places = np.concatenate([[[0.0, 0.0], [size, 0.0]], *profile])
    hull = places[ConvexHull(places).vertices]
    return start + hull[np.argsort(hull[:, 0])] @ axes[:2]


@loop
def _profile_loop(points, turn, shift, size, width, found):
    """Fill ``found`` with points along and above a chord, counted as in `taut_line`; return how
    many there are.
    """
    count = 0
    for i in range(len(points)):
        point = row_of(points, i)
        x = dot(row_of(turn, 0), point) + shift[0]
        if x <= 0.0 or x >= size:
            continue
        y = dot(row_of(turn, 1), point) + shift[1]
        z = dot(row_of(turn, 2), point) + shift[2]
        y = min(y, 2.0 * STEEPEST * min(x, size - x) - y) - z * z / (2.0 * width)
        if y > LEAST_BEND * size:
            found[count, 0], found[count, 1] = x, y
            count += 1
    return count


# Pieces of polyline whose directions are averaged at one place.
NEAREST = 3
# Directions shorter than this share of the longest are rounding errors.
NO_DIRECTION = 1e-9


def fibre_directions(
    points: Floats,
    along: Floats,
    fibres: Sequence[Floats] | None,
    *,
    fallback: Floats | None = None,
) -> Floats:
    """Unit direction of the fibres at each point (n, 3).

    They follow the polylines (k, 3), or where there are none ``along`` (n, 3), the gradient of a
    function that grows from origin to insertion; where neither has a direction the ``fallback``
    (3,), zero without one.
    """
    if fibres:
        directions, share = nearest_pieces(points, fibres, NEAREST)
        against = (
            np.einsum("nkd,nd->nk", directions, directions[:, 0]) < 0.0
        )  # a fibre has no sense
        directions = np.where(against[:, :, None], -directions, directions)
        along = (directions * share[:, :, None]).sum(axis=1)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    weak = length <= NO_DIRECTION * length.max(initial=0.0)
    directions = np.divide(along, length, out=np.zeros_like(along), where=~weak)
    if fallback is not None:
        directions[weak[:, 0]] = fallback / np.linalg.norm(fallback)
    return directions


def nearest_pieces(points: Floats, fibres: Sequence[Floats], most: int) -> tuple[Floats, Floats]:
    """Unit directions (n, k, 3) of the nearest pieces of polylines to each point (n, 3), ``most``
    of them, and the inverse of their distances (n, k).
    """
    middles = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
    pieces = np.concatenate([np.diff(line, axis=0) for line in fibres])
    near = np.arange(1, min(most, len(middles)) + 1)
    distance, index = cKDTree(middles).query(points, k=near)
    return unit(pieces)[index], 1.0 / np.maximum(distance, 1e-9 * np.ptp(points, axis=0).max())
