"""Contact of a mesh muscle that is kept sound: held ends give way too, faces meet the vertices of bones."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbd_baseline.contact import ContactConstraint, clear_loop, depth_loop, push_in_turn
from pbd_baseline.self_collision.ridges import NOTHING, Ridges
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals

# Rounds in which held vertices are taken out of the bones that their own bone drives them into, and the depth, as a
# share of the reach, that ends them.
ROUNDS, OUTSIDE = 8, 1e-4


class SoundContact(ContactConstraint):
    """Contact of all vertices, held ones included, of the faces between them, and of the far side of what is squeezed.

    A vertex that faces away from a bone keeps ``skin`` from it, one that faces it comes as near as it likes: a muscle
    that is pressed flat on a bone keeps its two sides apart.

    Parameters
    ----------
    columns, shares, reach, response
        As for `ContactConstraint`.
    faces : (m, 3) ndarray of int
    held, holder : (h,) ndarray of int
        Vertices that a bone holds, and its number.
    skin : float
        [scene unit]
    ridges : Ridges
    """

    def __init__(
        self,
        columns: Integers,
        shares: Floats,
        *,
        faces: Integers,
        held: Integers,
        attached_bone: Integers,
        skin: float,
        ridges: Ridges,
        **options: Any,
    ) -> None:
        super().__init__(columns, shares, **options)
        self.faces, self.held, self.attached_bone = faces, held, attached_bone
        self.skin, self.ridges = skin, ridges
        self._before = NOTHING
        self._foot = np.zeros((0, 3))
        self._of_held: tuple[Any, Any] | None = None

    def find(self, contacts: Any, points: Floats, *, reach: Any = None) -> Any:
        """Ask the contacts where the vertices (n, 3) are now; return the greatest depth."""
        super().find(contacts, points, reach=reach)
        outward = vertex_normals(points, self.faces)[self.columns[self.index, 0]]
        away = np.einsum("cd,cd->c", outward, self.normal)
        # Bones alone: planes of sliding neighbours that keep near would pull through them.
        self.gap = self.gap - np.where(self.source >= 0, self.skin * np.maximum(0.0, away), 0.0)
        self._take_held(self._held_in(contacts, points), points)
        self._before = self.ridges.find(contacts, points, self._near(len(points)))
        columns, shares, normal, depth = self._before
        self._foot = np.einsum("ck,ckd->cd", shares, points[columns]) + depth[:, None] * normal
        return max(0.0, -float(self.gap.min(initial=0.0)), float(depth.max(initial=0.0)))

    def overlap(self, contacts: Any, points: Floats) -> float:
        """How deep held vertices are in bones, or vertices of bones behind faces, whatever the skin [scene unit]."""
        self.find(contacts, points)
        held = self._held_in(contacts, points).gap
        return max(0.0, -float(held.min(initial=0.0)), float(self._before[3].max(initial=0.0)))

    def free_held(self, contacts: Any, points: Floats) -> None:
        """Take held vertices out of bones, in place, as far as there is a way out."""
        for _ in range(ROUNDS):
            found = self._held_in(contacts, points)
            if len(found) == 0 or -found.gap.min() < OUTSIDE * self.reach:
                break
            np.add.at(points, self.held[found.index], -found.gap[:, None] * found.normal)

    def depth(self, points: Floats) -> Any:
        """Greatest depth of the points in the half-spaces found last, and of bone vertices behind faces."""
        columns, shares, normal, depth = self._before
        index, none = np.arange(len(columns)), np.zeros(len(columns))
        behind = depth_loop(points, columns, shares, index, none, normal, self._foot, np.empty(len(depth)))
        return max(super().depth(points), behind)

    def project(self, points: Floats) -> Any:
        """Push faces off the vertices of bones and vertices out of the half-spaces, in place."""
        columns, shares, normal, _ = self._before
        push_in_turn(points, columns, shares, normal, self._foot)
        return super().project(points)

    def clear_way(self, points: Floats, direction: Any, step: Any) -> Any:
        """Take out of ``step * direction``, in place, what would lead into a half-space; say if anything."""
        cleared = super().clear_way(points, direction, step)
        columns, shares, normal, _ = self._before
        if len(columns) == 0 or step == 0.0:
            return cleared
        planes = np.arange(len(columns)), np.zeros(len(columns)), normal, self._foot
        return clear_loop(points, columns, shares, planes, direction, step) or cleared

    def _held_in(self, contacts, points):
        """Half-spaces of held vertices that are inside a bone; index counts the held ones."""
        if self._of_held is None or self._of_held[0] is not contacts:
            mine = contacts.only(self.held)
            mine.contact_bone, mine.neighbours = None, []
            self._of_held = contacts, mine
        mine = self._of_held[1]
        mine.move(contacts.poses)
        return mine.half_spaces(points[self.held], 0.0)

    def _near(self, count):
        """Vertices near each bone (by its number), or held by it."""
        near = {}
        for b in {*self.source.tolist(), *self.attached_bone.tolist()}:
            near[b] = np.zeros(count, dtype=np.bool_)
            near[b][self.columns[self.index[self.source == b]].ravel()] = True
            near[b][self.held[self.attached_bone == b]] = True
        return near

    def _take_held(self, found, points):
        self.source = np.concatenate([self.source, found.source])
        index = self.held[found.index]
        self.index = np.concatenate([self.index, index])
        self.gap = np.concatenate([self.gap, found.gap])
        self.normal = np.concatenate([self.normal, found.normal])
        self.anchor = np.concatenate([self.anchor, points[index]])
