"""OpenSim motion files (``.mot``, ``.sto``): a header up to ``endheader``, column names, rows of numbers."""

import math
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints.joint import Coordinate
from rbfmuscle.scene.options import MAX_FRAMES
from rbfmuscle.validation import SceneError, is_file, shown_path

IN_DEGREES = dict.fromkeys(("yes", "true", "1"), math.pi / 180) | dict.fromkeys(("no", "false", "0"), 1.0)


def read_motion_file(
    path: Path, facts: dict[str, Coordinate], followers: set[str], *, metre: float
) -> tuple[list[dict[str, float]], list[float] | None, list[str]]:
    """Read the rows of a motion file as frames.

    Angles are turned from degrees where the header says ``inDegrees=yes``, lengths from metres; numbers of
    coordinates that are neither are taken as they are, as OpenSim does.

    Parameters
    ----------
    path : path
    facts : dict of str to Coordinate
        The scene's coordinates by full name.
    followers : set of str
        Coordinates that follow others; their columns are not used.
    metre : float
        Scene units in a metre.

    Returns
    -------
    frames, times, notes
        Times [s] where the file has a column ``time``, else None.
    """
    header, labels, values = _read_storage(path)
    if len(values) > MAX_FRAMES:
        raise SceneError(f"[motion]: {path} has {len(values)} rows, more than {MAX_FRAMES}")
    columns: dict[str, int] = {}
    for column, label in enumerate(labels):
        name = match_label(label, list(facts))
        if name in columns:
            raise SceneError(f"[motion]: {path} has two columns of coordinate {name!r}, leave one out")
        if name is not None:
            columns[name] = column
    if not columns:
        names = ", ".join(list(facts)[:20]) or "no joints"
        raise SceneError(f"[motion]: {path} has none of the scene's coordinates ({names})")
    used = [*columns.values(), *([labels.index("time")] if "time" in labels else [])]
    bad = np.argwhere(~np.isfinite(values[:, used]))
    if len(bad):
        row, column = bad[0]
        raise SceneError(f"[motion]: {path} row {row + 1}: {labels[used[column]]} is not a finite number")
    factor, notes = _angle_factor(path, header)
    units = {"rotation": factor, "translation": metre, "coupled": 1.0}
    tracks = {}
    for name, column in columns.items():
        if name in followers or facts[name].locked:
            why = "follows other coordinates" if name in followers else "is locked"
            notes.append(f"{path}: the column of {name!r} is not used, the coordinate {why}")
        else:
            tracks[name] = (values[:, column] * units[facts[name].motion]).tolist()
    frames = [{name: track[row] for name, track in tracks.items()} for row in range(len(values))]
    return frames, values[:, labels.index("time")].tolist() if "time" in labels else None, notes


def _read_storage(path: Path) -> tuple[dict[str, str], list[str], Floats]:
    """Header (lower case), labels of the columns, and values (rows, columns) of an OpenSim storage file."""
    if not is_file(path):
        raise SceneError(f"[motion]: cannot read {shown_path(path)}: no such file")
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise SceneError(f"[motion]: cannot read {path}: {error.strerror}") from None
    end = next((row for row, line in enumerate(lines) if line.strip().lower() == "endheader"), len(lines))
    if len(lines) < end + 3:
        words = "no 'endheader' line with columns and rows after it"
        raise SceneError(f"[motion]: {path} is no OpenSim motion: {words}")
    pairs = [line.lower().split("=", 1) for line in lines[:end] if "=" in line]
    labels, rows = lines[end + 1].split(), [line.split() for line in lines[end + 2 :] if line.strip()]
    for number, row in enumerate(rows, 1):
        if len(row) != len(labels):
            words = f"row {number} has {len(row)} values, the header names {len(labels)}"
            raise SceneError(f"[motion]: {path} {words}")
    try:
        values = np.array(rows, dtype=float)
    except ValueError as error:
        raise SceneError(f"[motion]: {path}: {error}") from None
    return {key.strip(): value.strip() for key, value in pairs}, labels, values


def match_label(label: str, known: list[str]) -> str | None:
    """Return the coordinate that a column is of: ``joint.coordinate``, ``coordinate`` or ``.../joint/name/value``."""
    parts = label.removesuffix("/value").split("/")
    for name in (label, ".".join(parts[-2:]), parts[-1]):
        owners = [full for full in known if name in (full, full.split(".", 1)[1])]
        if name in owners or len(owners) == 1:
            return name if name in owners else owners[0]
    return None


def _angle_factor(path, header):
    """Radians in the file's unit of angles, and a note where the header does not say it."""
    said = header.get("indegrees")
    if said is None:
        words = "angles are taken as radians; add inDegrees=yes to its header"
        return 1.0, [f"{path} does not say inDegrees: {words}"]
    if said not in IN_DEGREES:
        raise SceneError(f"[motion]: {path}: inDegrees={said} is neither yes nor no")
    return IN_DEGREES[said], []
