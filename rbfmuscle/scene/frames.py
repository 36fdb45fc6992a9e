"""The frames of a motion, made from ``[motion]``: ramps, waypoints and OpenSim motion files
(``.mot``, ``.sto``), which are a header, column names, and rows of numbers.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints import (
    FACTORS,
    Coordinate,
    Coupling,
    Joint,
    all_coordinates,
    full_name,
)
from rbfmuscle.scene.objects import Motion, plain_name
from rbfmuscle.scene.options import MAX_FRAMES, MotionOptions
from rbfmuscle.validation import SceneError, UsageError, listed, read_text, shown


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
        raise SceneError(
            f"{context}{path} is no OpenSim motion: no 'endheader' line with columns and rows "
            "after it"
        )
    pairs = [line.lower().split("=", 1) for line in lines[:end] if "=" in line]
    labels = [label.strip("\"'") for label in lines[end + 1].split()]
    rows = [line.split() for line in lines[end + 2 :] if line.strip()]
    if not rows:
        raise SceneError(f"{context}{path} has no rows under its labels")
    numbers = []
    for number, row in enumerate(rows, 1):
        if len(row) != len(labels):
            raise SceneError(
                f"{context}{path} row {number} has {len(row)} values, the header names "
                f"{len(labels)}"
            )
        for label, text in zip(labels, row):
            try:
                numbers.append(float(text))
            except ValueError:
                more = "; part columns by tabs and write decimal points" if "," in text else ""
                raise SceneError(
                    f"{context}{path} row {number}: {shown(label)} is "
                    f"{shown(repr(text))}, not a number{more}"
                ) from None
    header = {key.strip(): value.strip() for key, value in pairs}
    return header, labels, np.array(numbers).reshape(len(rows), len(labels))


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
    said = header.get("indegrees")
    notes = []
    if said is None:
        notes.append(
            f"{path} does not say inDegrees: "
            "angles are taken as radians; add inDegrees=yes to its header"
        )
    elif said not in IN_DEGREES:
        raise SceneError(f"[motion]: {path}: inDegrees={said} is neither yes nor no")
    factor = IN_DEGREES.get(said or "no", 1.0)
    notes += _storage_notes(path, header, unknown, values.shape)
    times = values[:, labels.index("time")] if "time" in labels else None
    back = np.flatnonzero(np.diff([] if times is None else times) <= 0.0)
    if times is not None and len(back):
        row = int(back[0])
        notes.append(
            f"{path}: {len(back)} times do not increase, the first after row {row + 1}, "
            f"{times[row]:g} and {times[row + 1]:g} s; each row is a frame all the same"
        )
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
    return frames, None if times is None else times.tolist(), notes


def _storage_notes(path, header, unknown, shape):
    """Columns of a motion file that are of no coordinate, and rows or columns counted wrongly."""
    notes = []
    if unknown:
        labels = listed([shown(label) for label in unknown], MOST_LISTED)
        notes.append(f"{path}: columns of no coordinate of the scene are not used: {labels}")
    for count, what, old in zip(shape, ("nRows", "nColumns"), ("datarows", "datacolumns")):
        said = header.get(what.lower(), header.get(old))
        if said is not None and said != str(count):
            notes.append(
                f"{path}: {what} says {shown(said)}, {count} {what[1:].lower()} are there: is it "
                "whole?"
            )
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


def _degree_notes(path, known, tracks):
    """A question where angles that are read as radians can only be degrees."""
    for name, track in tracks.items():
        most = float(np.abs(track).max())
        ends = known[name].range or (-TURN, TURN)
        if most > min(TURN, max(math.pi, 1.5 * max(map(abs, ends)))):
            return [
                f"{path}: {name} reaches {most:.4g} radians, {most / TURN:.3g} turns: does the "
                "file mean degrees (inDegrees=yes)?"
            ]
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


NOT_MOVED = 1e-9  # A locked coordinate may be given, at its rest value.
# Share of a turn [radian] or of a length that rounding may take a coordinate beyond its range.
RANGE_TOLERANCE = 1e-6


def make_motion(
    options: MotionOptions, joints: list[Joint], couplings: list[Coupling], *, metre: float
) -> Motion:
    """The motion that ``[motion]`` asks of joints; ``metre`` is one in scene units.

    SceneError on an unknown coordinate, too many frames, or a file that cannot be read.
    """
    known = all_coordinates(joints)
    followers = {coupling.coordinate for coupling in couplings}
    times, notes = None, []
    if options.file is not None:
        frames, times, notes = read_motion_file(options.file, known, followers, metre=metre)
    else:
        frames = _asked_frames(options, known)
        for name in dict.fromkeys(name for frame in frames for name in frame):
            if name in followers:
                raise SceneError(
                    f"[motion]: {name!r} follows other coordinates by a coupling, move those"
                )
            moved = [abs(frame.get(name, known[name].rest) - known[name].rest) for frame in frames]
            if known[name].locked and max(moved) > NOT_MOVED:
                raise SceneError(
                    f"[motion]: {name!r} is locked, unlock it in its joint or leave it out"
                )
    # Followers are left out; coordinates that a frame does not mention are at rest.
    free = {name: one.rest for name, one in known.items() if name not in followers}
    at_rest = {name: rest for name, rest in free.items() if rest}
    frames = [at_rest | {name: frame[name] for name in frame if name in free} for frame in frames]
    notes += _range_notes(frames, known)
    frames = [
        {name: known[name].clamped_value(value) for name, value in frame.items()}
        for frame in frames
    ]
    return Motion(frames, options=options, times=times, notes=notes)


def slice_motion(motion: Motion, frames: slice | str) -> Motion:
    """Return the motion of the frames in a slice or "A:B:S", as ``frames[A:B:S]`` does."""
    frames = parse_slice(frames) if isinstance(frames, str) else frames
    chosen = range(len(motion))[frames]
    if not chosen:
        text = f"{frames.start}:{frames.stop}:{frames.step}".replace("None", "")
        raise SceneError(f"frames {text} selects none of the {len(motion)} frames of the motion")
    return pick_frames(motion, chosen)


def parse_slice(text: str) -> slice:
    """Return the slice of "A:B:S" (each part may be empty), or of a single frame "A"."""
    try:
        numbers = [int(part) if part.strip() else None for part in text.split(":")]
        if len(numbers) == 1:
            first = int(text)
            return slice(first, first + 1 or None)
        if len(numbers) > 3 or numbers[2:] == [0]:
            raise ValueError
    except ValueError:
        raise UsageError(
            f"frames {text!r} must look like A:B:S (whole numbers, S not 0), for instance 0:46:5"
        ) from None
    return slice(*numbers)


def pick_frames(motion: Motion, chosen: Sequence[int]) -> Motion:
    """Return the motion of some frames, in the order in which their places are given."""
    times = None if motion.times is None else [motion.times[k] for k in chosen]
    return replace(
        motion,
        frames=[motion.frames[k] for k in chosen],
        times=times,
        numbers=motion.numbers[list(chosen)],
    )


def interpolate(before: dict[str, float], after: dict[str, float], t: float) -> dict[str, float]:
    """Return the values between two tables by name, linear in each; t = 0 gives ``before``, an
    absent one is 0.
    """
    names = [*before, *(name for name in after if name not in before)]
    return {name: (1 - t) * before.get(name, 0.0) + t * after.get(name, 0.0) for name in names}


def _asked_frames(options, known):
    """Frames of a ramp or of waypoints; the rest pose alone without either.

    They go from stop to stop [degree or scene unit] in whole steps; the coordinate that needs most
    sets the pace.
    """

    def named(table):
        return {
            full_name(name, list(known), context="[motion]"): value for name, value in table.items()
        }

    if options.ramp is not None:
        ramps = named(options.ramp)
        names = list(ramps)
        steps = [ramp.step for ramp in ramps.values()]
        starts = {name: ramp.start for name, ramp in ramps.items() if ramp.start is not None}
        stops = [starts, {name: ramp.end for name, ramp in ramps.items()}]
    elif options.waypoints is not None:
        stops = [named(stop) for stop in options.waypoints]
        steps = options.step or 1.0
        names = list(dict.fromkeys(itertools.chain(*stops)))
    else:
        return [{}]
    factors = np.array([FACTORS[known[name].motion] for name in names])
    # What a stop does not mention stays where it was, at rest at first.
    held = {name: known[name].rest / factor for name, factor in zip(names, factors)}
    table = np.empty((len(stops), len(names)))
    for row, stop in zip(table, stops):
        held |= stop
        row[:] = list(held.values())
    rows = [table[0]]
    with np.errstate(over="ignore"):
        paces = (np.abs(np.diff(table, axis=0)) / steps).max(axis=1, initial=0.0)
        count = np.ceil(paces).sum()
    if not count <= MAX_FRAMES:
        raise SceneError(
            f"[motion]: about {count:.3g} frames, more than {MAX_FRAMES}: a step is too small for "
            "its range; "
            "make the step larger or the range smaller"
        )
    for pace, (before, after) in zip(paces.tolist(), itertools.pairwise(table)):
        # At whole steps, then the end: 2.5 steps give 0.4, 0.8, 1 of the path.
        marks = [*(k / pace for k in range(1, math.ceil(pace - 1e-9))), 1.0] if pace else []
        rows.extend(before + t * (after - before) for t in marks)
    return [dict(zip(names, (row * factors).tolist())) for row in rows]


def _range_notes(frames: list[dict[str, float]], known: dict[str, Coordinate]) -> list[str]:
    notes = []
    for name, coordinate in known.items():
        if coordinate.range is None or coordinate.locked:
            continue
        low, high = coordinate.range
        beyond = [max(low - frame[name], frame[name] - high) for frame in frames if name in frame]
        beyond = [
            excess for excess in beyond if excess > RANGE_TOLERANCE * max(1.0, abs(low), abs(high))
        ]
        if beyond:
            what = "is cut to" if coordinate.clamped else "leaves"
            low, high, most = (x / FACTORS[coordinate.motion] for x in (low, high, max(beyond)))
            notes.append(
                f"coordinate {name!r} {what} its range {low:.6g} to {high:.6g} in {len(beyond)} "
                f"of {len(frames)} "
                f"frames, by up to {most:.3g}"
            )
    return notes
