"""What a run that ended early has left in its folder, for one that goes on behind its last whole frame."""

from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rbfmuscle.study.files.checkpoint import NAME, read_checkpoint
from rbfmuscle.study.files.meshfiles import SUFFIXES
from rbfmuscle.study.files.runinfo import content_hash, versions
from rbfmuscle.study.files.writer import plain
from rbfmuscle.study.measure.quantities import Row
from rbfmuscle.validation import SceneWarning, UsageError

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene

# Where files lie, and how pages are drawn, changes nothing that is computed.
_NOT_COMPARED = {"file", "mesh", "report", "preview"}


class OtherRunError(UsageError):
    """A folder holds the run of another scene, of other settings or of another version."""


class LeftBehind(NamedTuple):
    """A run in a folder.

    Attributes
    ----------
    info : dict
        ``run.json``.
    state : dict or None
        What `Recording.go_on` needs; None for a run that is complete.
    rows : list of Row
        Metrics that were complete with the state's frame.
    """

    info: dict[str, Any]
    state: Any
    rows: list[Row]


def left_behind(directory: str | Path, scene: Scene) -> LeftBehind | None:
    """What can be gone on with in a folder; None where there is nothing.

    Parameters
    ----------
    directory : path
    scene : Scene
        As it shall be run.

    Raises
    ------
    OtherRunError
        If the run is that of another scene, of other settings or of another version.
    """
    directory = Path(directory)
    path = directory / "run.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        _require_same(info, scene, directory)
    except FileNotFoundError:
        return None
    except OtherRunError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path} is not the run.json of a run that can be resumed ({error!r}); run without --resume"
        ) from None
    if info["status"] == "complete":
        return LeftBehind(info, None, [])
    state = read_checkpoint(directory / NAME)
    if state is None:
        return None
    damaged = next(_damaged(directory, scene, state), None)
    if damaged is not None:
        warnings.warn(f"{damaged} is damaged or missing: the run starts anew", SceneWarning, stacklevel=3)
        return None
    return LeftBehind(info, state, _rows(directory, state["files"]["sizes"]))


def _require_same(info, scene, directory):
    """Refuse to go on with another run: the frames to come would not fit those that are there."""
    remedy = "run without --resume, or choose another folder"
    here = versions()
    for name, version in info["versions"].items():
        if here.get(name, version) != version:
            raise OtherRunError(
                f"{directory} was begun with {name} {version}, and this is {here[name]}: "
                f"the frames to come would not be the same; {remedy}"
            )
    found = _difference(info["scene"], plain(scene.resolved()))
    if found is None and info["content"] != content_hash(scene):
        found = "attached vertices, fibres, activations or the motion differ"
    if found is not None:
        raise OtherRunError(f"{directory} holds a run of another scene or other settings: {found}; {remedy}")


def _difference(there, here, place=""):
    """Words for the first difference of two trees, None where there is none."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in [*there, *(key for key in here if key not in there)]:
            if key in _NOT_COMPARED:
                continue
            found = _difference(there.get(key), here.get(key), f"{place} {key}".strip())
            if found is not None:
                return found
        return None
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for number, (one, other) in enumerate(zip(there, here), start=1):
            name = one.get("name", number) if isinstance(one, dict) else number
            found = _difference(one, other, f"{place} {name}")
            if found is not None:
                return found
        return None
    return None if there == here else f"{place} is {_short(there)} there and {_short(here)} here"


def _short(value):
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _damaged(directory: Path, scene: Scene, state: dict[str, Any]) -> Iterator[Path]:
    """Files of the frames that count which are not whole, as after the power has failed."""
    files = state["files"]
    for name, size in files["sizes"].items():
        if not _is_at_least(directory / name, size):
            yield directory / name
    for name, size in files["ends"].items():
        if not _is_at_least(directory / f"{name}.pvd", size):
            yield directory / f"{name}.pvd"
    surfaces = scene.output.surfaces
    if surfaces:
        suffix = SUFFIXES[surfaces.format]
        for frame in state["written"]:
            for muscle in scene.muscles:
                path = directory / "surfaces" / f"{muscle.name}_{frame['frame']:04d}{suffix}"
                if not _is_at_least(path, 1):
                    yield path
    for folder in ("surfaces", "bones"):
        for path in sorted((directory / folder).glob("*_[0-9][0-9][0-9][0-9]*.*")):
            if int(path.stem.rpartition("_")[2]) <= files["last"] and not _is_whole(path):
                yield path


def _is_at_least(path, size):
    return path.is_file() and path.stat().st_size >= size


def _is_whole(path):
    if path.suffix != ".vtp":
        return path.stat().st_size > 0
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - 16))
        return file.read().rstrip().endswith(b"</VTKFile>")


def _rows(directory, sizes):
    if "metrics.csv" not in sizes:
        return []
    data = (directory / "metrics.csv").read_bytes()[: sizes["metrics.csv"]]
    lines = csv.reader(data.decode("utf-8").splitlines()[1:])
    return [Row(int(r[0]), r[1], float(r[2]), r[3], r[4], float(r[5]), r[6]) for r in lines]
