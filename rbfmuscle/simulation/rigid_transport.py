"""Rigid motion of a muscle whose bones do not move against each other.

Such a muscle keeps its shape and moves with its bones. The relative pose of the bones is compared with that of the last
solve. If another bone comes near, the muscle is solved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import RestFrame, diameter
from rbfmuscle.scene.motion import turned_angle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene


# Bones farther than this [mm] from a muscle do not act on it.
CLEAR = 2.0
# Rotations [radian] and displacements (relative to the muscle's size) below this are rounding errors.
STILL = 1e-9
# Displacement of an attachment, in sizes of its muscle, that counts as a rotation by one radian.
ARC = 0.5

SOLVED, CARRIED, SKIPPED = "solved", "carried", "skipped"


class MuscleStatus(NamedTuple):
    """How a muscle came to a frame.

    Attributes
    ----------
    state : {"solved", "carried", "skipped"}
        Carried: moved rigidly with its bones. Skipped: not moved.
    substeps : int
        Number of sub-steps in which it was solved.
    reason : str
        Why it was solved, or why it was not.
    """

    state: str
    substeps: int
    reason: str


class OwnBones:
    """Relative motion of the bones that hold one muscle.

    Parameters
    ----------
    muscle : Muscle
    scene : Scene

    Attributes
    ----------
    names : list of str
        Bones, and ends of tendons, that hold the muscle; the first holds most of it.
    """

    def __init__(self, muscle: Muscle, scene: Scene) -> None:
        vertices = np.asarray(muscle.mesh.vertices, dtype=float)
        frame, self.size = RestFrame(vertices), diameter(vertices)
        held: dict[str, list[np.ndarray]] = {}
        for attachment in muscle.attachments:
            held.setdefault(attachment.holder, []).append(attachment.vertices)
        parts = {name: np.concatenate(found) for name, found in held.items()}
        self.names = sorted(parts, key=lambda name: -len(parts[name]))
        self._corners = {name: frame.corners(parts[name]) for name in self.names}

    def apart(self, before: Mapping[str, Floats], after: Mapping[str, Floats]) -> tuple[float, str]:
        """Greatest motion of the bones relative to the first, between two sets of poses.

        Returns
        -------
        angle : float
            Greatest rotation [radian]; a displacement counts as an arc of half the muscle's size.
        bone : str
            The bone that moved so.
        """
        root, worst, which = self.names[0], 0.0, ""
        for name in self.names[1:]:
            angle = relative_motion(before, after, root, name, self._corners[name], self.size)
            if angle > worst:
                worst, which = angle, name
        return worst, which

    def carriage(self, before: Mapping[str, Floats], after: Mapping[str, Floats]) -> Floats:
        """The rigid motion (4, 4) of the first bone."""
        root = self.names[0]
        return after[root] @ np.linalg.inv(before[root])


def relative_motion(
    before: Mapping[str, Floats],
    after: Mapping[str, Floats],
    root: str,
    bone: str,
    corners: Floats,
    size: float,
) -> float:
    """Rotation of a bone [radian], or displacement of its attachment over half the size, against another bone."""
    old, new = (np.linalg.inv(poses[root]) @ poses[bone] for poses in (before, after))
    if np.array_equal(old, new):
        return 0.0
    turn = float(turned_angle(new[:3, :3] @ old[:3, :3].T))
    way = corners @ (new - old)[:3, :3].T + (new - old)[:3, 3]
    return max(turn, float(np.sqrt((way**2).sum(axis=1)).max()) / (ARC * size))


def why_never(muscle: Muscle, scene: Scene) -> str:
    """Why a muscle is always solved; empty where it may move rigidly."""
    if scene.sliding is not None:
        return "slides on neighbours"
    return "contracts" if muscle.contraction is not None else ""


class RigidTransport:
    """Moves one muscle rigidly where its bones do.

    Parameters
    ----------
    stepper : MuscleStepper
    scene : Scene
    """

    def __init__(self, stepper: Any, scene: Scene) -> None:
        muscle = next(muscle for muscle in scene.muscles if muscle.name == stepper.name)
        self.own, self.stepper = OwnBones(muscle, scene), stepper
        self.muscle, self.never = muscle, why_never(muscle, scene)
        self.clear = scene.length(CLEAR)
        contacts = stepper.contacts
        self.others = [b for b in contacts.reached if contacts.names[b] not in self.own.names]
        self.solved: Mapping[str, Floats] | None = None
        self.moved, self.reason = False, ""

    def try_carry(self, before: Mapping[str, Floats], after: Mapping[str, Floats]) -> bool:
        """Move the muscle rigidly from one set of poses to the next if it need not be solved; return whether it was."""
        if self.never:
            return False
        if self.solved is None:
            self.solved = before
        angle, bone = self.own.apart(self.solved, after)
        if angle > STILL:
            self.reason = f"{bone} against {self.own.names[0]}"
            return False
        near = [b for b in self.others if self._moves(b, before, after)]
        if self._touched(near):
            return False
        return self._carry(before, after, near)

    def _carry(self, before, after, near):
        """Move the muscle; undo it and return False where another bone is then near."""
        motion, model = self.own.carriage(before, after), self.stepper.model
        saved = model.snapshot() if near else None
        moves = np.abs(motion - np.eye(4)).max() > STILL
        if moves:
            model.transform(motion)
        self.stepper.contacts.move(after)
        if self._touched(near):
            model.restore(saved)
            self.stepper.contacts.move(before)
            return False
        if moves:
            self.stepper.carried(motion)
            self.moved = True
        return True

    def _touched(self, bones: Sequence[int]) -> bool:
        """Whether one of these bones is near the muscle now."""
        if not bones:
            return False
        contacts, points = self.stepper.contacts, self.stepper.model.contact_points()
        for b in bones:
            if contacts.comes_near(points, b, self.clear):
                self.reason = f"{contacts.names[b]} comes near"
                return True
        return False

    def _moves(self, b: int, before: Mapping[str, Floats], after: Mapping[str, Floats]) -> bool:
        name, corners = self.stepper.contacts.names[b], self.own._corners[self.own.names[0]]
        return relative_motion(before, after, name, self.own.names[0], corners, self.own.size) > STILL

    def collect(self, substeps: int) -> MuscleStatus:
        """The status since the last call."""
        moved, reason = self.moved, self.reason
        self.moved, self.reason = False, ""
        if substeps:
            return MuscleStatus(SOLVED, substeps, reason or self.never)
        if moved:
            names = self.own.names
            return MuscleStatus(
                CARRIED, 0, f"moves with {names[0]}" if len(names) == 1 else f"{', '.join(names)} as one"
            )
        return MuscleStatus(SKIPPED, 0, "its bones rest")
