"""Reads a run from its folder; of one that was killed, or still goes on, the whole frames."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.output.fibre_files import fibre_file, read_fibres
from rbfmuscle.output.given_files import read_given
from rbfmuscle.output.info import FORMAT, FrameInfo, RunInfo
from rbfmuscle.output.vtp import read_vtp
from rbfmuscle.scene.meshes.input_mesh import InputOrder
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Event, Frame, ModelSurface
from rbfmuscle.validation import SceneError, UsageError

Mesh = tuple[Floats, Integers]
_Row = TypeVar("_Row")
_Content = TypeVar("_Content")
Poses = dict[int, dict[str, Floats]]  # (4, 4) by frame and bone


class FolderMeshes:
    """Meshes that the frames of a run in a folder do not hold, read when asked for."""

    def __init__(self, directory: Path) -> None:
        self.directory: Path | None = directory
        self._folder = directory
        self._bones: dict[str, Mesh] = {}

    def bone(self, name: str) -> Mesh:
        """A bone at rest."""
        if name not in self._bones:
            self._bones[name] = read_vtp(self._folder / "bones" / f"{name}.vtp")
        return self._bones[name]

    def given(self, muscle: str) -> InputOrder | None:
        """The vertex order of a muscle's own file, where it is another one."""
        return read_given(self._folder, muscle)

    def tendons(self, muscle: str, frame: Frame) -> Mesh:
        """All tendons of a muscle in a frame."""
        return read_vtp(surface_file(self._folder, tendon_name(muscle), frame.index))


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


def surface_file(directory: Path, name: str, frame: int) -> Path:
    """File of a muscle's surface, or of its tendons, in a frame."""
    return directory / "surfaces" / f"{name}_{frame:04d}.vtp"


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


def read_run(directory: Path) -> tuple[RunInfo, list[Frame], list[Row], FolderMeshes]:
    """Facts, frames, metrics and meshes of the run in a folder, UsageError if it holds none.

    The frames lack what no file holds: material surfaces, and times of single muscles.
    """
    info = read_info(directory)
    poses = _read_poses(directory)
    if info.status == "running":
        info = info.replaced(frames=_whole_frames(info, directory, poses))
    frames = _read_frames(info, directory, poses)
    return info, frames, _read_metrics(directory), FolderMeshes(directory)


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
        message = f"{path} is not as it was written ({error}); run the scene again"
        raise UsageError(message) from None


def _read_metrics(directory: Path) -> list[Row]:
    def row(r: list[str]) -> Row:
        return Row(int(r[0]), r[1], float(r[2]), r[3], r[4], float(r[5]), r[6])

    return _read_table(directory, "metrics.csv", row)


def _read_events(directory: Path) -> list[Event]:
    def event(r: list[str]) -> Event:
        return Event(int(r[0]), r[1], r[2], int(r[3]), r[4])

    return _read_table(directory, "events.csv", event)


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
        and all(surface_file(directory, name, frame).is_file() for name in meshes)
    ]


def _read_frames(info: RunInfo, directory: Path, poses: Poses) -> list[Frame]:
    scene = info.scene
    units = scene.coordinate_units
    muscles = [muscle.name for muscle in scene.muscles]
    events: dict[int, list[Event]] = {}
    for event in _read_events(directory):
        events.setdefault(event.frame, []).append(event)
    found = []
    for entry in info.frames:
        index = entry.frame
        values = entry.coordinates.items()
        placed = poses.get(index, {})
        lost = next((bone.name for bone in scene.bones if bone.name not in placed), None)
        if lost is not None:
            what = f"lacks frame {index} of bone {lost!r}"
            raise UsageError(f"{directory / 'poses.csv'} {what}; run the scene again")
        shown = muscles if scene.output.surfaces else []
        surfaces = {name: surface_file(directory, name, index) for name in shown}
        fibres = {name: directory / fibre_file(name, index) for name in muscles}
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
