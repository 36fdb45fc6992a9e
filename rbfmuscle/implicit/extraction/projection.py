"""Vertices of an extracted mesh moved onto the surface itself, and with its level to a wanted
volume.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.mesh_distance import ClipDistance, Field
from rbfmuscle.geometry.point_grid import Obstacles, push_off
from rbfmuscle.geometry.surfaces import volume_cubic


class Projector:
    """Vertices (n, 3) on their way to the zero set of max(f - level, -d).

    ``near_cut`` (n,) marks those that may lie on or come to the cut; ``spacing`` is the length of
    cells. ``slope`` (n,) is 1 / |grad f|, 0 for vertices that stay when the level changes.
    """

    def __init__(
        self,
        field: Field,
        clip_distance: ClipDistance | None,
        vertices: Floats,
        spacing: float,
        near_cut: Booleans,
    ) -> None:
        self.vertices, self.spacing = vertices, spacing
        self._field = field
        self._clip_distance = clip_distance
        self._near_cut = near_cut
        self.slope = np.zeros(len(vertices))
        self._direction = np.zeros_like(vertices)

    def project(self, level: float, *, rounds: int = 6) -> None:
        """Newton steps until they are shorter than 1e-4 of a cell."""
        todo = np.arange(len(self.vertices))
        on_field = np.ones(len(self.vertices), dtype=bool)
        for _ in range(rounds):
            f, gradient = self._field.value_and_gradient(self.vertices[todo])
            square = np.maximum(np.einsum("nd,nd->n", gradient, gradient), 2.3e-308)
            self.slope[todo] = 1.0 / np.sqrt(square)
            self._direction[todo] = gradient / square[:, None]
            step = (level - f)[:, None] * self._direction[todo]
            if self._clip_distance is not None:
                self._turn_to_cut(todo, (f - level) * self.slope[todo], step, on_field)
            length = np.sqrt(np.einsum("nd,nd->n", step, step))
            share = np.minimum(1.0, self.spacing / np.maximum(length, 1e-300))
            self.vertices[todo] += share[:, None] * step
            # Newton squares the error: what moved by less than 1 % of a cell is there.
            todo = todo[length > 1e-2 * self.spacing]
            if len(todo) == 0:
                break
        self._hold(~on_field)

    def _turn_to_cut(
        self, todo: Integers, height: Floats, step: Floats, on_field: Booleans
    ) -> None:
        """Replace the steps of vertices that lie on the cut; marks which lie on the field's own
        surface.
        """
        rows = np.flatnonzero(self._near_cut[todo])
        if self._clip_distance is None or len(rows) == 0:
            return
        where = self.vertices[todo[rows]]
        distance, outward = self._clip_distance.value_and_gradient_below(where, -height[rows])
        on_cut = height[rows] < -distance
        on_field[todo[rows]] = ~on_cut
        step[rows[on_cut]] = _way_out(distance[on_cut], outward[on_cut])

    def _hold(self, rows: Integers | Booleans) -> None:
        """Let vertices stay where they are when the level changes."""
        self._direction[rows] = 0.0
        self.slope[rows] = 0.0

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

    def push_off(self, faces: Integers, obstacles: Obstacles) -> None:
        """Move vertices around points that came through faces (m, 3), which leave the level."""
        for _ in range(2):
            moved = np.zeros(len(self.vertices), dtype=np.bool_)
            for grid, pose in obstacles:
                push_off(self.vertices, faces, grid, pose, self.spacing, moved)
            rows = np.flatnonzero(moved)
            self._hold(rows)
            if self._clip_distance is None or len(rows) == 0:
                break
            # What was pushed off one bone vertex must not end in the bone beside it.
            where = self.vertices[rows]
            distance, outward = self._clip_distance.value_and_gradient_below(
                where, np.zeros(len(rows))
            )
            inside = distance < 0.0
            self.vertices[rows[inside]] += _way_out(distance[inside], outward[inside])

    def shift(self, step: float) -> None:
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices = self.vertices + step * self._direction


def _way_out(distance: Floats, outward: Floats) -> Floats:
    """Newton steps (k, 3) onto the cut from its distances (k,) and gradients (k, 3)."""
    size = np.maximum(np.einsum("ij,ij->i", outward, outward), np.finfo(float).tiny)
    return -(distance / size)[:, None] * outward
