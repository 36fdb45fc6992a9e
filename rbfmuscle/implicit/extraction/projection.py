"""Vertices of an extracted mesh moved onto the surface itself, and with its level to a wanted
volume.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import volume_cubic
from rbfmuscle.implicit.extraction.obstacles import (
    MARGIN,
    Obstacles,
    near_triangles,
    push_off_points,
)
from rbfmuscle.jit import compiled

# What is no deeper in the cut than this share of a cell counts as out of it.
OUT = 1e-5


class CutBounds:
    """Values (n,) of a cut, or lower bounds, at places (n, 3) where vertices were: bounds where
    those are now.
    """

    def __init__(self, places: Floats, values: Floats) -> None:
        self.places, self.values = places.copy(), values.copy()

    def below(self, vertices: Floats, rows: Integers | slice = slice(None)) -> Floats:
        """Lower bounds (k,) at vertices (k, 3), those numbered ``rows``."""
        away = vertices - self.places[rows]
        found: Floats = self.values[rows] - np.sqrt(np.einsum("nd,nd->n", away, away))
        return found


class Projector:
    """Vertices (n, 3) on their way to the zero set of max(f - level, -d).

    ``near_cut`` (n,) marks those that may lie on or come to the cut; ``spacing`` is the length of
    edges or cells.
    """

    def __init__(
        self,
        field: Field | None,
        cut: ClipDistance | None,
        vertices: Floats,
        spacing: float,
        near_cut: Booleans,
    ) -> None:
        self.vertices, self.spacing = vertices, spacing
        self._field = field
        self._cut = cut
        self._near_cut = near_cut
        # What is known before the first step: the field with its gradient, and the cut by values or
        # lower bounds.
        self.known: tuple[Floats, Floats] | None = None
        self.bounds: CutBounds | None = None
        # Distance (n,) from the cut at which vertices that fall into it end, and steepness (n,) of
        # the field below which steps are shortened, not lengthened by a gradient that fades.
        self.clearance, self.least, self.slope = np.zeros((3, len(vertices)))
        self.on_field = np.ones(len(vertices), dtype=bool)
        self._direction = np.zeros_like(vertices)

    def project(self, level: float, rows: Integers | None = None, *, rounds: int = 6) -> None:
        """Newton steps of all vertices, or those numbered ``rows``, until they are shorter than
        1e-4 of a cell.
        """
        if self._field is None:
            raise ValueError("there is no field to project onto")
        todo = np.arange(len(self.vertices)) if rows is None else rows
        on_field = np.ones(len(self.vertices), dtype=bool)
        for _ in range(rounds):
            x = self.vertices[todo]
            f, gradient = self._field.value_and_gradient(x) if self.known is None else self.known
            self.known = None
            step = np.empty_like(x)
            slope = np.empty(len(x))
            gradient = np.ascontiguousarray(gradient)
            _newton_loop(f, gradient, level, self.least[todo], todo, step, slope, self._direction)
            self.slope[todo] = slope
            if self._cut is not None:
                self._turn_to_cut(todo, (f - level) * slope, step, on_field)
            # Newton squares the error: what moved by less than 1 % of a cell is there.
            unsettled = np.empty(len(x), dtype=np.bool_)
            _step_loop(todo, step, self.spacing, self.vertices, unsettled)
            todo = todo[unsettled]
            if len(todo) == 0:
                break
        self.hold(~on_field)
        if rows is None:
            self.on_field = on_field

    def _turn_to_cut(
        self, todo: Integers, height: Floats, step: Floats, on_field: Booleans
    ) -> None:
        """Replace the steps of vertices that lie on the cut; marks which lie on the field's own
        surface.
        """
        rows = np.flatnonzero(self._near_cut[todo])
        found, distance, outward = self._ask_cut(
            todo[rows], self.clearance[todo[rows]] - height[rows]
        )
        rows = rows[found]
        distance = distance - self.clearance[todo[rows]]
        on_cut = height[rows] < -distance
        on_field[todo[rows]] = ~on_cut
        step[rows[on_cut]] = _way_out(distance[on_cut], outward[on_cut])

    def _ask_cut(self, rows: Integers, limit: Floats) -> tuple[Booleans, Floats, Floats]:
        """Which of some vertices may lie below their limit (k,), and the cut's distances and
        gradients there.
        """
        near = np.ones(len(rows), dtype=np.bool_)
        if self.bounds is not None:
            near = self.bounds.below(self.vertices[rows], rows) <= limit
        if self._cut is None or not near.any():
            return np.zeros(len(rows), dtype=np.bool_), np.zeros(0), np.zeros((0, 3))
        where = self.vertices[rows[near]]
        distance, outward = self._cut.value_and_gradient_below(where, limit[near])
        if self.bounds is not None:
            self.bounds.places[rows[near]], self.bounds.values[rows[near]] = where, distance
        return near, distance, outward

    def hold(self, rows: Integers | Booleans) -> None:
        """Let vertices stay where they are when the level changes."""
        self._direction[rows] = 0.0
        self.slope[rows] = 0.0

    def move_along(self, direction: Floats) -> None:
        """Let vertices move along given directions (n, 3) when the level changes."""
        self._direction[:] = direction
        self.slope[:] = np.linalg.norm(direction, axis=1)

    def lift(self, rows: Integers | None = None) -> int:
        """Move vertices, or those numbered ``rows``, that lie in the cut onto it, where they stay:
        how many.
        """
        moved = 0
        rows = np.flatnonzero(self._near_cut) if rows is None else rows[self._near_cut[rows]]
        for _ in range(2):
            rows = self._move_out(rows, self.clearance[rows], OUT * self.spacing)
            if len(rows) == 0:
                break
            moved = max(moved, len(rows))
            self.hold(rows)
        return moved

    def _move_out(self, rows: Integers, limit: Floats, slack: float) -> Integers:
        """Move those of some vertices that are nearer to the cut than a limit, by more than a
        slack, there: which.
        """
        near, distance, outward = self._ask_cut(rows, limit)
        distance = distance - limit[near]
        inside = distance < -slack
        rows = rows[near][inside]
        self.vertices[rows] += _way_out(distance[inside], outward[inside])
        return rows

    def volume_step(self, faces: Integers, target: float, steps: int = 1) -> float:
        """Change of level that brings the mesh to a volume, a cubic polynomial of the change, by
        Newton steps.
        """
        c0, c1, c2, c3 = volume_cubic(self.vertices, faces, self._direction)
        change = 0.0
        for _ in range(steps):
            lack = target - (c0 + change * (c1 + change * (c2 + change * c3)))
            if lack == 0.0:
                break
            rate = c1 + change * (2.0 * c2 + change * 3.0 * c3)
            if not rate > 0:
                raise ValueError(
                    f"no level gives a volume of {target:g}: the cut leaves no surface"
                )
            change += lack / rate
        return change

    def push_off(
        self, faces: Integers, obstacles: Obstacles, spacing: float, tolerance: float
    ) -> Booleans:
        """Move vertices around points that came through faces (m, 3); a mask (n,) of these, which
        leave the level.
        """
        pushed = np.zeros(len(self.vertices), dtype=np.bool_)
        near = near_triangles(obstacles, self.vertices, faces, MARGIN * spacing)
        for _ in range(2):
            rows = np.flatnonzero(push_off_points(self.vertices, faces, near, spacing, tolerance))
            pushed[rows] = True
            self.hold(rows)
            if self._cut is None or len(rows) == 0:
                break
            # What was pushed off one bone vertex must not end in the bone beside it.
            self._move_out(rows, np.zeros(len(rows)), 0.0)
        return pushed

    def shift(self, step: float) -> None:
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices = self.vertices + step * self._direction


def _way_out(distance: Floats, outward: Floats) -> Floats:
    """Newton steps (k, 3) onto the cut from its distances (k,) and gradients (k, 3)."""
    size = np.maximum(np.einsum("ij,ij->i", outward, outward), np.finfo(float).tiny)
    return -(distance / size)[:, None] * outward


@compiled(error_model="numpy")
def _newton_loop(f, gradient, level, least, rows, step, slope, direction):
    """Newton steps onto f = level, 1 / |g|, and the vertices' motions g / |g|^2 for a change of
    level.

    |g| counts as no less than ``least``: what falls on a fold of the field would else leap,
    elsewhere in each frame.
    """
    for n in range(len(rows)):
        square = gradient[n, 0] ** 2 + gradient[n, 1] ** 2 + gradient[n, 2] ** 2
        square = max(square, least[n] ** 2, 2.3e-308)
        slope[n] = 1.0 / np.sqrt(square)
        for a in range(3):
            direction[rows[n], a] = gradient[n, a] / square
            step[n, a] = (level - f[n]) * direction[rows[n], a]


@compiled(error_model="numpy")
def _step_loop(rows, step, spacing, vertices, unsettled):
    """Take the steps, none longer than a cell."""
    for n in range(len(rows)):
        length = np.sqrt(step[n, 0] ** 2 + step[n, 1] ** 2 + step[n, 2] ** 2)
        share = min(1.0, spacing / max(length, 1e-300))
        for a in range(3):
            vertices[rows[n], a] += share * step[n, a]
        unsettled[n] = length > 1e-2 * spacing
