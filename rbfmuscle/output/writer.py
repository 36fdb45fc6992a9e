"""Writes a run to a folder while it goes on: whatever ends it, the frames so far can be read."""

import csv
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.coarse import simplified
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.output.tubes import tendon_mesh, tendon_name
from rbfmuscle.output.vtp import Collection, write_vtp, write_whole
from rbfmuscle.scene.motion import shown_value
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame
from rbfmuscle.validation import SolveError, UsageError

TABLES = {
    "poses.csv": ("frame", "bone", *(f"m{i}{j}" for i in range(4) for j in range(4))),
    "events.csv": ("frame", "muscle", "bone", "count", "action"),
    "metrics.csv": Row._fields,
}

LIGHT = 1600  # triangles of a bone that moves
# Of an earlier run in the same folder.
_OLD_FILES = ("run.json", "surfaces.pvd", "bones.pvd", "metrics.csv", "report.html", "preview.webp")


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

    The folder is made where it is missing, UsageError where that fails; a run that lies there already is replaced. The
    scene's ``output`` table says which parts are written.
    """

    def __init__(self, directory: str | Path, scene: Scene) -> None:
        self.directory = Path(directory)
        self.scene = scene
        self.meshes = bool(scene.output.surfaces)
        self.count, self._failed = 0, False
        # Pose and file that show a bone now, and its mesh for a series.
        self._bones: dict[str, tuple[Floats, str]] = {}
        self._light: dict[str, tuple[Floats, Integers]] = {}
        try:
            self._clear()
            for name, head in TABLES.items():
                self._add_rows(name, [head], mode="w")
            names = ("surfaces", "bones") if self.meshes else ()
            self._collections = {name: Collection(self.directory / f"{name}.pvd") for name in names}
        except OSError as error:
            message = f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            raise UsageError(message) from None

    def write(self, frame: Frame, rows: Sequence[Any] = ()) -> None:
        """Write one frame and the rows of metrics that are complete by now.

        Raises
        ------
        SolveError
            If the disk refuses; the frames before stand.
        """
        try:
            self._write(frame, rows)
        except OSError as error:
            self._failed = True
            self._remove(frame.index - 1)
            kept = f"{self.count} frames are kept in {self.directory}"
            raise SolveError(f"cannot write frame {frame.index}: {error.strerror}; {kept}") from None
        self.count += 1

    def close(self, rows: Sequence[Any] = ()) -> None:
        """Write the last rows of metrics; after a frame that could not be written, nothing."""
        try:
            self._add_rows("metrics.csv", () if self._failed else rows)
        except OSError as error:
            raise SolveError(f"cannot finish the tables in {self.directory}: {error.strerror}") from None

    def write_info(self, info: dict[str, Any]) -> None:
        """Write ``run.json`` in one piece: a reader finds the old one or the new one, never half of it.

        While the run goes on it holds the coordinates of all frames to come, for readers of a run that was killed.
        """
        if info.get("status") == "running":
            planned = [
                {name: shown_value(self.scene, name, value) for name, value in frame.items()}
                for frame in self.scene.motion.frames
            ]
            info = {**info, "planned": planned}
        write_json(self.directory / "run.json", info)

    def _write(self, frame, rows):
        if self.meshes:
            times = self.scene.motion.times
            step = frame.index if times is None else times[frame.index]
            surfaces = self._write_surfaces(frame)
            self._collections["bones"].add(step, self._write_bones(frame))
            self._collections["surfaces"].add(step, surfaces)
        # A frame's surfaces are on the disk before its poses: readers of a run that was killed rely on it.
        poses = [(bone.name, frame.poses[bone.name].ravel().tolist()) for bone in self.scene.bones]
        self._add_rows("poses.csv", [(frame.index, name, *pose) for name, pose in poses])
        self._add_rows("events.csv", [(e.frame, e.muscle, e.bone, e.count, e.action) for e in frame.events])
        self._add_rows("metrics.csv", rows)

    def _add_rows(self, name, rows, mode="a"):
        with (self.directory / name).open(mode, encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)

    def _write_surfaces(self, frame):
        """Surfaces of a frame, side by side: most of the time goes into packing them."""
        meshes = {name: (surface.vertices, surface.faces) for name, surface in frame.surfaces.items()}
        if self.scene.output.tendons:
            tendons = {muscle.name: tendon_mesh(muscle, frame.tendons) for muscle in self.scene.muscles}
            meshes |= {tendon_name(name): mesh for name, mesh in tendons.items() if mesh is not None}
        entries = [(name, f"surfaces/{name}_{frame.index:04d}.vtp") for name in meshes]
        each(lambda entry: write_vtp(self.directory / entry[1], *meshes[entry[0]]), entries)
        return entries

    def _write_bones(self, frame):
        """Bones where they are now: the mesh at rest, written once; one that has moved with few triangles, in a series.

        Whoever wants more takes the mesh at rest and the pose.
        """
        for bone in self.scene.bones:
            name, mesh, pose = bone.name, bone.mesh, frame.poses[bone.name]
            if name not in self._bones:
                self._bones[name] = np.eye(4), f"bones/{name}.vtp"
                write_vtp(self.directory / self._bones[name][1], mesh.vertices, mesh.faces)
            if not np.array_equal(self._bones[name][0], pose):
                if name not in self._light:
                    self._light[name] = simplified(mesh.vertices, mesh.faces, LIGHT)
                vertices, faces = self._light[name]
                moved = vertices @ pose[:3, :3].T + pose[:3, 3]
                self._bones[name] = pose.copy(), f"bones/{name}_{frame.index:04d}.vtp"
                write_vtp(self.directory / self._bones[name][1], moved.astype(np.float32), faces)
        return [(bone.name, self._bones[bone.name][1]) for bone in self.scene.bones]

    def _remove(self, last):
        """Take the meshes of all frames after ``last`` away."""
        for folder in ("surfaces", "bones"):
            for file in (self.directory / folder).glob("*_[0-9][0-9][0-9][0-9]*.*"):
                if int(file.stem.rpartition("_")[2]) > last:
                    file.unlink(missing_ok=True)

    def _clear(self):
        """Make the folders, without the files of a run that was here before."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for old in _OLD_FILES:
            (self.directory / old).unlink(missing_ok=True)
        self._remove(-1)
        for old in (self.directory / "bones").glob("*.vtp"):
            old.unlink()
        for folder in ("surfaces", "bones") if self.meshes else ():
            (self.directory / folder).mkdir(exist_ok=True)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write JSON in one move, so that whoever reads it finds the old or the new; NaN and infinity become null."""
    try:
        write_whole(Path(path), json_text(data) + "\n")
    except OSError as error:
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def json_text(data: Any) -> str:
    """JSON that every reader takes: NaN and infinity become null, what has no form in JSON its text."""
    from pydantic_core import to_json

    def plain(value: Any) -> Any:
        return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else str(value)

    return to_json(data, indent=1, inf_nan_mode="null", fallback=plain).decode()
