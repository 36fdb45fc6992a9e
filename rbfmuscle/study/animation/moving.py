"""A saved run as muscles and bones over time, which the writers of animations turn into files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.animation.values import VertexValues
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.show.appearance import BONE_COLOUR, muscle_colours

# Frames a second of a motion that has no times of its own: frame k of the run is frame k of the animation.
FRAMES_A_SECOND = 24.0


@dataclass(frozen=True)
class MovingMuscle:
    """The surface of a muscle in all frames.

    Attributes
    ----------
    name : str
    colour : (3,) ndarray
        Red, green and blue, 0 to 1, as screens show them.
    vertices : list of (n, 3) ndarray
        One of each frame [wanted unit].
    faces : list of (m, 3) ndarray of int
        One of each frame, all the same array where the surface keeps its vertices.
    values : dict of str to list of (n,) ndarray
        What is told of each vertex in each frame.
    """

    name: str
    colour: Floats
    vertices: list[Floats]
    faces: list[Integers]
    values: dict[str, list[Floats]]

    @property
    def keeps_vertices(self) -> bool:
        """Whether all frames have the same triangles of the same vertices."""
        return all(faces is self.faces[0] for faces in self.faces)


@dataclass(frozen=True)
class MovingBone:
    """A rigid bone and where it is in all frames.

    Attributes
    ----------
    name : str
    colour : (3,) ndarray
    vertices : (n, 3) ndarray
        At rest [wanted unit].
    faces : (m, 3) ndarray of int
    poses : (T, 4, 4) ndarray
        From rest to the world [wanted unit].
    """

    name: str
    colour: Floats
    vertices: Floats
    faces: Integers
    poses: Floats

    @property
    def moves(self) -> bool:
        """Whether it is ever anywhere else than in the first frame."""
        return bool(np.ptp(self.poses, axis=0).max() > 0.0)


@dataclass(frozen=True)
class MovingRun:
    """All muscles and bones of a run over time.

    Attributes
    ----------
    name : str
        Of the scene.
    unit : str
        ``"m"``, ``"cm"`` or ``"mm"``: of all lengths here.
    times : (T,) ndarray
        Of the frames [s].
    muscles : list of MovingMuscle
    bones : list of MovingBone
    up : {"z", "y"}
        The axis that points up.
    """

    name: str
    unit: str
    times: Floats
    muscles: list[MovingMuscle]
    bones: list[MovingBone]
    up: str


def read_moving(
    saved: SavedRun, frames: list[int], *, unit: str, up: str = "z", values: VertexValues | None = None
) -> MovingRun:
    """All frames of a saved run at once.

    Parameters
    ----------
    saved : SavedRun
    frames : list of int
        Frames to read.
    unit : {"m", "cm", "mm"}
        Of the lengths returned.
    up : {"z", "y"}
    values : VertexValues, optional
        What to tell of the vertices.

    Returns
    -------
    MovingRun
    """
    factor = MM_PER_UNIT[saved.units] / MM_PER_UNIT[unit]
    muscles = [_read_muscle(saved, name, frames, factor, values) for name in saved.muscles]
    bones = []
    for name in saved.bones:
        vertices, faces = saved.bone(name)
        poses = np.array([saved.poses[frame][name] for frame in frames])
        poses[:, :3, 3] *= factor
        bones.append(MovingBone(name, _rgb(BONE_COLOUR), vertices * factor, faces, poses))
    scene = saved.info["scene"]
    times = np.array([saved.times[frame] for frame in frames]) if saved.times else None
    if times is None:
        times = np.array(frames, dtype=float) / FRAMES_A_SECOND
    return MovingRun(str(scene.get("name") or Path(saved.directory).name), unit, times, muscles, bones, up)


def _read_muscle(saved, name, frames, factor, told):
    vertices, faces, values = [], [], {}
    for frame in frames:
        points, triangles = saved.surface(name, frame)
        if faces and faces[0].shape == triangles.shape and np.array_equal(faces[0], triangles):
            triangles = faces[0]
        vertices.append(points * factor)
        faces.append(triangles)
        for key, value in (told.of(name, frame, points, factor=factor) if told else {}).items():
            values.setdefault(key, []).append(value)
    return MovingMuscle(name, _rgb(muscle_colours(saved.muscles)[name]), vertices, faces, values)


def _rgb(colour):
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0


def linear_rgb(colour: Floats) -> Floats:
    """A colour (3,) as screens show it in the linear light that USD and glTF count in."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
