"""OpenSim motion files (``.mot``, ``.sto``): a header up to ``endheader``, column names, rows of numbers."""

import math
from pathlib import Path

from rbfmuscle.scene.joints.joint import Coordinate
from rbfmuscle.scene.options import MAX_FRAMES
from rbfmuscle.validation import SceneError, is_file, shown_path

NO = ("no", "false", "0")
YES = ("yes", "true", "1")


def read_motion_file(
    path: Path,
    facts: dict[str, Coordinate],
    followers: set[str],
    *,
    metre: float,
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

    Raises
    ------
    SceneError
        Naming the file and what is wrong in it.
    """
    header, labels, rows = storage_parts(path)
    if len(rows) > MAX_FRAMES:
        raise SceneError(f"[motion]: {path} has {len(rows)} rows, more than {MAX_FRAMES}")
    known = list(facts)
    used = {column: name for column, label in enumerate(labels) if (name := match_label(label, known))}
    if not used:
        names = ", ".join(known[:20]) or "no joints"
        raise SceneError(f"[motion]: {path} has none of the scene's coordinates ({names})")
    _check_twice(path, used)
    in_degrees, notes = _angle_unit(path, header)
    idle = [name for name in used.values() if name in followers or facts[name].locked]
    notes += [_idle_note(path, name, name in followers) for name in idle]
    units = {"rotation": math.pi / 180 if in_degrees else 1.0, "translation": metre, "coupled": 1.0}
    factor = {name: units[facts[name].motion] for name in used.values()}
    frames, times = [], []
    clock = [labels.index("time")] if "time" in labels else []
    for number, row in enumerate(rows):
        values = _numbers(row, len(labels), f"{path} row {number + 1}", [*used, *clock])
        times += [values[column] for column in clock]
        frames.append({name: values[k] * factor[name] for k, name in used.items() if name not in idle})
    return frames, times if clock else None, notes


def match_label(label: str, known: list[str]) -> str | None:
    """Return the coordinate that a column is of: ``joint.coordinate``, ``coordinate`` or ``.../joint/name/value``."""
    parts = label.removesuffix("/value").split("/")
    for name in (label, ".".join(parts[-2:]), parts[-1]):
        if name in known:
            return name
        owners = [full for full in known if full.split(".", 1)[1] == name]
        if len(owners) == 1:
            return owners[0]
    return None


def storage_parts(
    path: Path, *, place: str = "[motion]"
) -> tuple[dict[str, str], list[str], list[list[str]]]:
    """Header, labels of the columns and rows, as words, of an OpenSim storage; errors begin with ``place``."""
    if not is_file(path):
        raise SceneError(f"{place}: cannot read {shown_path(path)}: no such file")
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise SceneError(f"{place}: cannot read {path}: {error.strerror}") from None
    ends = [row for row, line in enumerate(lines) if line.strip().lower() == "endheader"]
    if not ends or len(lines) < ends[0] + 3:
        raise SceneError(
            f"{place}: {path} is no OpenSim motion: no 'endheader' line with columns and rows after it"
        )
    header = dict(line.split("=", 1) for line in lines[: ends[0]] if "=" in line)
    header = {key.strip().lower(): value.strip().lower() for key, value in header.items()}
    rows = [line.split() for line in lines[ends[0] + 2 :] if line.strip()]
    return header, lines[ends[0] + 1].split(), rows


def _angle_unit(path, header):
    """Whether angles are degrees, and a note where the header does not say."""
    said = header.get("indegrees")
    if said in NO or said in YES:
        return said in YES, []
    if said is not None:
        raise SceneError(f"[motion]: {path}: inDegrees={said} is neither yes nor no")
    return False, [
        f"{path} does not say inDegrees: angles are taken as radians; add inDegrees=yes to its header"
    ]


def _idle_note(path, name, follows):
    why = "follows other coordinates" if follows else "is locked"
    return f"{path}: the column of {name!r} is not used, the coordinate {why}"


def _check_twice(path, used):
    names = list(used.values())
    for name in names:
        if names.count(name) > 1:
            raise SceneError(f"[motion]: {path} has two columns of coordinate {name!r}, leave one out")


def _numbers(row, width, place, columns):
    if len(row) != width:
        raise SceneError(f"[motion]: {place} has {len(row)} values, the header names {width}")
    try:
        values = {column: float(row[column]) for column in columns}
    except ValueError as error:
        raise SceneError(f"[motion]: {place}: {error}") from None
    for column, value in values.items():
        if not math.isfinite(value):
            raise SceneError(f"[motion]: {place}: column {column + 1} is {value}")
    return values
