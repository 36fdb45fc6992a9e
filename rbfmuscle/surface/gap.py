"""How far a point is from a muscle, asked of its field at rest.

A point x of the world is at the material coordinates X with phi(X) = x, which Newton steps find.
The field at rest is F(X), and to first order the gap is F / |g| with
g = grad_x F = A^-T grad F(X),  A = d phi / d X.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats

# Newton steps, at most; a step below this share of the reach is the last, as it squares the error.
STEPS = 12
SETTLED = 1e-7

Deformation = Callable[[Floats], tuple[Floats, Floats]]
"""Of material coordinates (n, 3): places in the world (n, 3), and derivatives (n, 3, 3) of these,
place by coordinate."""
RestField = Callable[[Floats], tuple[Floats, Floats]]
"""Of material coordinates (n, 3): values (n,), negative inside, and gradients (n, 3)."""


class Gap(NamedTuple):
    """Of n points of the world."""

    gap: Floats  # (n,) to first order [scene unit], negative inside; NaN where the map is folded
    normal: Floats  # (n, 3) unit, in which it grows
    place: Floats  # (n, 3) material coordinates


def find_gap(
    points: Floats, start: Floats, deformation: Deformation, field: RestField, *, reach: float
) -> Gap:
    """Gap, normal and material coordinates of points (n, 3) of the world.

    Parameters
    ----------
    points : (n, 3) ndarray
    start : (n, 3) ndarray
        Material coordinates to start from: the last ones, or those of the nearest vertex.
    deformation : Deformation
    field : RestField
        At rest.
    reach : float
        Longest step in material coordinates [scene unit], for instance a cell.
    """
    place = start.copy()
    todo = np.arange(len(points))
    slopes = np.empty((len(points), 3, 3))
    folded = np.zeros(len(points), dtype=np.bool_)
    for _ in range(STEPS):
        there, slopes[todo] = deformation(place[todo])
        folded[todo] = np.linalg.det(slopes[todo]) <= 0.0
        todo, there = todo[~folded[todo]], there[~folded[todo]]
        step = np.linalg.solve(slopes[todo], (points[todo] - there)[:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, reach / np.maximum(length, np.finfo(float).tiny))[:, None]
        place[todo] += step
        todo = todo[length > SETTLED * reach]
        if len(todo) == 0:
            break
    value, gradient = field(place)
    sound = ~folded
    sound[todo] = False
    gap, normal = np.full(len(points), np.nan), np.zeros((len(points), 3))
    turned = np.swapaxes(slopes[sound], 1, 2)
    normal[sound] = np.linalg.solve(turned, gradient[sound][:, :, None])[:, :, 0]
    length = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    normal /= length[:, None]
    gap[sound] = value[sound] / length[sound]
    return Gap(gap, normal, place)


def trim(gap: Gap, own: Floats, *, most: float) -> Floats:
    """Displacements (n, 3) that bring vertices of a surface which lie in a neighbour onto the zero
    set of the difference of both fields, to first order: there both surfaces touch.

    Parameters
    ----------
    gap : Gap
        Of the neighbour, at the vertices.
    own : (n,) ndarray
        Gap of the vertices to their own muscle's field, 0 on its surface.
    most : float
        Longest displacement [scene unit].
    """
    way = np.zeros(len(own))
    inside = gap.gap < 0.0
    way[inside] = np.clip(0.5 * (own - gap.gap)[inside], -most, most)
    return way[:, None] * gap.normal
