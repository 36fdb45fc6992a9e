"""OpenSim motion files (``.mot``, ``.sto``): a header, column names, and rows of numbers."""

import math
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints.joint import Coordinate
from rbfmuscle.scene.names import plain_name
from rbfmuscle.scene.options import MAX_FRAMES
from rbfmuscle.validation import SceneError, read_text, shown


def read_storage(
    path: Path, *, context: str = "[motion]: "
) -> tuple[dict[str, str], list[str], Floats]:
    """Header (lower case), labels of the columns, and values (rows, columns) of an OpenSim storage
    file; ``context`` begins each message.
    """
    lines = read_text(path, context=context).splitlines()
    end = next(
        (row for row, line in enumerate(lines) if line.strip().lower() == "endheader"), len(lines)
    )
    if len(lines) < end + 3:
        words = "no 'endheader' line with columns and rows after it"
        raise SceneError(f"{context}{path} is no OpenSim motion: {words}")
    pairs = [line.lower().split("=", 1) for line in lines[:end] if "=" in line]
    labels = [label.strip("\"'") for label in lines[end + 1].split()]
    rows = [line.split() for line in lines[end + 2 :] if line.strip()]
    for number, row in enumerate(rows, 1):
        if len(row) != len(labels):
            words = f"row {number} has {len(row)} values, the header names {len(labels)}"
            raise SceneError(f"{context}{path} {words}")
    if not rows:
        raise SceneError(f"{context}{path} has no rows under its labels")
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        raise SceneError(f"{context}{path} {_first_text(rows, labels)}") from None
    return {key.strip(): value.strip() for key, value in pairs}, labels, values


def _first_text(rows: list[list[str]], labels: list[str]) -> str:
    """Where the first value stands that is no number, and what to do."""
    for number, row in enumerate(rows, 1):
        for label, text in zip(labels, row):
            try:
                float(text)
            except ValueError:
                more = "; part columns by tabs and write decimal points" if "," in text else ""
                return f"row {number}: {shown(label)} is {shown(repr(text))}, not a number{more}"
    return "has rows that are no numbers"


TURN = 2.0 * math.pi  # [radian]
MOST_LISTED = 8  # columns that a note lists
# A row jumps that is this far [radian] from those beside it, and this many times farther than these
# are from each other and than the other steps, in the median.
SPIKE = math.radians(30.0)
SPIKE_RATIO = 3.0
IN_DEGREES = dict.fromkeys(("yes", "true", "1"), math.pi / 180) | dict.fromkeys(
    ("no", "false", "0"), 1.0
)


def read_motion_file(
    path: Path, known: dict[str, Coordinate], followers: set[str], *, metre: float
) -> tuple[list[dict[str, float]], list[float] | None, list[str]]:
    """Frames, times [s] (None without a column ``time``) and notes of an OpenSim motion file.

    It holds a header up to ``endheader``, column names and rows of numbers. Angles are turned from
    degrees where the header says ``inDegrees=yes``, lengths from metres, ``metre`` scene units
    each; numbers of coordinates that are neither are taken as they are, as OpenSim does. ``known``
    are the scene's coordinates by full name; columns of ``followers``, which follow others, are not
    used.
    """
    header, labels, values = read_storage(path)
    if len(values) > MAX_FRAMES:
        raise SceneError(f"[motion]: {path} has {len(values)} rows, more than {MAX_FRAMES}")
    columns, unknown = _match_columns(path, labels, list(known))
    if not columns:
        names = ", ".join(list(known)[:20]) or "no joints"
        raise SceneError(f"[motion]: {path} has none of the scene's coordinates ({names})")
    used = [*columns.values(), *([labels.index("time")] if "time" in labels else [])]
    bad = np.argwhere(~np.isfinite(values[:, used]))
    if len(bad):
        row, column = bad[0]
        raise SceneError(
            f"[motion]: {path} row {row + 1}: {labels[used[column]]} is not a finite number"
        )
    factor, notes = _angle_factor(path, header)
    notes += _storage_notes(path, header, unknown, values.shape)
    if "time" in labels:
        notes += _time_notes(path, values[:, labels.index("time")])
    turns = {name: column for name, column in columns.items() if known[name].motion == "rotation"}
    if factor == 1.0:
        tracks = {name: values[:, column] for name, column in turns.items()}
        notes += _degree_notes(path, known, tracks)
    units = {"rotation": factor, "translation": metre, "coupled": 1.0}
    tracks = {}
    for name, column in columns.items():
        if name in followers or known[name].locked:
            why = "follows other coordinates" if name in followers else "is locked"
            notes.append(f"{path}: the column of {name!r} is not used, the coordinate {why}")
        else:
            tracks[name] = (values[:, column] * units[known[name].motion]).tolist()
    notes += _spike_notes(path, {name: tracks[name] for name in turns if name in tracks})
    frames = [{name: track[row] for name, track in tracks.items()} for row in range(len(values))]
    return frames, values[:, labels.index("time")].tolist() if "time" in labels else None, notes


def _storage_notes(path, header, unknown, shape):
    """Columns of a motion file that are of no coordinate, and rows or columns counted wrongly."""
    notes = []
    if unknown:
        more = f" and {len(unknown) - MOST_LISTED} more" if len(unknown) > MOST_LISTED else ""
        listed = ", ".join(map(shown, unknown[:MOST_LISTED]))
        notes.append(f"{path}: columns of no coordinate of the scene are not used: {listed}{more}")
    for count, what, old in zip(shape, ("nRows", "nColumns"), ("datarows", "datacolumns")):
        said = header.get(what.lower(), header.get(old))
        if said is not None and said != str(count):
            there = f"{count} {what[1:].lower()} are there"
            notes.append(f"{path}: {what} says {shown(said)}, {there}: is it whole?")
    return notes


def _spike_notes(path, tracks):
    """One row of a coordinate that lies far from those before and after, which are near to each
    other.
    """
    notes = []
    for name, track in tracks.items():
        steps = np.diff(track)
        beside = np.abs(steps[:-1] + steps[1:])
        way = np.minimum(np.abs(steps[:-1]), np.abs(steps[1:]))
        rows = np.flatnonzero((way > SPIKE) & (way > SPIKE_RATIO * beside))
        # Of three rows there are no other steps.
        rows = rows if len(steps) > 2 else rows[:0]
        usual = [np.median(np.abs(np.delete(steps, [row, row + 1]))) for row in rows]
        rows = rows[way[rows] > SPIKE_RATIO * np.array(usual)] if len(rows) else rows
        if len(rows):
            row = int(rows[np.argmax(way[rows])])
            jump = f"{math.degrees(way[row]):.4g} degrees from the rows before and after"
            others = f", and {len(rows) - 1} rows more" if len(rows) > 1 else ""
            notes.append(f"{path} row {row + 2}: {name} jumps {jump}{others}: is the row right?")
    return notes


def _time_notes(path, times):
    """Times that do not increase."""
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if not len(back):
        return []
    row = int(back[0])
    words = f"the first after row {row + 1}, {times[row]:g} and {times[row + 1]:g} s"
    return [f"{path}: {len(back)} times do not increase, {words}; each row is a frame all the same"]


def _degree_notes(path, known, tracks):
    """A question where angles that are read as radians can only be degrees."""
    for name, track in tracks.items():
        most = float(np.abs(track).max())
        ends = known[name].range or (-TURN, TURN)
        if most > min(TURN, max(math.pi, 1.5 * max(map(abs, ends)))):
            what = f"{name} reaches {most:.4g} radians, {most / TURN:.3g} turns"
            return [f"{path}: {what}: does the file mean degrees (inDegrees=yes)?"]
    return []


def _match_columns(path, labels, known):
    """The column of each coordinate that a file has, and labels of columns that are of none."""
    columns: dict[str, int] = {}
    unknown = []
    for column, label in enumerate(labels):
        name = match_label(label, known)
        if name is None and label.lower() != "time":
            several = [full for full in known if full.split(".", 1)[1] == label.split("/")[-1]]
            unknown.append(f"{label} (of {' or '.join(several)})" if several else label)
        if name in columns:
            raise SceneError(
                f"[motion]: {path} has two columns of coordinate {name!r}, leave one out"
            )
        if name is not None:
            columns[name] = column
    return columns, unknown


def match_label(label: str, known: list[str]) -> str | None:
    """Return the coordinate that a column is of: ``joint.coordinate``, ``coordinate`` or
    ``.../joint/name/value``.
    """
    parts = label.removesuffix("/value").split("/")
    plain = [plain_name(part) for part in parts]
    for name in (label, ".".join(parts[-2:]), parts[-1], ".".join(plain[-2:]), plain[-1]):
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
