"""Writes a run to a folder while it goes on: whatever ends it, the frames so far can be read."""

from __future__ import annotations

import csv
import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.threads import each
from rbfmuscle.study.files.checkpoint import NAME, write_checkpoint
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
    "metrics.csv",
    "report.html",
    "preview.webp",
    NAME,
)
# Share of a run's time that goes into checkpoints, at most.
KEEPING_SHARE = 0.02


def check_writable(directory: str | Path) -> None:
    """Write to a folder, or to the one that it would be made in, before what takes time is begun.

    Raises
    ------
    UsageError
        If the folder cannot be written to.
    """
    path = Path(directory).absolute()
    there = next(place for place in (path, *path.parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}; choose another folder") from None


class RunWriter:
    """Streams frames to a folder; nothing of a frame is kept in memory.

    Parameters
    ----------
    directory : path
        Made where it is missing. A run that lies there already is replaced.
    scene : Scene
        Its ``output`` table says which parts are written.
    kept : dict, optional
        What `state` gave after the last frame of the run that lies there and is to go on; what was written
        since is taken away.

    Raises
    ------
    UsageError
        If the folder cannot be written to.
    """

    def __init__(self, directory: str | Path, scene: Scene, kept: dict[str, Any] | None = None) -> None:
        self.directory = Path(directory)
        self.scene = scene
        output = scene.output
        self.format = output.surfaces.format if output.surfaces else None
        kept = kept or {"last": -1, "count": 0, "sizes": {}, "ends": {}, "bones": {}}
        self.count, self._last, self._bone_files = kept["count"], kept["last"], dict(kept["bones"])
        self._keeper, self._failed = _Keeper(self.directory / NAME), False
        try:
            self._clear(everything=not kept["sizes"])
            self._tables = {name: self._table(name, columns, kept) for name, columns in _tables(output)}
            names = ("surfaces", "bones") if self.format == "pvd" else ()
            ends = {name: kept["ends"].get(name) for name in names}
            self._collections = {n: Collection(self.directory / f"{n}.pvd", ends[n]) for n in names}
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None
        self._good = self.state()

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
            self._roll_back(frame.index)
            kept = f"{self.count} frames are kept in {self.directory}"
            raise SolveError(f"cannot write frame {frame.index}: {error.strerror}; {kept}") from None
        self.count, self._last = self.count + 1, frame.index
        self._good = self.state()

    def keep(self, state: dict[str, Any]) -> None:
        """Keep what a resumed run needs beside the frame just written; not after every one, if that takes long."""
        self._keeper.take({**state, "files": self._good})

    def close(self, rows: Sequence[Any] = ()) -> None:
        """Write the last rows of metrics and close all files; after a frame that could not be written, nothing."""
        self._keeper.flush()
        if self._failed:
            return
        try:
            self._add_rows(rows)
            for _, file in self._tables.values():
                file.close()
            for collection in self._collections.values():
                collection.close()
        except OSError as error:
            raise SolveError(f"cannot finish the tables in {self.directory}: {error.strerror}") from None

    def state(self) -> dict[str, Any]:
        """What stands in the folder now, for a writer that goes on: sizes [byte], and the bones written last."""
        return {
            "last": self._last,
            "count": self.count,
            "sizes": {name: os.fstat(file.fileno()).st_size for name, (_, file) in self._tables.items()},
            "ends": {name: collection.end for name, collection in self._collections.items()},
            "bones": dict(self._bone_files),
        }

    def finish(self) -> None:
        """Nothing is left to resume."""
        (self.directory / NAME).unlink(missing_ok=True)

    def write_info(self, info: dict[str, Any]) -> None:
        """Write ``run.json`` in one piece: a reader finds the old one or the new one, never half of it.

        While the run goes on it holds the coordinates of all frames to come, for readers of a run that was killed.
        """
        if info.get("status") == "running":
            planned = [_degrees(coordinates) for coordinates in self.scene.motion.frames]
            info = {**info, "planned": planned}
        write_json(self.directory / "run.json", info)

    def _write(self, frame, rows):
        surfaces = self._write_surfaces(frame) if self.format is not None else []
        bones = self._write_bones(frame) if self.format is not None else []
        if "bones" in self._collections:
            times = self.scene.motion.times
            step = frame.index if times is None else times[frame.index]
            self._collections["bones"].add(step, bones)
            self._collections["surfaces"].add(step, surfaces)
        (poses, poses_file), (events, events_file) = self._tables["poses.csv"], self._tables["events.csv"]
        poses.writerows(
            [frame.index, bone, *(repr(float(x)) for x in pose.ravel())] for bone, pose in frame.poses.items()
        )
        events.writerows([e.frame, e.muscle, e.bone, e.count, e.action] for e in frame.events)
        poses_file.flush()
        events_file.flush()
        self._add_rows(rows)

    def _add_rows(self, rows):
        if self.scene.output.metrics:
            metrics, file = self._tables["metrics.csv"]
            metrics.writerows(rows)
            file.flush()

    def _write_surfaces(self, frame):
        """Surfaces of a frame, side by side: most of the time goes into packing them."""
        entries = [
            (name, f"surfaces/{name}_{frame.index:04d}{SUFFIXES[self.format]}") for name in frame.surfaces
        ]

        def write(entry):
            surface = frame.surfaces[entry[0]]
            write_mesh(self.directory / entry[1], surface.vertices, surface.faces)

        each(write, entries)
        return entries

    def _write_bones(self, frame):
        """Bones of a frame; one that stands where it stood is not written again."""
        entries = []
        for bone in self.scene.bones:
            pose = frame.poses[bone.name]
            known = self._bone_files.get(bone.name)
            if known is None or np.abs(known[0] - pose).max() > 0.0:
                file = f"bones/{bone.name}_{frame.index:04d}{SUFFIXES[self.format]}"
                vertices = np.asarray(bone.mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
                write_mesh(self.directory / file, vertices, bone.mesh.faces)
                known = self._bone_files[bone.name] = (pose.copy(), file)
            entries.append((bone.name, known[1]))
        return entries

    def _roll_back(self, frame):
        """Leave the folder as it was before a frame that could not be written.

        What the disk still allows: nothing here can be told better than the first refusal.
        """
        self._failed = True
        for name, (_, file) in self._tables.items():
            with suppress(OSError):
                file.close()
            with suppress(OSError):
                os.truncate(self.directory / name, self._good["sizes"][name])
        for name, collection in self._collections.items():
            with suppress(OSError):
                collection.roll_back(self._good["ends"][name])
                collection.close()
        self._remove(frame - 1)

    def _remove(self, last):
        """Take the meshes of all frames after ``last`` away."""
        for folder in ("surfaces", "bones"):
            for file in (self.directory / folder).glob("*_[0-9][0-9][0-9][0-9]*.*"):
                if int(file.stem.rpartition("_")[2]) > last:
                    file.unlink(missing_ok=True)

    def _clear(self, everything):
        """Make the folders, without the files of a run that was here before, or of frames that are not kept."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for old in _OLD_FILES if everything else ():
            (self.directory / old).unlink(missing_ok=True)
        self._remove(self._last)
        for folder in ("surfaces", "bones") if self.format is not None else ():
            (self.directory / folder).mkdir(exist_ok=True)

    def _table(self, name, columns, kept):
        size = kept["sizes"].get(name)
        mode = "w" if size is None else "r+"
        file = open(self.directory / name, mode, encoding="utf-8", newline="")  # noqa: SIM115
        writer = csv.writer(file, lineterminator="\n")
        if size is None:
            writer.writerow(columns)
            file.flush()
        else:
            file.truncate(size)
            file.seek(size)
        return writer, file


class _Keeper:
    """Writes checkpoints as often as takes a small share of the time; the last one in any case."""

    def __init__(self, path: Path) -> None:
        self.path, self.cost, self.written = path, 0.0, -math.inf
        self.waiting: dict[str, Any] | None = None

    def take(self, state: dict[str, Any]) -> None:
        """Write a state, or hold it until the next one or the end."""
        self.waiting = state
        if time.perf_counter() - self.written >= self.cost / KEEPING_SHARE:
            self.flush()

    def flush(self) -> None:
        """Write what is held; a full disk keeps the one before."""
        if self.waiting is None:
            return
        start, state, self.waiting = time.perf_counter(), self.waiting, None
        with suppress(OSError):
            write_checkpoint(self.path, state)
        self.written = time.perf_counter()
        self.cost = self.written - start


def _tables(output):
    """Name and columns of each table that a run writes."""
    found = [("poses.csv", POSES_COLUMNS), ("events.csv", EVENTS_COLUMNS)]
    if output.metrics:
        found.append(("metrics.csv", METRICS_COLUMNS))
    return found


def _degrees(coordinates):
    return {name: math.degrees(value) for name, value in coordinates.items()}


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write JSON in one move, so that whoever reads it finds the old or the new; NaN and infinity become null."""
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_text(json_text(data) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def json_text(data: Any) -> str:
    """JSON that every reader takes: NaN and infinity become null."""
    return json.dumps(plain(data), indent=1, allow_nan=False)


def plain(value: Any) -> Any:
    """A tree as JSON can hold it: NaN and infinity become null, what is no plain value its text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    elif isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
