"""Reads a run from its folder; of one that was killed, or still goes on, the whole frames."""

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.output.fibre_files import SavedFibres
from rbfmuscle.output.vtp import read_vtp
from rbfmuscle.scene.build import check_name
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Event, Frame, ModelSurface
from rbfmuscle.validation import UsageError

Mesh = tuple[Floats, Integers]
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

    def tendons(self, muscle: str, frame: Frame) -> Mesh:
        """All tendons of a muscle in a frame."""
        return read_vtp(surface_file(self._folder, tendon_name(muscle), frame.index))


class FolderSurfaces(Mapping[str, ModelSurface]):
    """Surfaces of some muscles in a frame of a run's folder, each read when it is asked for."""

    def __init__(self, directory: Path, muscles: list[str], frame: int) -> None:
        self._files = {name: surface_file(directory, name, frame) for name in muscles}

    def __getitem__(self, muscle: str) -> ModelSurface:
        return ModelSurface(*read_vtp(self._files[muscle]))

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def surface_file(directory: Path, name: str, frame: int) -> Path:
    """File of a muscle's surface, or of its tendons, in a frame."""
    return directory / "surfaces" / f"{name}_{frame:04d}.vtp"


def read_info(directory: Path) -> dict[str, Any]:
    """What ``run.json`` holds, checked; UsageError if it is missing or is none of a run's."""
    path = directory / "run.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        _check_info(info)
    except OSError:
        message = f"{directory} holds no run (no run.json); give the folder of 'run -o'"
        raise UsageError(message) from None
    except (ValueError, KeyError, TypeError) as error:
        message = f"{path} is not the run.json of a run ({error!r}); run the scene again"
        raise UsageError(message) from None
    return info


def read_run(directory: Path) -> tuple[dict[str, Any], list[Frame], list[Row], FolderMeshes]:
    """Facts, frames, metrics and meshes of the run in a folder, UsageError if it holds none.

    The frames lack what no file holds: material surfaces, and times of single muscles.
    """
    info = read_info(directory)
    poses = _read_poses(directory)
    if info.get("status") == "running":
        info["frames"] = _whole_frames(info, directory, poses)
    frames = _read_frames(info, directory, poses)
    return info, frames, _read_metrics(directory), FolderMeshes(directory)


def tendon_muscles(info: dict[str, Any]) -> dict[str, str]:
    """Muscle of each mesh of tendons, by the name of the mesh."""
    if not info["scene"]["output"].get("tendons"):
        return {}
    muscles = info["scene"]["muscles"]
    held = [m["name"] for m in muscles if any("tendon" in end for end in m.get("attach", ()))]
    return {tendon_name(name): name for name in held}


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
    scene["output"]["surfaces"]
    for frame in info["frames"]:
        if type(frame["frame"]) is not int or frame["frame"] < 0:
            raise ValueError(f"frame {frame['frame']!r}")


def _read_table(directory: Path, name: str) -> list[list[str]]:
    """Rows of a table, without its head; none where the file is missing."""
    path = directory / name
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]  # the last line of a run that was killed may be cut
    return list(csv.reader(io.StringIO(whole, newline="")))[1:]


def _read_metrics(directory: Path) -> list[Row]:
    rows = _read_table(directory, "metrics.csv")
    return [Row(int(r[0]), r[1], float(r[2]), r[3], r[4], float(r[5]), r[6]) for r in rows]


def _read_poses(directory: Path) -> Poses:
    found: Poses = {}
    for row in _read_table(directory, "poses.csv"):
        found.setdefault(int(row[0]), {})[row[1]] = np.array(row[2:], dtype=float).reshape(4, 4)
    return found


def _whole_frames(info: dict[str, Any], directory: Path, poses: Poses) -> list[dict[str, Any]]:
    """Entries of ``run.json`` for the frames of which every file is there."""
    planned = info.get("planned", [])
    scene = info["scene"]
    bones = {bone["name"] for bone in scene["bones"]}
    meshes = [*(muscle["name"] for muscle in scene["muscles"]), *tendon_muscles(info)]
    if not scene["output"]["surfaces"]:
        meshes = []
    return [
        {
            "frame": frame,
            "coordinates": planned[frame] if frame < len(planned) else {},
            "wall": None,
        }
        for frame, placed in poses.items()
        if set(placed) >= bones
        and all(surface_file(directory, name, frame).is_file() for name in meshes)
    ]


def _read_frames(info: dict[str, Any], directory: Path, poses: Poses) -> list[Frame]:
    scene = info["scene"]
    units = scene.get("coordinate_units", {})
    muscles = [muscle["name"] for muscle in scene["muscles"]]
    events: dict[int, list[Event]] = {}
    for row in _read_table(directory, "events.csv"):
        event = Event(int(row[0]), row[1], row[2], int(row[3]), row[4])
        events.setdefault(event.frame, []).append(event)
    found = []
    for entry in info["frames"]:
        index = entry["frame"]
        values = entry["coordinates"].items()
        frame = Frame(
            index,
            {name: value if name in units else math.radians(value) for name, value in values},
            poses.get(index, {}),
            FolderSurfaces(directory, muscles if scene["output"]["surfaces"] else [], index),
            {},
            events.get(index, []),
            {},
            entry["wall"],
            fibres=SavedFibres(directory, muscles, index),
        )
        found.append(frame)
    return found
