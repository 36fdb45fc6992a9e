"""A saved run as muscles and bones over time, which exports turn into files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.appearance import BONE_COLOUR, TENDON_COLOUR, muscle_colours, rgb
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.scene.objects import MM_PER_UNIT

# Frames a second of a motion that has no times of its own: frame k of the run is frame k of the animation.
FRAMES_A_SECOND = 24.0


@dataclass(frozen=True)
class MovingMuscle:
    """The surface of a muscle, or of its tendons.

    Vertices (n, 3) and faces (m, 3) are those of each frame, with the same array of faces where it stays.

    ``colour`` (3,) is red, green and blue, 0 to 1, as screens show them.
    """

    name: str
    colour: Floats
    vertices: list[Floats]
    faces: list[Integers]

    @property
    def keeps_vertices(self) -> bool:
        """Whether all frames have the same triangles of the same vertices."""
        return all(faces is self.faces[0] for faces in self.faces)

    def mesh(self, k: int) -> tuple[Floats, Integers]:
        """Vertices and faces in the k-th frame."""
        return self.vertices[k], self.faces[k]


@dataclass(frozen=True)
class MovingBone:
    """A rigid bone: vertices (n, 3) and faces (m, 3) at rest, and poses (T, 4, 4) from there to the world."""

    name: str
    colour: Floats
    vertices: Floats
    faces: Integers
    poses: Floats

    @property
    def moves(self) -> bool:
        """Whether it is ever anywhere else than in the first frame."""
        return bool(np.ptp(self.poses, axis=0).max() > 0.0)

    def mesh(self, k: int) -> tuple[Floats, Integers]:
        """Vertices and faces in the k-th frame."""
        return self.vertices @ self.poses[k, :3, :3].T + self.poses[k, :3, 3], self.faces


@dataclass(frozen=True)
class MovingRun:
    """All muscles and bones of a run over time.

    Attributes
    ----------
    name : str
        Of the scene.
    unit : {"m", "cm", "mm"}
        Of all lengths here.
    times : (T,) ndarray
        Of the frames [s].
    timed : bool
        Whether these are the motion's own.
    body : (3, 3) ndarray
        Left, posterior and superior.
    """

    name: str
    unit: str
    times: Floats
    timed: bool
    muscles: list[MovingMuscle]
    bones: list[MovingBone]
    body: Floats


def read_moving(saved: SavedRun, frames: list[int], *, unit: str) -> MovingRun:
    """Some frames of a saved run at once, lengths in ``unit``."""
    factor = MM_PER_UNIT[saved.units] / MM_PER_UNIT[unit]
    colours = {**muscle_colours(saved.muscles), **dict.fromkeys(saved.tendons, TENDON_COLOUR)}
    muscles = [_read_muscle(saved, name, frames, factor, rgb(colour)) for name, colour in colours.items()]
    bones = []
    for name in saved.bones:
        vertices, faces = saved.bone(name)
        poses = np.array([saved.poses[frame][name] for frame in frames])
        poses[:, :3, 3] *= factor
        bones.append(MovingBone(name, rgb(BONE_COLOUR), vertices * factor, faces, poses))
    times = saved.times or {frame: frame / FRAMES_A_SECOND for frame in frames}
    name = str(saved.info["scene"].get("name") or Path(saved.directory).name)
    at = np.array([times[frame] for frame in frames], dtype=float)
    return MovingRun(name, unit, at, bool(saved.times), muscles, bones, saved.body)


def _read_muscle(saved, name, frames, factor, colour):
    vertices, faces = [], []
    for frame in frames:
        points, triangles = saved.surface(name, frame)
        same = faces and np.array_equal(faces[0], triangles)
        vertices.append(points * factor)
        faces.append(faces[0] if same else triangles)
    return MovingMuscle(name, colour, vertices, faces)
