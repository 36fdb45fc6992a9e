"""A saved run, read from its folder, and its muscles and bones over time, which exports turn into
files.
"""

import csv
import io
import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.output import appearance as look
from rbfmuscle.output.fibre_files import SavedFibres
from rbfmuscle.output.vtp import read_vtp
from rbfmuscle.scene.objects import MM_PER_UNIT, body_axes, check_name
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Event, FibreLines, Frame, ModelSurface
from rbfmuscle.validation import UsageError

# Coordinates that a caption names at most.
MOST_SHOWN = 4
# Frames a second of a motion that has no times of its own: frame k of the run is frame k of the
# animation.
FRAMES_A_SECOND = 24.0


class SavedRun:
    """A run in a folder, UsageError if it holds none; surfaces are read one by one.

    Of a run that was killed, or still goes on, the frames up to the last whole one are found on the
    disk. ``info`` is ``run.json``, ``frames`` are the numbers of those that were written.
    ``tendons`` are names of meshes, which `surface` takes as it takes muscles; ``groups`` and
    ``colours`` are the muscles'. ``body`` (3, 3) is left, posterior and superior; x, y and z where
    they are not known.
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        self._bones: dict[str, tuple[Floats, Integers]] = {}
        path = self.directory / "run.json"
        try:
            self.info = json.loads(path.read_text(encoding="utf-8"))
            _check_info(self.info)
            self.units = self.info["scene"]["units"]
            self.body = body_axes(
                *(self.info["scene"].get(word) for word in ("superior", "anterior"))
            )
            muscles, output = self.info["scene"]["muscles"], self.info["scene"]["output"]
            self.muscles = [muscle["name"] for muscle in muscles]
            self.bones = [bone["name"] for bone in self.info["scene"]["bones"]]
            self.groups = look.muscle_groups(self.info)
            self.colours = look.muscle_colours(self.muscles, self.groups)
            self._meshes = bool(output["surfaces"])
            held = [
                m["name"] for m in muscles if any("tendon" in end for end in m.get("attach", ()))
            ]
            self.tendons = [tendon_name(name) for name in held if output.get("tendons")]
            self.frames = [frame["frame"] for frame in self.info["frames"]]
        except OSError:
            message = f"{self.directory} holds no run (no run.json); give the folder of 'run -o'"
            raise UsageError(message) from None
        except (ValueError, KeyError, TypeError) as error:
            message = f"{path} is not the run.json of a run ({error!r}); run the scene again"
            raise UsageError(message) from None
        if self.info.get("status") == "running":
            self.info["frames"] = self._whole_frames()
            self.frames = [frame["frame"] for frame in self.info["frames"]]

    @cached_property
    def metrics(self) -> list[Row]:
        """Rows of ``metrics.csv``."""
        table = self._table("metrics.csv")
        return [Row(int(r[0]), r[1], float(r[2]), r[3], r[4], float(r[5]), r[6]) for r in table]

    @cached_property
    def events(self) -> list[Any]:
        """Rows of ``events.csv``: frame, muscle, bone, count, action."""
        return [(int(r[0]), r[1], r[2], int(r[3]), r[4]) for r in self._table("events.csv")]

    @cached_property
    def poses(self) -> dict[int, dict[str, Floats]]:
        """Dict of frame to dict of bone to (4, 4) ndarray."""
        found = {}
        for row in self._table("poses.csv"):
            found.setdefault(int(row[0]), {})[row[1]] = np.array(row[2:], dtype=float).reshape(4, 4)
        return found

    def surface(self, muscle: str, frame: int) -> tuple[Floats, Integers]:
        """Vertices and faces of a muscle in a frame."""
        self._check_surfaces()
        return read_vtp(self._surface_file(muscle, frame))

    def fibres(self, frame: int) -> SavedFibres:
        """Fibres of the muscles that have them, in a frame."""
        return SavedFibres(self.directory, self.muscles, frame)

    def bone(self, name: str) -> tuple[Floats, Integers]:
        """Vertices and faces of a bone at rest."""
        if name not in self._bones:
            self._check_surfaces()
            self._bones[name] = read_vtp(self.directory / "bones" / f"{name}.vtp")
        return self._bones[name]

    def series(
        self, muscle: str, quantity: str, coordinate: str | None = None
    ) -> tuple[Integers, Floats]:
        """Frames and values of a quantity of a muscle, of moment arms those of a coordinate, as two
        arrays.
        """
        found = [r for r in self._rows[muscle, quantity] if coordinate in (None, r.coordinate)]
        return np.array([r.frame for r in found]), np.array([r.value for r in found], dtype=float)

    @cached_property
    def _rows(self) -> dict[tuple[str, str], list[Row]]:
        """Rows of ``metrics.csv`` by muscle and quantity: of dozens of muscles there are tens of
        thousands.
        """
        found = defaultdict(list)
        for row in self.metrics:
            found[row.muscle, row.quantity].append(row)
        return found

    def moment_arm_coordinates(self, muscle: str | None = None) -> list[str]:
        """The coordinates that a muscle, or any, has moment arms about, in their order in
        ``metrics.csv``.
        """
        rows = (
            r for r in self.metrics if r.quantity == "moment_arm" and muscle in (None, r.muscle)
        )
        return list(dict.fromkeys(r.coordinate for r in rows))

    def caption(self, frame: int) -> str:
        """Frame number, time and coordinates of a frame, as text; of many coordinates those that
        move most.
        """
        rows, units = self.info["frames"], self.info["scene"].get("coordinate_units", {})
        entry = next(row for row in rows if row["frame"] == frame)
        values = entry["coordinates"]
        spans = {
            name: np.ptp([row["coordinates"].get(name, 0.0) for row in rows]) for name in values
        }
        most = sorted(values, key=lambda name: -spans[name])[:MOST_SHOWN]
        texts = [f"{n} {value:.4g}{units.get(n, '°')}" for n, value in values.items() if n in most]
        clock = [f"{entry['time']:.4g} s"] if "time" in entry else []
        return ", ".join([f"frame {frame}", *clock, *texts])

    def has_surfaces(self) -> bool:
        """Whether there is something to draw."""
        return self._meshes and bool(self.frames)

    def _whole_frames(self):
        """Entries of ``run.json`` for the frames of which every file is there."""
        planned, meshes = (
            self.info.get("planned", []),
            [*self.muscles, *self.tendons] if self._meshes else [],
        )
        return [
            {
                "frame": frame,
                "coordinates": planned[frame] if frame < len(planned) else {},
                "wall": None,
            }
            for frame, poses in self.poses.items()
            if set(poses) >= set(self.bones)
            and all(self._surface_file(m, frame).is_file() for m in meshes)
        ]

    def _surface_file(self, muscle, frame):
        return self.directory / "surfaces" / f"{muscle}_{frame:04d}.vtp"

    def _check_surfaces(self):
        if not self._meshes:
            raise UsageError(
                f"{self.directory} has no surfaces: the run's scene had output.surfaces = false"
            )

    def _table(self, name):
        path = self.directory / name
        if not path.is_file():
            return []
        text = path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]  # the last line of a run that was killed may be cut
        return list(csv.reader(io.StringIO(whole, newline="")))[1:]


def _check_info(info: Any) -> None:
    """Raise ValueError where names in ``run.json``, which become those of files, can be none of a
    run's.
    """
    scene = info["scene"]
    for what in ("muscle", "bone"):
        for item in scene[f"{what}s"]:
            check_name(item["name"], what)
    if scene["units"] not in MM_PER_UNIT:
        raise ValueError(f"units {scene['units']!r}")
    for frame in info["frames"]:
        if type(frame["frame"]) is not int or frame["frame"] < 0:
            raise ValueError(f"frame {frame['frame']!r}")


class _SavedSurfaces(Mapping[str, ModelSurface]):
    """Surfaces of the muscles in a frame, each read when it is asked for."""

    def __init__(self, saved: SavedRun, frame: int) -> None:
        self._saved, self._frame = saved, frame

    def __getitem__(self, muscle: str) -> ModelSurface:
        if muscle not in [*self]:
            raise KeyError(muscle)
        return ModelSurface(*self._saved.surface(muscle, self._frame))

    def __iter__(self) -> Iterator[str]:
        return iter(self._saved.muscles if self._saved.has_surfaces() else [])

    def __len__(self) -> int:
        return len(list(iter(self)))


def saved_frames(saved: SavedRun) -> list[Frame]:
    """The frames of a saved run, without what no file holds: material surfaces and times of single
    muscles.
    """
    units, found = saved.info["scene"].get("coordinate_units", {}), []
    for entry in saved.info["frames"]:
        index = entry["frame"]
        angles = {n: v if n in units else math.radians(v) for n, v in entry["coordinates"].items()}
        events = [Event(*row) for row in saved.events if row[0] == index]
        surfaces = _SavedSurfaces(saved, index)
        fibres = saved.fibres(index)
        poses = saved.poses[index]
        wall = entry["wall"]
        found.append(Frame(index, angles, poses, surfaces, {}, events, {}, wall, fibres=fibres))
    return found


@dataclass(frozen=True)
class MovingPart:
    """The surface of a muscle or of its tendons in each frame, or a rigid bone.

    Vertices (n, 3) and faces (m, 3) are those of each frame, with the same array of faces where it
    stays; of a bone there is one of each, at rest, and poses (T, 4, 4) from there to the world.
    ``colour`` is "#rrggbb"; muscles of one ``group`` cross the same joints.
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
class MovingFibres:
    """The fibres of a muscle in each frame, always as many lines of as many points."""

    name: str
    lines: list[FibreLines]

    @property
    def segments(self) -> Integers:
        """Numbers (s, 2) of the points that each piece of the lines joins, line by line."""
        count, points = self.lines[0].points.shape[:2]
        first = np.arange(count * points).reshape(count, points)
        return np.stack([first[:, :-1].ravel(), first[:, 1:].ravel()], axis=1)


@dataclass(frozen=True)
class MovingRun:
    """All muscles and bones of a run over time; ``name`` is the scene's, all lengths are in
    ``unit``: m, cm or mm. Fibres are those of the muscles that have them.

    ``times`` (T,) of the frames [s] are the motion's own where ``timed``, ``captions`` those of the
    frames. ``body`` (3, 3) is left, posterior and superior; the motion is seen in its plane from
    ``direction`` (3,) along these.
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
    fibres: list[MovingFibres] = field(default_factory=list)


def read_moving(saved: SavedRun, frames: list[int], *, unit: str) -> MovingRun:
    """Some frames of a saved run at once, lengths in ``unit``."""
    factor = MM_PER_UNIT[saved.units] / MM_PER_UNIT[unit]
    groups = saved.groups | dict.fromkeys(saved.tendons, "tendons")
    colours = saved.colours | dict.fromkeys(saved.tendons, look.TENDON_COLOUR)
    muscles = [
        MovingPart(name, colour, [], [], group=groups[name]) for name, colour in colours.items()
    ]
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
        bones.append(MovingPart(name, look.BONE_COLOUR, [vertices * factor], [faces], poses))
    times = saved.info["scene"].get("motion", {}).get("times")
    name = str(saved.info["scene"].get("name") or saved.directory.name)
    if times is not None and np.any(np.diff([times[k] for k in frames]) <= 0.0):
        times = None  # no animation: they stand still, or go backwards
    at = np.array([k / FRAMES_A_SECOND if times is None else times[k] for k in frames], dtype=float)
    captions = [saved.caption(frame) for frame in frames]
    direction = look.motion_direction([saved.poses[frame] for frame in frames], saved.body)
    return MovingRun(
        name,
        unit,
        at,
        times is not None,
        captions,
        muscles,
        bones,
        saved.body,
        direction,
        _moving_fibres(saved, frames, factor),
    )


def _moving_fibres(saved: SavedRun, frames: list[int], factor: float) -> list[MovingFibres]:
    """Fibres of the muscles that have them in all of some frames, lengths scaled."""
    found = []
    for name in saved.muscles:
        lines = [saved.fibres(frame).get(name) for frame in frames]
        known = [x._replace(points=factor * x.points) for x in lines if x is not None]
        if len(known) == len(frames):
            found.append(MovingFibres(look.fibres_name(name), known))
    return found
