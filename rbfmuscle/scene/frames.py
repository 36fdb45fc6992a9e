"""The frames of a motion, made from ``[motion]``: ramps, waypoints and OpenSim motion files."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rbfmuscle.scene.joints.joint import Coordinate, Coupling, Joint, all_coordinates
from rbfmuscle.scene.joints.tables import FACTORS, full_name
from rbfmuscle.scene.motion_file import read_motion_file
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.options import MAX_FRAMES, MotionOptions
from rbfmuscle.validation import SceneError, UsageError, did_you_mean

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
        _refuse_followers(frames, followers, known)
    frames = [_with_rest(frame, known, followers) for frame in frames]
    notes += _range_notes(frames, known)
    frames = [
        {name: known[name].clamped_value(value) for name, value in frame.items()}
        for frame in frames
    ]
    return Motion(frames, options=options, times=times, notes=notes)


def check_coordinates(motion: Motion, joints: list[Joint]) -> None:
    """Raise SceneError if a motion moves a coordinate that no joint has."""
    known = all_coordinates(joints)
    for name in (name for frame in motion.frames for name in frame):
        if name not in known:
            hint = did_you_mean(name, sorted(known))
            raise SceneError(f"[motion]: unknown coordinate {name!r}, {hint}")


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
        example = "A:B:S (whole numbers, S not 0), for instance 0:46:5"
        raise UsageError(f"frames {text!r} must look like {example}") from None
    return slice(*numbers)


def pick_frames(motion: Motion, chosen: Sequence[int]) -> Motion:
    """Return the motion of some frames, in the order in which their places are given."""
    times = None if motion.times is None else [motion.times[k] for k in chosen]
    frames = [motion.frames[k] for k in chosen]
    return replace(motion, frames=frames, times=times, numbers=motion.numbers[list(chosen)])


def interpolate(before: dict[str, float], after: dict[str, float], t: float) -> dict[str, float]:
    """Return the values between two tables by name, linear in each; t = 0 gives ``before``, an
    absent one is 0.
    """
    names = [*before, *(name for name in after if name not in before)]
    return {name: (1 - t) * before.get(name, 0.0) + t * after.get(name, 0.0) for name in names}


def _asked_frames(options, known):
    """Frames of a ramp or of waypoints; the rest pose alone without either."""

    def named(table):
        return {
            full_name(name, list(known), context="[motion]"): value for name, value in table.items()
        }

    if options.ramp is not None:
        ramps = named(options.ramp)
        starts = {name: ramp.start for name, ramp in ramps.items() if ramp.start is not None}
        stops = [starts, {name: ramp.end for name, ramp in ramps.items()}]
        return _frames_between(stops, list(ramps), [ramp.step for ramp in ramps.values()], known)
    if options.waypoints is not None:
        stops = [named(stop) for stop in options.waypoints]
        names = list(dict.fromkeys(itertools.chain(*stops)))
        return _frames_between(stops, names, options.step or 1.0, known)
    return [{}]


def _frames_between(stops, names, steps, known):
    """Frames from stop to stop [degree or scene unit] in whole steps; the coordinate that needs
    most sets the pace.
    """
    table = np.array([[stop.get(name, np.nan) for name in names] for stop in stops]).reshape(
        len(stops), -1
    )
    factors = np.array([FACTORS[known[name].motion] for name in names])
    for column, name in enumerate(
        names
    ):  # what a stop does not mention stays where it was, at rest at first
        held = known[name].rest / factors[column]
        for row in range(len(stops)):
            held = table[row, column] = held if np.isnan(table[row, column]) else table[row, column]
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


def _refuse_followers(frames, followers, known):
    for name in dict.fromkeys(name for frame in frames for name in frame):
        if name in followers:
            raise SceneError(
                f"[motion]: {name!r} follows other coordinates by a coupling, move those"
            )
        rest = known[name].rest
        if known[name].locked and any(
            abs(frame.get(name, rest) - rest) > NOT_MOVED for frame in frames
        ):
            raise SceneError(
                f"[motion]: {name!r} is locked, unlock it in its joint or leave it out"
            )


def _with_rest(frame, known, followers):
    """The frame without followers; coordinates that it does not mention are at rest."""
    unsaid = {
        n: c.rest for n, c in known.items() if n not in frame and n not in followers and c.rest
    }
    return {**unsaid, **{name: value for name, value in frame.items() if name not in followers}}


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
