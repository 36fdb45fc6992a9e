"""Rigid motion of a muscle whose bones do not move against each other.

Such a muscle keeps its shape and moves with its bones. The relative pose of the bones is compared
with that of the last solve. If another bone comes near, the muscle is solved.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import RestFrame, diameter
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import MuscleModel
from rbfmuscle.simulation.substeps import StepLimits, step_excess

# Bones farther than this [mm] from a muscle do not act on it.
CLEAR = 2.0
# Rotations [radian] and displacements (relative to the muscle's size) below this are rounding
# errors.
STILL = 1e-9
# Displacement of an attachment, in sizes of its muscle, that counts as a rotation by one radian.
ARC = 0.5
IDENTITY = np.eye(4)


class MuscleStatus(NamedTuple):
    """How a muscle came to a frame."""

    state: str  # solved, carried (moved rigidly with its bones) or skipped (not moved)
    substeps: int  # number in which it was solved


class RigidState(NamedTuple):
    """What changes of a `RigidTransport`; nothing in it is changed in place."""

    # (b, 4, 4) poses of what holds the muscle when it was solved last, None where it never was
    solved: Floats | None
    since: Floats  # (4, 4) the rigid motion since its surface was drawn last
    moved: bool  # whether it was moved since the last frame


NEVER_SOLVED = RigidState(None, IDENTITY, False)


class RigidTransport:
    """Moves one muscle rigidly where its bones do; for a muscle that neither slides on neighbours
    nor contracts.

    ``names`` holds the b bones, and ends of tendons, that hold it, first that of most of it;
    ``state`` is its own snapshot.
    """

    def __init__(self, muscle: Muscle, scene: Scene) -> None:
        vertices = np.asarray(muscle.mesh.vertices, dtype=float)
        frame = RestFrame(vertices)
        size = diameter(vertices)
        self.clear = from_mm(CLEAR, scene.units)
        held: dict[str, list[np.ndarray]] = {}
        for attachment in muscle.attachments:
            held.setdefault(attachment.attachment_frame, []).append(attachment.vertices)
        parts = {name: np.concatenate(found) for name, found in held.items()}
        self.names = sorted(parts, key=lambda name: -len(parts[name]))
        corners = np.array([frame.corners(parts[name]) for name in self.names])
        count = len(self.names)
        # All that holds it, as seen from the first, and the first as seen from another bone.
        self._apart = _at_rest(np.arange(1, count), corners[1:], ARC * size, count)
        self._whole = _at_rest(np.array([1]), corners[:1], ARC * size, 2)
        self.state = NEVER_SOLVED

    def try_carry(
        self,
        model: MuscleModel,
        contacts: BoneContacts,
        before: Mapping[str, Floats],
        after: Mapping[str, Floats],
    ) -> bool:
        """Move the muscle rigidly from one set of poses to the next if it need not be solved;
        return whether it was. Where it was not, it is taken to be solved there.
        """
        new, known = self._stacked(after), self.state
        old = self._stacked(before) if known.solved is None else known.solved
        self.state = known._replace(solved=new)
        if not self._stand_alike(old, new):
            return False
        # No other bone may come near.
        near = [
            row
            for row, name in enumerate(contacts.bones.names)
            if name not in self.names and self._comes(before, after, name)
        ]
        if self._touches(model, contacts, near):
            return False
        root = self.names[0]
        motion = after[root] @ np.linalg.inv(before[root])
        moves, saved = np.abs(motion - IDENTITY).max() > STILL, model.snapshot() if near else None
        if moves:
            model.transform(motion)
        contacts.move(after)
        if self._touches(model, contacts, near):
            model.restore(saved)
            contacts.move(before)
            return False
        since = motion @ known.since if moves else known.since
        self.state = RigidState(old, since, moves or known.moved)
        return True

    def _touches(self, model: MuscleModel, contacts: BoneContacts, bones: list[int]) -> bool:
        """Whether one of these bones in reach is near the muscle now."""
        if not bones:
            return False
        near = contacts.half_spaces(model.contact_points(), self.clear)
        return bool(np.isin(near.source, bones).any())

    def _stacked(self, poses: Mapping[str, Floats]) -> Floats:
        """Poses (b, 4, 4) of what holds the muscle."""
        return np.array([poses[name] for name in self.names])

    def _stand_alike(self, old: Floats, new: Floats) -> bool:
        """Whether no bone of two poses (b, 4, 4) rotates, and no attachment moves, as seen from the
        first.
        """
        return not step_excess(old, new, self._apart)[0] > STILL

    def _comes(self, before: Mapping[str, Floats], after: Mapping[str, Floats], name: str) -> bool:
        """Whether the muscle, which keeps its shape, moves as seen from another bone."""
        old, new = (np.array([poses[name], poses[self.names[0]]]) for poses in (before, after))
        return bool(step_excess(old, new, self._whole)[0] > STILL)


def _at_rest(owner: Integers, corners: Floats, lever: float, bones: int) -> StepLimits:
    """What counts as a motion by one: a rotation by a radian, or one by a lever of attachments,
    with boxes (a, 8, 3), on some of so many bones, ends of tendons among them.
    """
    travel, is_end = np.full(len(owner), lever), np.zeros(bones, dtype=np.bool_)
    return StepLimits(0, owner, corners, travel, 1.0, is_end, 1)
