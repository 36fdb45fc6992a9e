"""A saved run as muscles and bones over time, which exports turn into files."""

from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.appearance import BONE_COLOUR, TENDON_COLOUR, motion_direction
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.scene.objects import MM_PER_UNIT

# Frames a second of a motion that has no times of its own: frame k of the run is frame k of the animation.
FRAMES_A_SECOND = 24.0


@dataclass(frozen=True)
class MovingPart:
    """The surface of a muscle or of its tendons in each frame, or a rigid bone.

    Vertices (n, 3) and faces (m, 3) are those of each frame, with the same array of faces where it stays; of a bone
    there is one of each, at rest, and poses (T, 4, 4) from there to the world. ``colour`` is "#rrggbb"; muscles of one
    ``group`` cross the same joints.
    """

    name: str
    colour: str
    vertices: list[Floats]
    faces: list[Integers]
    poses: Floats | None = None
    group: str = ""

    @property
    def keeps_vertices(self) -> bool:
        """Whether all frames have the same triangles of the same vertices."""
        return all(faces is self.faces[0] for faces in self.faces)

    @property
    def moves(self) -> bool:
        """Whether it is a bone that is ever anywhere else than in the first frame."""
        return self.poses is not None and bool(np.ptp(self.poses, axis=0).max() > 0.0)

    def mesh(self, k: int) -> tuple[Floats, Integers]:
        """Vertices and faces in the k-th frame."""
        if self.poses is None:
            return self.vertices[k], self.faces[k]
        return self.vertices[0] @ self.poses[k, :3, :3].T + self.poses[k, :3, 3], self.faces[0]


@dataclass(frozen=True)
class MovingRun:
    """All muscles and bones of a run over time; ``name`` is the scene's, all lengths are in ``unit``: m, cm or mm.

    ``times`` (T,) of the frames [s] are the motion's own where ``timed``, ``captions`` those of the frames. ``body``
    (3, 3) is left, posterior and superior; the motion is seen in its plane from ``direction`` (3,) along these.
    """

    name: str
    unit: str
    times: Floats
    timed: bool
    captions: list[str]
    muscles: list[MovingPart]
    bones: list[MovingPart]
    body: Floats
    direction: Floats


def read_moving(saved: SavedRun, frames: list[int], *, unit: str) -> MovingRun:
    """Some frames of a saved run at once, lengths in ``unit``."""
    factor = MM_PER_UNIT[saved.units] / MM_PER_UNIT[unit]
    groups = saved.groups | dict.fromkeys(saved.tendons, "tendons")
    colours = saved.colours | dict.fromkeys(saved.tendons, TENDON_COLOUR)
    muscles = [MovingPart(name, colour, [], [], group=groups[name]) for name, colour in colours.items()]
    bones = []
    for muscle in muscles:
        for frame in frames:
            points, faces = saved.surface(muscle.name, frame)
            same = muscle.faces and np.array_equal(muscle.faces[0], faces)
            muscle.vertices.append(points * factor)
            muscle.faces.append(muscle.faces[0] if same else faces)
    for name in saved.bones:
        vertices, faces = saved.bone(name)
        poses = np.array([saved.poses[frame][name] for frame in frames])
        poses[:, :3, 3] *= factor
        bones.append(MovingPart(name, BONE_COLOUR, [vertices * factor], [faces], poses))
    times = saved.info["scene"].get("motion", {}).get("times")
    name = str(saved.info["scene"].get("name") or saved.directory.name)
    at = np.array(
        [frame / FRAMES_A_SECOND if times is None else times[frame] for frame in frames], dtype=float
    )
    captions = [saved.caption(frame) for frame in frames]
    direction = motion_direction([saved.poses[frame] for frame in frames], saved.body)
    return MovingRun(name, unit, at, times is not None, captions, muscles, bones, saved.body, direction)
