"""The bones that hold muscles, with their joints, axes and sites."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfmuscle.anatomy.bones import Part
from rbfmuscle.importers.guess.anatomy import JointGuess
from rbfmuscle.importers.guess.frames import BoneFrame
from rbfmuscle.importers.guess.sites import Site, find_site
from rbfmuscle.scene.bone import Bone

CLEAR = 1.5  # via points and insertions lie so far out of bones [mm]


class Skeleton(NamedTuple):
    """What muscles are held by; ``bodies`` gives of bones that move as one the one that stands for
    all, ``frames`` and ``articular`` their axes and the points (n, 3) of their joints' surfaces;
    ``tendons`` are those that have meshes.
    """

    bones: dict[Part, Bone]
    bodies: dict[Part, Part]
    joints: list[JointGuess]
    millimetre: float
    frames: dict[Part, list[BoneFrame]]
    articular: dict[Part, np.ndarray]
    tendons: list[Part]

    def frame(self, bone: Part, points: np.ndarray) -> BoneFrame | None:
        """The frame of a bone that is nearest to some points (n, 3), of several."""
        here = points.mean(axis=0)
        frames = self.frames.get(bone, [])
        return min(frames, key=lambda f: np.linalg.norm(f.origin - here), default=None)

    def site(self, name: str, bone: Part, points: np.ndarray) -> Site | None:
        """A site on a bone, for a muscle of these points (n, 3); None without landmarks."""
        frame = self.frame(bone, points)
        return frame and find_site(name, bone, frame, self.articular[bone])

    def out_of_bone(self, point: np.ndarray, bone: Part) -> np.ndarray:
        """A place (3,) of a bone's surface, moved out of it by `CLEAR`."""
        nearest = np.argmin(((bone.faces[0] - point) ** 2).sum(axis=1))
        return point + CLEAR * self.millimetre * bone.faces[1][nearest]
