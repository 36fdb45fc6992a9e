"""A run as data, in memory or in a folder: its facts, frames, metrics and meshes. Of a run that was
killed, or still goes on, the whole frames are read.
"""

from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
import trimesh
from pydantic import ValidationError

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.rows import ARM_REACH, moment_arms
from rbfmuscle.metrics.summary import QuantityFacts, Summary
from rbfmuscle.run import appearance as look
from rbfmuscle.run.info import FORMAT, FrameInfo, RunInfo
from rbfmuscle.run.vtk_files import frame_file, read_fibres, read_vtp
from rbfmuscle.scene.joints import full_name
from rbfmuscle.scene.meshes.repair import InputOrder
from rbfmuscle.scene.objects import MM_PER_UNIT, body_axes, from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Event, FibreLines, Frame, Mesh, ModelSurface
from rbfmuscle.validation import BROKEN_FILE, SceneError, UsageError, did_you_mean

# Coordinates that a caption names at most.
MOST_SHOWN = 4


class SceneMeshes:
    """Meshes that the frames of a run in memory do not hold, made from its scene.

    `FolderMeshes` are those of a run in a folder. ``directory`` is the run's folder.
    """

    def __init__(self, scene: Scene) -> None:
        self.directory: Path | None = None
        self._bones = {bone.name: bone.mesh for bone in scene.bones}
        self._muscles = {muscle.name: muscle for muscle in scene.muscles}

    def bone(self, name: str) -> Mesh:
        """A bone at rest."""
        mesh = self._bones[name]
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)

    def given(self, muscle: str) -> InputOrder | None:
        """The vertex order of a muscle's own file, where it is another one."""
        return self._muscles[muscle].given

    def tendons(self, muscle: str, frame: Frame) -> Mesh:
        """All tendons of a muscle in a frame."""
        mesh = look.tendon_mesh(self._muscles[muscle], frame.tendons)
        if mesh is None:
            raise UsageError(f"{muscle!r} has no tendon")
        return mesh


class RunData:
    """A run as data: what reports, exports, pictures and viewers take.

    ``len(run)`` is the number of its frames, ``run["extensor"]`` one muscle; iteration gives every
    muscle.

    Attributes
    ----------
    info : RunInfo
        What ``run.json`` holds.
    frames : list of Frame
        Those that were written, in their order.
    frame_numbers : list of int
    coordinates : dict of str to (frames,) ndarray
        Values of each coordinate [degree, of translations scene unit]; NaN where unknown.
    metrics : list of Row
        (frame, coordinate, coordinate_value [degree], muscle, quantity, value, unit), frame by
        frame.
    quantities : list of str
        Names of what was measured.
    summary : dict
        Muscle -> quantity -> min, max, mean, sd, median, worst.
    verdict : str
        Which muscles are within all limits, which not, and the worst value.
    events : list of Event
        Those of all frames, in their order.
    meshes : SceneMeshes or FolderMeshes
        Bones at rest, and what frames do not hold.
    has_surfaces : bool
        Whether there is something to draw.
    directory : Path or None
        The run's folder; None of a run in memory.
    units : {"m", "cm", "mm"}
        The scene's unit of length.
    body : (3, 3) ndarray
        Left, posterior and superior; x, y and z where they are not known.
    muscles, bones, tendons : list of str
        Names; those of tendons are of meshes, which `mesh` takes as it takes muscles.
    groups, colours : dict of str to str
        Of each muscle, as in pictures.
    """

    def __init__(
        self,
        info: RunInfo,
        frames: list[Frame],
        metrics: list[Row],
        meshes: SceneMeshes | FolderMeshes,
    ) -> None:
        scene = info.scene
        self.info = info
        self.frames = frames
        self.frame_numbers = [frame.index for frame in frames]
        rows = [row.coordinates for row in info.frames]
        self.coordinates = {
            name: np.array([row.get(name, np.nan) for row in rows])
            for name in sorted({name for row in rows for name in row})
        }
        self.metrics = metrics
        self.quantities = list(dict.fromkeys(row.quantity for row in metrics))
        self.summary = info.muscles
        self.verdict = info.verdict
        self.events = [event for frame in frames for event in frame.events]
        self.meshes = meshes
        self.has_surfaces = bool(frames) and bool(frames[0].surfaces)
        self.directory = meshes.directory
        self.units: str = scene.units
        self.body = body_axes(scene.superior, scene.anterior)
        self.muscles: list[str] = [muscle.name for muscle in scene.muscles]
        self.bones: list[str] = [bone.name for bone in scene.bones]
        self.tendons = list(info.tendon_muscles)
        self.groups = look.muscle_groups(
            scene.joints, {muscle.name: [a.bone for a in muscle.attach] for muscle in scene.muscles}
        )
        self.colours = look.muscle_colours(self.muscles, self.groups)
        self._by_number = {frame.index: frame for frame in frames}
        # By muscle and quantity: of dozens of muscles there are tens of thousands.
        self._rows: dict[str, dict[str, list[Row]]] = {}
        for one in metrics:
            self._rows.setdefault(one.muscle, {}).setdefault(one.quantity, []).append(one)

    @classmethod
    def load(cls, directory: str | Path) -> Self:
        """Return the run in a folder, or raise UsageError if it holds none.

        Of a run that was killed, or still goes on, it has the frames up to the last whole one. The
        frames lack what no file holds: material surfaces, and times of single muscles.
        """
        folder = Path(directory)
        info = read_info(folder)
        poses = _read_poses(folder)
        if info.status == "running":
            info = info.model_copy(update={"frames": _whole_frames(info, folder, poses)})
        metrics = _read_table(
            folder,
            "metrics.csv",
            lambda r: Row(int(r[0]), r[1], float(r[2]), r[3], r[4], float(r[5]), r[6]),
        )
        return cls(info, _read_frames(info, folder, poses), metrics, FolderMeshes(folder))

    def summarise(self) -> dict[str, dict[str, QuantityFacts]]:
        """`summary`, and under ``"all"`` what is measured of the bones and of whole frames."""
        return Summary(self.metrics).table()

    def frame(self, number: int) -> Frame:
        """The frame of a number; of a negative one counted from the end."""
        if number in self._by_number:
            return self._by_number[number]
        if -len(self.frames) <= number < 0:
            return self.frames[number]
        ends = f"{self.frames[0].index} to {self.frames[-1].index}" if self.frames else "none"
        raise UsageError(f"frame {number} was not written; the run has {ends}")

    def mesh(self, name: str, number: int) -> Mesh:
        """Vertices and faces of a muscle, or of its tendons, in the frame of a number."""
        if not self.has_surfaces:
            raise UsageError(
                f"{self.directory or 'the run'} has no surfaces: the run's scene had "
                "output.surfaces = false"
            )
        frame = self.frame(number)
        if name in self.tendons:
            return self.meshes.tendons(self.info.tendon_muscles[name], frame)
        surface = frame.surfaces[name]
        return surface.vertices, surface.faces

    def table(self) -> np.ndarray:
        """Return the metrics as one table, with the coordinates of each frame.

        Returns
        -------
        (n,) structured ndarray
            Its fields are ``frame``, each of `coordinates` by its name, ``muscle``, ``quantity``,
            ``coordinate`` (that of a moment arm, else empty), ``value`` and ``unit``;
            ``pandas.DataFrame`` takes it as it is.
        """
        rows = self.metrics
        place = {frame: k for k, frame in enumerate(self.frame_numbers)}
        at = np.array([place[row.frame] for row in rows], dtype=int)
        about = [row.coordinate if "moment_arm" in row.quantity else "" for row in rows]
        columns = {
            "frame": np.array([row.frame for row in rows], dtype=int),
            **{name: values[at] for name, values in self.coordinates.items()},
            "muscle": np.array([row.muscle for row in rows], dtype=str),
            "quantity": np.array([row.quantity for row in rows], dtype=str),
            "coordinate": np.array(about, dtype=str),
            "value": np.array([row.value for row in rows], dtype=float),
            "unit": np.array([row.unit for row in rows], dtype=str),
        }
        return as_table(columns)

    def __len__(self) -> int:
        return len(self.frames)

    def __contains__(self, muscle: object) -> bool:
        return muscle in self.muscles

    def __getitem__(self, muscle: str) -> MuscleRun:
        """The `MuscleRun` of a muscle."""
        if muscle not in self:
            raise UsageError(f"unknown muscle {muscle!r}, {did_you_mean(muscle, self.muscles)}")
        return MuscleRun(self, muscle)

    def __iter__(self) -> Iterator[MuscleRun]:
        """All muscles."""
        return (MuscleRun(self, muscle) for muscle in self.muscles)

    def series(
        self, muscle: str, quantity: str, coordinate: str | None = None
    ) -> tuple[Integers, Floats]:
        """Numbers of the frames (n,) and values (n,) of a quantity of a muscle, of moment arms
        those about a coordinate; empty where it was not measured.
        """
        rows = self._rows.get(muscle, {}).get(quantity, [])
        found = [row for row in rows if coordinate in (None, row.coordinate)]
        frames = np.array([row.frame for row in found], dtype=int)
        return frames, np.array([row.value for row in found], dtype=float)

    def values(self, muscle: str, quantity: str, *, coordinate: str | None = None) -> Floats:
        """Values of a quantity over the frames, (n,) ndarray; of moment arms those about a
        ``coordinate``, which must be named where the muscle has several. `series` gives the frames
        with them.

        UsageError if the run has no such muscle, quantity or coordinate.
        """
        found = self._rows.get(muscle)
        if not found:
            raise UsageError(
                f"unknown muscle {muscle!r}, {did_you_mean(muscle, [*self.muscles, ALL])}"
            )
        if quantity not in found:
            raise UsageError(
                f"{quantity!r} was not measured of {muscle!r}, {did_you_mean(quantity, found)}"
            )
        names = named_coordinates(quantity, found[quantity], coordinate)
        if len(names) > 1:
            raise UsageError(
                f"{muscle!r} has moment arms about {', '.join(names)}; name one with coordinate="
            )
        return self.series(muscle, quantity, coordinate)[1]

    def __repr__(self) -> str:
        return f"<Run of {self.info.scene.name!r}: {len(self)} frames, {', '.join(self.muscles)}>"


def open_run(run: RunData | str | Path) -> RunData:
    """A run as it is, or the one in a folder."""
    return run if isinstance(run, RunData) else RunData.load(run)


class MuscleRun:
    """One muscle of a run."""

    def __init__(self, run: RunData, name: str) -> None:
        self.run = run
        self.name = name

    def surface(self, frame: int = -1, *, units: str | None = None) -> trimesh.Trimesh:
        """Surface in a frame of the run: closed, faces outward, world coordinates.

        ``frame`` is the number of a frame; negative counts from the end. ``units`` of length are
        "m", "cm" or "mm", the scene's where not given.
        """
        vertices, faces = self.run.mesh(self.name, frame)
        if units is not None and units not in MM_PER_UNIT:
            raise UsageError(f"units must be m, cm or mm, got {units!r}")
        scale = MM_PER_UNIT[self.run.units] / MM_PER_UNIT[units or self.run.units]
        return trimesh.Trimesh(scale * vertices, faces, process=False)

    def values(self, quantity: str, *, coordinate: str | None = None) -> Floats:
        """Values of a quantity over the frames, (n,) ndarray; see `RunData.values`."""
        return self.run.values(self.name, quantity, coordinate=coordinate)

    def fibres(self, frame: int = -1) -> Floats:
        """Points (N, k, 3) of the fibres in a frame of the run, each from origin to insertion with
        its tendons [scene unit]; of a run whose scene had ``output.fibres``.
        """
        return self._fibres(self.run.frame(frame)).points

    @property
    def fibre_lengths(self) -> Floats:
        """Length (frames, N) of each fibre with its tendons [scene unit]."""
        return np.array([self._fibres(frame).lengths for frame in self.run.frames])

    def moment_arms(self, coordinate: str) -> Floats:
        """Moment arm (frames, N) of each fibre about a coordinate, of its full or its short name.

        Minus the slope of the fibre's length [scene unit per radian, or 1 of a translation], see
        `rbfmuscle.metrics.rows.moment_arms`; NaN where the coordinate does not move alone.
        """
        path = [frame.coordinates for frame in self.run.frames]
        known = sorted({name for coordinates in path for name in coordinates})
        name = full_name(coordinate, known, context="moment_arms")
        scene = self.run.info.scene
        reach = dict.fromkeys(scene.coordinate_units, from_mm(ARM_REACH, scene.units))
        lengths = self.fibre_lengths
        out = np.full(lengths.shape, np.nan)
        for row, found in zip(out, moment_arms(path, lengths, reach)):
            row[:] = found.get(name, np.nan)
        return out

    def _fibres(self, frame: Frame) -> FibreLines:
        if self.name not in frame.fibres:
            raise UsageError(
                f"the run has no fibres of {self.name!r}; run it with output.fibres=32"
            )
        return frame.fibres[self.name]


def moment_arm_coordinates(run: RunData, muscle: str | None = None) -> list[str]:
    """The coordinates that a muscle of a run, or any, has moment arms about, in their order in
    ``metrics.csv``.
    """
    rows = (r for r in run.metrics if r.quantity == "moment_arm" and muscle in (None, r.muscle))
    return list(dict.fromkeys(r.coordinate for r in rows))


def frame_caption(run: RunData, number: int) -> str:
    """Frame number, time and coordinates of a frame, as text; of many coordinates those that move
    most.
    """
    entry = next(row for row in run.info.frames if row.frame == number)
    units = run.info.scene.coordinate_units
    spans = {name: np.ptp(np.nan_to_num(run.coordinates[name])) for name in entry.coordinates}
    most = sorted(spans, key=lambda name: -spans[name])[:MOST_SHOWN]
    texts = [
        f"{name} {value:.4g}{units.get(name, '°')}"
        for name, value in entry.coordinates.items()
        if name in most
    ]
    clock = [] if entry.time is None else [f"{entry.time:.4g} s"]
    return ", ".join([f"frame {number}", *clock, *texts])


def as_table(columns: Mapping[str, Sequence[object] | np.ndarray]) -> np.ndarray:
    """Columns (n,) by name as a structured ndarray (n,); None becomes NaN."""
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    for name, values in arrays.items():
        if values.dtype == object:
            arrays[name] = np.array([np.nan if value is None else value for value in values])
    table = np.empty(
        len(next(iter(arrays.values()))), dtype=[(name, x.dtype) for name, x in arrays.items()]
    )
    for name, values in arrays.items():
        table[name] = values
    return table


def csv_rows(table: np.ndarray) -> list[Sequence[object]]:
    """The rows of a structured ndarray, below the names of its columns."""
    return [table.dtype.names or (), *table.tolist()]


def named_coordinates(quantity: str, rows: Sequence[Row], coordinate: str | None) -> list[str]:
    """The coordinates that rows of a quantity are about, or the one that is asked for; none of what
    is no moment arm. UsageError where there is no such coordinate.
    """
    if "moment_arm" not in quantity:
        if coordinate is not None:
            raise UsageError(f"{quantity!r} has no coordinate; only moment arms have")
        return []
    names = list(dict.fromkeys(row.coordinate for row in rows))
    if coordinate is None:
        return names
    if coordinate not in names:
        raise UsageError(f"no moment arm about {coordinate!r}, {did_you_mean(coordinate, names)}")
    return [coordinate]


def given_file(muscle: str) -> str:
    """File of the vertex order of a muscle's own file, relative to the folder of a run."""
    return f"surfaces/{muscle}.npz"


_Row = TypeVar("_Row")
_Content = TypeVar("_Content")
Poses = dict[int, dict[str, Floats]]  # (4, 4) by frame and bone


class FolderMeshes:
    """Meshes that the frames of a run in a folder do not hold, read when asked for."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._bones: dict[str, Mesh] = {}

    def bone(self, name: str) -> Mesh:
        """A bone at rest."""
        if name not in self._bones:
            self._bones[name] = read_vtp(self.directory / "bones" / f"{name}.vtp")
        return self._bones[name]

    def given(self, muscle: str) -> InputOrder | None:
        """The vertex order of a muscle's own file, None where the shown mesh has the same;
        UsageError for what no run writes.
        """
        path = self.directory / given_file(muscle)
        if not path.is_file():
            return None
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                order = InputOrder(found["faces"], found["source"])
            if any(numbers.dtype.kind != "i" for numbers in order) or order.source.ndim != 1:
                raise ValueError("arrays of another kind")
            if order.faces.shape[1:] != (3,) or order.source.min(initial=0) < 0:
                raise ValueError("arrays of another shape")
            if not np.array_equal(np.unique(order.faces), np.arange(len(order.source))):
                raise ValueError("triangles of other vertices")
        except (*BROKEN_FILE, zipfile.BadZipFile) as error:
            raise UsageError(
                f"{path} is not as it was written ({error}); run the scene again"
            ) from None
        return order

    def tendons(self, muscle: str, frame: Frame) -> Mesh:
        """All tendons of a muscle in a frame."""
        file = frame_file("surfaces", tendon_name(muscle), frame.index)
        return read_vtp(self.directory / file)


class ReadFiles(Mapping[str, _Content]):
    """What files hold by muscle, each read when it is asked for."""

    def __init__(self, files: Mapping[str, Path], read: Callable[[Path], _Content]) -> None:
        self._files, self._read = files, read

    def __getitem__(self, muscle: str) -> _Content:
        return self._read(self._files[muscle])

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def _read_surface(path: Path) -> ModelSurface:
    return ModelSurface(*read_vtp(path))


def read_info(directory: Path) -> RunInfo:
    """What ``run.json`` holds; UsageError if it is missing, is none of a run's, or is newer."""
    path = directory / "run.json"
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        message = f"{directory} holds no run (no run.json); give the folder of 'run -o'"
        raise UsageError(message) from None
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is not the run.json of a run ({error})") from None
    version = table.get("format", 0) if isinstance(table, dict) else 0
    if isinstance(version, int) and version > FORMAT:
        raise UsageError(
            f"{path} has format {version}, of a newer rbfmuscle; this one reads up to {FORMAT}: "
            "update rbfmuscle"
        )
    try:
        return RunInfo.model_validate(table)
    except (ValidationError, SceneError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        place = ".".join(map(str, first["loc"])) if first else ""
        what = f"{place} = {first['input']!r}: {first['msg']}" if first else str(error)
        message = f"{path} is not the run.json of a run ({what[:300]}); run the scene again"
        raise UsageError(message) from None


def _read_table(directory: Path, name: str, read: Callable[[list[str]], _Row]) -> list[_Row]:
    """Rows of a table, without its head, each as it is read; none where the file is missing.

    UsageError if it is not as a run writes it.
    """
    path = directory / name
    if not path.is_file():
        return []
    try:
        text = path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]  # the last line of a run that was killed may be cut
        rows = list(csv.reader(io.StringIO(whole, newline="")))[1:]
        return [read(row) for row in rows]
    except (ValueError, IndexError, csv.Error) as error:
        raise UsageError(
            f"{path} is not as it was written ({error}); run the scene again"
        ) from None


def _read_poses(directory: Path) -> Poses:
    def placed(r: list[str]) -> tuple[int, str, Floats]:
        return int(r[0]), r[1], np.array(r[2:], dtype=float).reshape(4, 4)

    found: Poses = {}
    for frame, bone, pose in _read_table(directory, "poses.csv", placed):
        found.setdefault(frame, {})[bone] = pose
    return found


def _whole_frames(info: RunInfo, directory: Path, poses: Poses) -> list[FrameInfo]:
    """Entries of ``run.json`` for the frames of which every file is there."""
    planned = info.planned
    bones = {bone.name for bone in info.scene.bones}
    meshes = [*(muscle.name for muscle in info.scene.muscles), *info.tendon_muscles]
    if not info.scene.output.surfaces:
        meshes = []
    return [
        FrameInfo(
            frame=frame,
            coordinates=planned[place] if place < len(planned) else {},
            wall=None,
        )
        for place, (frame, placed) in enumerate(poses.items())
        if set(placed) >= bones
        and all((directory / frame_file("surfaces", name, frame)).is_file() for name in meshes)
    ]


def _read_frames(info: RunInfo, directory: Path, poses: Poses) -> list[Frame]:
    scene = info.scene
    units = scene.coordinate_units
    muscles = [muscle.name for muscle in scene.muscles]
    events: dict[int, list[Event]] = {}
    for event in _read_table(
        directory, "events.csv", lambda r: Event(int(r[0]), r[1], r[2], int(r[3]), r[4])
    ):
        events.setdefault(event.frame, []).append(event)
    found = []
    for entry in info.frames:
        index = entry.frame
        values = entry.coordinates.items()
        placed = poses.get(index, {})
        lost = next((bone.name for bone in scene.bones if bone.name not in placed), None)
        if lost is not None:
            raise UsageError(
                f"{directory / 'poses.csv'} lacks frame {index} of bone {lost!r}; run the scene "
                "again"
            )
        shown = muscles if scene.output.surfaces else []
        surfaces = {name: directory / frame_file("surfaces", name, index) for name in shown}
        fibres = {name: directory / frame_file("fibres", name, index) for name in muscles}
        fibres = {name: file for name, file in fibres.items() if file.is_file()}
        frame = Frame(
            index,
            {name: value if name in units else math.radians(value) for name, value in values},
            placed,
            ReadFiles(surfaces, _read_surface),
            {},
            events.get(index, []),
            {},
            math.nan if entry.wall is None else entry.wall,
            fibres=ReadFiles(fibres, read_fibres),
        )
        found.append(frame)
    return found
