"""Rigid motion of a muscle whose bones do not move against each other.

Such a muscle keeps its shape and moves with its bones. The relative pose of the bones is compared
with that of the last solve. If another bone comes near, the muscle is solved.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import RestFrame, diameter
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import MuscleModel
from rbfmuscle.simulation.substeps import step_excess

# Bones farther than this [mm] from a muscle do not act on it.
CLEAR = 2.0
# Rotations [radian] and displacements (relative to the muscle's size) below this are rounding
# errors.
STILL = 1e-9
# Displacement of an attachment, in sizes of its muscle, that counts as a rotation by one radian.
ARC = 0.5
# Of a root and a bone the second has the attachment.
ATTACHED = np.array([1])
BONES = np.zeros(2, dtype=np.bool_)  # both count as bones, also the ends that tendons hold


class MuscleStatus(NamedTuple):
    """How a muscle came to a frame."""

    state: str  # solved, carried (moved rigidly with its bones) or skipped (not moved)
    substeps: int  # number in which it was solved


class RigidState(NamedTuple):
    """What changes of a `RigidTransport`."""

    solved: Mapping[str, Floats] | None
    since: Floats  # (4, 4)
    moved: bool


class RigidTransport:
    """Moves one muscle rigidly where its bones do; for a muscle that neither slides on neighbours
    nor contracts.

    ``names`` holds the bones, and ends of tendons, that hold it, first that of most of it;
    ``solved`` their poses when it was solved last, or None; ``since`` the rigid motion (4, 4) since
    its surface was drawn last.
    """

    def __init__(self, muscle: Muscle, scene: Scene) -> None:
        vertices = np.asarray(muscle.mesh.vertices, dtype=float)
        frame = RestFrame(vertices)
        self.size = diameter(vertices)
        self.clear = scene.length(CLEAR)
        held: dict[str, list[np.ndarray]] = {}
        for attachment in muscle.attachments:
            held.setdefault(attachment.attachment_frame, []).append(attachment.vertices)
        parts = {name: np.concatenate(found) for name, found in held.items()}
        self.names = sorted(parts, key=lambda name: -len(parts[name]))
        self._corners = {name: frame.corners(parts[name]) for name in self.names}
        self.solved: Mapping[str, Floats] | None = None
        self.since, self.moved = np.eye(4), False

    def keeps_shape(self, after: Mapping[str, Floats]) -> bool:
        """Whether the bones that hold the muscle stand to each other as when it was solved last."""
        before, root = self.solved or after, self.names[0]
        return not any(self._moves(before, after, root, name) for name in self.names[1:])

    def try_carry(
        self,
        model: MuscleModel,
        contacts: BoneContacts,
        before: dict[str, Floats],
        after: dict[str, Floats],
    ) -> bool:
        """Move the muscle rigidly from one set of poses to the next if it need not be solved;
        return whether it was.
        """
        self.solved, root = self.solved or before, self.names[0]
        if not self.keeps_shape(after):
            return False
        others = [b for b in contacts.reached if contacts.names[b] not in self.names]
        near = [b for b in others if self._moves(before, after, contacts.names[b], root)]
        if self._touches(model, contacts, near):
            return False
        motion = after[root] @ np.linalg.inv(before[root])
        moves, saved = np.abs(motion - np.eye(4)).max() > STILL, model.snapshot() if near else None
        if moves:
            model.transform(motion)
        contacts.move(after)
        if self._touches(model, contacts, near):
            model.restore(saved)
            contacts.move(before)
            return False
        if moves:
            self.since, self.moved = motion @ self.since, True
        return True

    def snapshot(self) -> RigidState:
        """The state, for :meth:`restore`."""
        return RigidState(self.solved, self.since, self.moved)

    def restore(self, state: RigidState) -> None:
        """Return to a snapshot."""
        self.solved, self.since, self.moved = state

    def collect(self) -> bool:
        """Whether the muscle was moved since the last call."""
        moved, self.moved = self.moved, False
        return moved

    def _touches(self, model: MuscleModel, contacts: BoneContacts, bones: list[int]) -> bool:
        """Whether one of these bones is near the muscle now."""
        if not bones:
            return False
        return bool(
            np.isin(contacts.half_spaces(model.contact_points(), self.clear).source, bones).any()
        )

    def _moves(
        self, before: Mapping[str, Floats], after: Mapping[str, Floats], root: str, name: str
    ) -> bool:
        """Whether a bone that holds the muscle rotates, or its attachment moves, as seen from
        another bone.
        """
        old, new = np.array([before[root], before[name]]), np.array([after[root], after[name]])
        corners, lever = self._corners[name][None], np.array([ARC * self.size])
        moved = step_excess(old, new, 0, ATTACHED, corners, lever, 1.0, BONES, len(BONES))
        return bool(moved.max() > STILL)
