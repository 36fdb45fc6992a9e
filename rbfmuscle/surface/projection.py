"""The field of a muscle that moved, its local fits made anew where its centres are now, and
vertices brought onto its level set.

With F the field that a vertex blends, r its level offset, d the distance to the bones and l the
level that gives the muscle its volume at rest, each vertex is brought onto the zero set of

    max(F(x) - r - l, -d(x))

by Newton steps from where the material carries it. A step on the field is
x += (l + r - F) g / max(|g|, g_0)^2,  g = grad F,  with g_0 a share of |g| at rest, so that what
falls on a fold of the field does not leap; a change dl of the level moves the vertex by dl g /
|g|^2. On a bone it is  x -= d grad d.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import longest, volume_rate
from rbfmuscle.implicit.evaluation import Blend, Terms, evaluate_blend, weigh
from rbfmuscle.implicit.field import FieldFit, RBFField
from rbfmuscle.loops import loop
from rbfmuscle.surface.sheet import Sheet, Shown, ShownBones

# Fits of less weight than this at a vertex are left out there.
LEAST_WEIGHT = 2e-2


class MovingField:
    """The field through centres that move.

    Points of the material keep the weights of the local fits that they have at rest (`weights`):
    a fit to another part of the muscle that has come near has no part in their field.

    Parameters
    ----------
    fit : FieldFit
    parts : (P, n) ndarray of int
        Centres of each local fit.
    centres, normals : (K, 3) ndarray
        At rest.

    Attributes
    ----------
    condition : float
        Of the worst matrix of the last fit, infinite where there is none.
    """

    def __init__(self, fit: FieldFit, parts: Integers, centres: Floats, normals: Floats) -> None:
        self._fit, self._parts = fit, parts
        self._terms: Terms | None = None
        self.condition = np.inf
        self.move(centres, normals)

    def through(self, centres: Floats, normals: Floats) -> RBFField:
        """The field through centres (K, 3) with unit normals (K, 3); ValueError or LinAlgError
        where there is none.
        """
        return self._fit.fit(centres, normals, self._parts)

    def move(self, centres: Floats, normals: Floats) -> None:
        """Fit anew through centres (K, 3) with unit normals (K, 3)."""
        self.condition = np.inf
        if not (np.isfinite(centres).all() and np.isfinite(normals).all()):
            return
        try:
            field = self.through(centres, normals)
        except (ValueError, np.linalg.LinAlgError):
            return
        self._terms, self.condition = field.terms, field.condition

    def weights(self, points: Floats) -> Blend:
        """Weights of the local fits at points (n, 3) of the material, where it is now."""
        assert self._terms is not None
        return weigh(points, self._terms).without(LEAST_WEIGHT, len(points))

    def __call__(
        self, points: Floats, weights: Blend, todo: Booleans | None = None
    ) -> tuple[Floats, Floats]:
        """Values (n,) and gradients (n, 3) at points (n, 3) with some weights; 0 where ``todo``
        (n,) leaves a point out.
        """
        assert self._terms is not None
        return evaluate_blend(points, self._terms, self._fit.kernel, weights, todo)


# Lengths below are in mean edges of the mesh at rest.
# No vertex goes farther from where the material carries it than FARTHEST times the square of the
# share that the field's slope there has of its slope at rest, 0 where that is UNSURE; but always
# by ALWAYS. Where sheets of a muscle meet, the slope sinks within few frames: by the share itself
# vertices of the leg's muscles jump by up to 0.85 mm in a squat, by its square 0.63.
FARTHEST = 0.5
UNSURE = 0.3
ALWAYS = 0.05
SURE = 0.7  # a share of the slope at rest, below which steps are shortened
SETTLED = 0.01  # a step of less is one whose error, of second order, does not count
# Newton steps, at most, once the level stands, and of the level. What has not settled by then lies
# where the field is folded, and is taken as it is: so a surface changes in time as the field does.
NEWTON, LEVELS = 4, 20


def reach_level(
    shown: Shown, field: MovingField, bones: ShownBones, sheet: Sheet, level: float
) -> float:
    """Bring a sheet from the carried material onto the level set that has the volume; the level, or
    NaN where there is none.
    """
    assert shown.weights is not None
    edge, todo = shown.edge, np.ones(len(shown.offset), dtype=np.bool_)
    allowed = np.full(len(todo), np.nan)
    for turn in range(LEVELS):
        value, gradient = field(sheet.vertices, shown.weights, todo)
        given = sheet.carried, value, gradient, shown.offset, shown.slope
        moved = sheet.vertices, sheet.direction, sheet.bounded, sheet.suspect
        if not _step_loop(*given, level, edge, allowed, todo, *moved):
            return np.nan
        if turn == 0:
            bones.find_near(sheet.vertices)
        todo[bones.lift(sheet)] = False
        volume, rate = volume_rate(sheet.vertices, shown.faces, sheet.direction)
        if not rate > 0.0:
            return np.nan
        fastest = longest(sheet.direction)
        most = edge / fastest
        change = min(max((shown.volume - volume) / rate, -most), most)
        level += change
        sheet.shift(change)
        if abs(change) * fastest > SETTLED * edge:
            todo[:] = True
        elif turn + 1 >= NEWTON or not todo.any():
            return level
    return np.nan


@loop
def trusted(slope, at_rest):
    """How far, in mean edges, a vertex may go from the material where the field has this slope and
    had another at rest.
    """
    share = slope / at_rest if at_rest > UNSURE else 0.0
    return max(FARTHEST * min(max((share - UNSURE) / (1.0 - UNSURE), 0.0), 1.0) ** 2, ALWAYS)


@loop
def _step_loop(
    carried,
    value,
    gradient,
    offset,
    slope,
    level,
    edge,
    allowed,
    todo,
    vertices,
    direction,
    bounded,
    suspect,
):
    """A Newton step of the vertices that ``todo`` (n,) marks, no farther from the material than
    ``allowed`` (n,), NaN before the first; those that have not settled stay marked.

    Returns whether the field is finite at all of them.
    """
    finite = True
    for v in range(len(todo)):
        if not todo[v]:
            continue
        square = 0.0
        for a in range(3):
            square += gradient[v, a] ** 2
        finite &= np.isfinite(value[v]) & np.isfinite(square)
        if np.isnan(allowed[v]):
            allowed[v] = edge * trusted(np.sqrt(square), slope[v])
        least = (SURE * slope[v]) ** 2
        suspect[v] |= square <= least
        square = max(square, least, 2.3e-308)
        miss = level + offset[v] - value[v]
        length = 0.0
        for a in range(3):
            direction[v, a] = gradient[v, a] / square
            length += (miss * direction[v, a]) ** 2
        length = np.sqrt(length)
        share = miss * edge / length if length > edge else miss
        away = 0.0
        for a in range(3):
            vertices[v, a] += share * direction[v, a]
            away += (vertices[v, a] - carried[v, a]) ** 2
        away = np.sqrt(away)
        bounded[v] = away > allowed[v]
        todo[v] = length > SETTLED * edge and not bounded[v]
        if bounded[v]:
            suspect[v] = True
            for a in range(3):
                way = vertices[v, a] - carried[v, a]
                vertices[v, a] = carried[v, a] + way * allowed[v] / away
                direction[v, a] = 0.0
    return finite
