"""Writes a run to a folder while it goes on: whatever ends it, the frames so far can be read."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.files.meshfiles import SUFFIXES, write_mesh
from rbfmuscle.study.files.vtp import Collection
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.frame import Frame
    from rbfmuscle.sim.scene.scene import Scene


METRICS_COLUMNS = ("frame", "coordinate", "angle", "muscle", "quantity", "value", "unit")
EVENTS_COLUMNS = ("frame", "muscle", "bone", "count", "action")
POSES_COLUMNS = ("frame", "bone", *(f"m{i}{j}" for i in range(4) for j in range(4)))

# Of an earlier run in the same folder.
_OLD_FILES = (
    "run.json",
    "surfaces.pvd",
    "bones.pvd",
    "fibres.pvd",
    "fibre_lengths.csv",
    "metrics.csv",
    "opensim.csv",
    "report.html",
    "preview.webp",
)


class RunWriter:
    """Streams frames to a folder; nothing of a frame is kept in memory.

    Parameters
    ----------
    directory : path
        Made where it is missing. A run that lies there already is replaced.
    scene : Scene
        Its ``output`` table says which parts are written.

    Raises
    ------
    UsageError
        If the folder cannot be written to.
    """

    def __init__(self, directory: str | Path, scene: Scene) -> None:
        self.directory = Path(directory)
        self.scene = scene
        self.count = 0
        output = scene.output
        self.format = output.surfaces.format if output.surfaces else None
        try:
            self._clear()
            self._tables = [
                self._table("poses.csv", POSES_COLUMNS),
                self._table("events.csv", EVENTS_COLUMNS),
            ]
            if output.metrics:
                self._tables.append(self._table("metrics.csv", METRICS_COLUMNS))
            self._collections = self._open_collections()
            self._fibres = _fibre_files(self.directory) if output.fibres else None
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None
        self._bone_files = {}

    def write(self, frame: Frame, rows: Sequence[Any] = ()) -> None:
        """Write one frame and the rows of metrics that are complete by now.

        Parameters
        ----------
        frame : Frame
        rows : list of Row

        Raises
        ------
        SolveError
            If the disk refuses; the frames before stand.
        """
        try:
            self._write(frame, rows)
        except OSError as error:
            kept = f"{self.count} frames are kept in {self.directory}"
            raise SolveError(f"cannot write frame {frame.index}: {error.strerror}; {kept}") from None
        self.count += 1

    def close(self, rows: Sequence[Any] = ()) -> None:
        """Write the last rows of metrics and close all files."""
        try:
            self._add_rows(rows)
            for _, file in self._tables:
                file.close()
            for collection in self._collections.values():
                collection.close()
            if self._fibres is not None:
                self._fibres.close()
        except OSError as error:
            raise SolveError(f"cannot finish the tables in {self.directory}: {error.strerror}") from None

    def write_info(self, info: dict[str, Any]) -> None:
        """Write ``run.json`` in one piece: a reader finds the old one or the new one, never half of it.

        While the run goes on it holds the coordinates of all frames to come, for readers of a run that was killed.
        """
        if info.get("status") == "running":
            planned = [_degrees(coordinates) for coordinates in self.scene.motion.frames]
            info = {**info, "planned": planned}
        write_json(self.directory / "run.json", info)

    def _write(self, frame, rows):
        entries = []
        for name, surface in frame.surfaces.items():
            if self.format is None:
                break
            file = f"surfaces/{name}_{frame.index:04d}{SUFFIXES[self.format]}"
            write_mesh(self.directory / file, surface.vertices, surface.faces)
            entries.append((name, file))
        bones = self._write_bones(frame) if self.format is not None else []
        if self._collections:
            times = self.scene.motion.times
            step = frame.index if times is None else times[frame.index]
            self._collections["bones"].add(step, bones)
            self._collections["surfaces"].add(step, entries)
        (poses, poses_file), (events, events_file) = self._tables[:2]
        poses.writerows(
            [frame.index, bone, *(repr(float(x)) for x in pose.ravel())] for bone, pose in frame.poses.items()
        )
        events.writerows([e.frame, e.muscle, e.bone, e.count, e.action] for e in frame.events)
        poses_file.flush()
        events_file.flush()
        if self._fibres is not None:
            self._fibres.write(frame)
        self._add_rows(rows)

    def _add_rows(self, rows):
        if self.scene.output.metrics:
            metrics, file = self._tables[2]
            metrics.writerows(rows)
            file.flush()

    def _write_bones(self, frame):
        """Bones of a frame; one that stands where it stood is not written again."""
        entries = []
        for bone in self.scene.bones:
            pose = frame.poses[bone.name]
            known = self._bone_files.get(bone.name)
            if known is None or np.abs(known[0] - pose).max() > 0.0:
                file = f"bones/{bone.name}_{frame.index:04d}{SUFFIXES[self.format]}"
                vertices = np.asarray(bone.mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
                write_mesh(self.directory / file, vertices, bone.mesh.faces, single=True)
                known = self._bone_files[bone.name] = (pose.copy(), file)
            entries.append((bone.name, known[1]))
        return entries

    def _clear(self):
        """Make the folders, without the files of a run that was here before."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for old in _OLD_FILES:
            (self.directory / old).unlink(missing_ok=True)
        for folder in ("surfaces", "bones", "fibres"):
            for file in (self.directory / folder).glob("*_[0-9][0-9][0-9][0-9]*.*"):
                file.unlink()
            if self.format is not None and folder != "fibres":
                (self.directory / folder).mkdir(exist_ok=True)

    def _table(self, name, columns):
        file = open(self.directory / name, "w", encoding="utf-8", newline="")  # noqa: SIM115
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        file.flush()
        return writer, file

    def _open_collections(self):
        if self.format != "pvd":
            return {}
        return {name: Collection(self.directory / f"{name}.pvd") for name in ("surfaces", "bones")}


def _degrees(coordinates):
    return {name: math.degrees(value) for name, value in coordinates.items()}


def _fibre_files(directory):
    from rbfmuscle.study.files.fibre_files import FibreFiles

    return FibreFiles(directory)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write JSON in one move, so that whoever reads it finds the old or the new; NaN and infinity become null."""
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_text(json.dumps(_plain(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def _plain(value):
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    elif isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
