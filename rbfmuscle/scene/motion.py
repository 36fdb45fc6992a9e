"""From joint coordinates to the poses of bones: ramps, waypoints and OpenSim motion files."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.scene.joints.skeleton import (
    all_coordinates,
    beyond_range,
    joint_poses,
    joint_values,
    rest_values,
)
from rbfmuscle.scene.joints.tables import FACTORS, full_name
from rbfmuscle.scene.motion_file import read_motion_file
from rbfmuscle.scene.options import MotionOptions
from rbfmuscle.validation import SceneError, did_you_mean

if TYPE_CHECKING:
    from rbfmuscle.scene.objects import Joint
    from rbfmuscle.scene.scene import Scene


__all__ = ["Motion", "bone_poses", "coordinate_names", "interpolate", "rotation_about"]

MAX_FRAMES = 100_000


class Motion:
    """The frames of a motion, each a dict of "joint.coordinate" -> value [radian or scene unit].

    Parameters
    ----------
    frames : list of dict
        One dict a written frame; a coordinate that is absent stays at rest.
    options : MotionOptions, optional
        What the frames were made from.
    times : list of float, optional
        Time of each frame [s], where a motion file gives it.
    progress : (n,) ndarray, optional
        Where each frame lies in the whole motion, 0 to 1; even where not given.
    notes : list of str
        What a user should know: coordinates that leave their range, columns that were not used.
    """

    def __init__(
        self,
        frames: list[dict[str, float]] | None = None,
        *,
        options: MotionOptions | None = None,
        times: list[Any] | None = None,
        progress: np.ndarray | None = None,
        notes: Sequence[Any] = (),
    ) -> None:
        self.frames = [dict(frame) for frame in frames] if frames is not None else [{}]
        self.options = options or MotionOptions()
        self.times = None if times is None else list(times)
        self.progress = np.linspace(0.0, 1.0, len(self.frames)) if progress is None else progress
        self.notes = list(notes)

    @classmethod
    def from_options(
        cls,
        options: MotionOptions,
        joints: list[Joint],
        *,
        couplings: Sequence[Any] = (),
        metre: float = 1000.0,
        folder: str | Path | None = None,
    ) -> Motion:
        """Return the motion that ``[motion]`` asks for.

        Parameters
        ----------
        options : MotionOptions
        joints : list of Joint
            Their coordinates are the names that may be used.
        couplings : list of Coupling
            Coordinates that follow others cannot be asked for.
        metre : float
            Scene units in a metre: OpenSim files are in metres.
        folder : path, optional
            What a relative ``file`` is relative to.

        Raises
        ------
        SceneError
            If a coordinate is unknown, the motion has too many frames, or its file cannot be read.
        """
        known, times, notes = coordinate_names(joints), None, []
        facts = all_coordinates(joints)
        followers = {coupling.coordinate for coupling in couplings}
        if options.ramp is not None:
            ramps = {full_name(n, known, place="[motion]"): ramp for n, ramp in options.ramp.items()}
            frames = _ramp_frames(ramps, facts)
        elif options.waypoints is not None:
            stops = [
                {full_name(n, known, place="[motion]"): v for n, v in s.items()} for s in options.waypoints
            ]
            frames = _waypoint_frames(stops, options.step, facts)
        elif options.file is not None:
            path = Path(folder or ".") / options.file
            frames, times, notes = read_motion_file(
                path, facts, followers, metre=metre, degrees=options.degrees, most=MAX_FRAMES
            )
        else:
            frames = [{}]
        if options.file is None:
            _refuse_followers(frames, followers, facts)
        frames = [_honoured(frame, facts, followers) for frame in frames]
        notes += _range_notes(frames, joints)
        frames = [{name: facts[name].honoured(value) for name, value in frame.items()} for frame in frames]
        return cls(frames, options=options, times=times, notes=notes)

    @property
    def coordinates(self) -> list[Any]:
        """Names of the coordinates that change, the one with the widest range first."""
        names = sorted({name for frame in self.frames for name in frame})
        spans = {name: np.ptp([frame.get(name, 0.0) for frame in self.frames]) for name in names}
        return sorted((name for name in names if spans[name] > 0), key=lambda name: -spans[name])

    def check_names(self, known: Collection[str]) -> None:
        """Raise SceneError if a frame names a coordinate that is not among those known."""
        for name in (name for frame in self.frames for name in frame):
            if name not in known:
                raise SceneError(
                    f"[motion]: unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}"
                )

    def sliced(self, frames: slice) -> Motion:
        """Return the motion of the frames in a slice, as ``frames[A:B:S]`` does."""
        chosen = self.frames[frames]
        if not chosen:
            raise SceneError(
                f"frames {_slice_text(frames)} selects none of the {len(self.frames)} frames of the motion"
            )
        times = None if self.times is None else self.times[frames]
        progress = self.progress[frames]
        return Motion(chosen, options=self.options, times=times, progress=progress, notes=self.notes)

    def __len__(self) -> int:
        return len(self.frames)


def coordinate_names(joints: list[Joint]) -> list[str]:
    """Return every "joint.coordinate" of the joints, in order."""
    return list(all_coordinates(joints))


def rest_coordinates(scene: Scene) -> Any:
    """Return the coordinates whose rest value is not zero, by full name [radian or scene unit]."""
    if not any(facts.rest for joint in scene.joints for facts in joint.coordinates.values()):
        return {}
    return {name: value for name, value in rest_values(scene.joints, scene.couplings).items() if value}


def completed(scene: Scene, coordinates: Any) -> Any:
    """Return coordinates with those that are absent at rest added, where rest is not zero."""
    return {**rest_coordinates(scene), **coordinates}


def interpolate(before: dict[str, Any], after: dict[str, float], t: float) -> dict[str, float]:
    """Return the coordinates between two frames, linear in each.

    Parameters
    ----------
    before, after : dict of str -> float
        Coordinates [radian]; an absent one is 0.
    t : float
        0 gives ``before``, 1 gives ``after``.
    """
    names = [*before, *(name for name in after if name not in before)]
    return {name: (1 - t) * before.get(name, 0.0) + t * after.get(name, 0.0) for name in names}


def bone_poses(scene: Scene, coordinates: dict[str, Any]) -> dict[str, Floats]:
    """Return the pose of every bone: rest bone coordinates -> world.

    A joint moves its child, and all that hangs on it, against its parent. At the coordinates at which the
    scene's meshes are (``rest``), every pose is the identity. A bone without a joint is fixed.

    Parameters
    ----------
    scene : Scene
    coordinates : dict of str -> float
        "joint.coordinate" -> value [radian or scene unit]; absent ones are at rest.

    Returns
    -------
    dict of str -> (4, 4) ndarray
    """
    known = all_coordinates(scene.joints)
    for name in coordinates:
        if name not in known:
            raise SceneError(f"unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}")
    return joint_poses([bone.name for bone in scene.bones], scene.joints, scene.couplings, coordinates)


# Lever [mm] at which a shift of a joint is counted as a turn.
SHIFT_LEVER = 50.0


def step_angle(scene: Scene, before: Any, after: Any, *, shifts: bool = True) -> Any:
    """Return the largest turn of a bone against its parent between two sets of coordinates [radian].

    With ``shifts``, a shift counts as the turn that moves a place 50 mm from its axis as far.
    """
    first, second = (joint_values(scene.joints, scene.couplings, q) for q in (before, after))
    lever, largest = scene.length(SHIFT_LEVER), 0.0
    for joint in scene.joints:
        if first[joint.name] == second[joint.name]:
            continue
        rest = joint_values(scene.joints, scene.couplings, {})[joint.name]
        motion = joint.motion(second[joint.name], rest) @ np.linalg.inv(joint.motion(first[joint.name], rest))
        largest = max(largest, turned_angle(motion[:3, :3]))
        if shifts and joint.translations:
            shift = motion[:3, :3] @ joint.centre + motion[:3, 3] - joint.centre
            largest = max(largest, float(np.linalg.norm(shift)) / lever)
    return largest


def turned_angle(rotations: Floats) -> Floats:
    """Angles (...) of rotations (..., 3, 3) [radian], accurate for small ones too."""
    skew = rotations - np.swapaxes(rotations, -1, -2)
    length = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.arctan2(length, np.trace(rotations, axis1=-2, axis2=-1) - 1.0)


def shown_value(scene: Scene, name: str, value: Any) -> Any:
    """Return a coordinate's value as files and tables show it: degrees, or scene units as it is."""
    facts = all_coordinates(scene.joints).get(name)
    return math.degrees(value) if facts is None or facts.motion == "rotation" else value


def inner_value(scene: Scene, name: str, value: Any) -> Any:
    """Return a coordinate's value [radian or scene unit] from what files and tables show."""
    facts = all_coordinates(scene.joints).get(name)
    return math.radians(value) if facts is None or facts.motion == "rotation" else value


def unit_sign(scene: Scene, name: str) -> Any:
    """Return what follows a coordinate's value in text: the sign for degrees, the scene's unit, or nothing."""
    facts = all_coordinates(scene.joints).get(name)
    return {"translation": f" {scene.units}", "coupled": ""}.get(facts.motion if facts else "", "°")


def _refuse_followers(frames, followers, facts):
    for name in dict.fromkeys(name for frame in frames for name in frame):
        if name in followers:
            raise SceneError(f"[motion]: {name!r} follows other coordinates by a coupling, move those")
        if facts[name].locked and any(
            abs(frame.get(name, facts[name].rest) - facts[name].rest) > 1e-9 for frame in frames
        ):
            raise SceneError(f"[motion]: {name!r} is locked, unlock it in its joint or leave it out")


def _honoured(frame, facts, followers):
    """The frame with coordinates that it does not mention where their default says, without those that follow."""
    unsaid = {n: c.resting for n, c in facts.items() if n not in frame and n not in followers and c.resting}
    return {**unsaid, **{name: value for name, value in frame.items() if name not in followers}}


def _range_notes(frames, joints):
    facts, worst, count = all_coordinates(joints), {}, {}
    for frame in frames:
        for name, excess in beyond_range(frame, joints).items():
            worst[name], count[name] = max(worst.get(name, 0.0), excess), count.get(name, 0) + 1
    notes = []
    for name, excess in worst.items():
        low, high = (end / FACTORS[facts[name].motion] for end in facts[name].range)
        what = "is cut to" if facts[name].clamped else "leaves"
        excess /= FACTORS[facts[name].motion]
        notes.append(
            f"coordinate {name!r} {what} its range {low:.6g} to {high:.6g} in {count[name]} of {len(frames)} frames, "
            f"by up to {excess:.3g}"
        )
    return notes


def _ramp_frames(ramps, facts):
    """All coordinates go together; the one that needs most steps sets the pace, its last may be short."""
    start = {n: _start(ramp.start, facts[n]) for n, ramp in ramps.items()}
    pace = max((abs(ramp.end - start[n]) / ramp.step for n, ramp in ramps.items()), default=0.0)
    return [
        {n: (start[n] + t * (r.end - start[n])) * FACTORS[facts[n].motion] for n, r in ramps.items()}
        for t in _marks(pace)
    ]


def _start(value, facts):
    """A ramp that says no start begins at the coordinate's default."""
    return facts.resting / FACTORS[facts.motion] if value is None else value


def _waypoint_frames(stops, step, facts):
    names = list(dict.fromkeys(name for stop in stops for name in stop))
    table = np.array([[stop.get(name, np.nan) for name in names] for stop in stops])
    for column, name in enumerate(names):  # what a waypoint does not mention stays where it was
        held = _start(None, facts[name])
        for row in range(len(stops)):
            held = table[row, column] = held if np.isnan(table[row, column]) else table[row, column]
    rows = [table[0]]
    with np.errstate(over="ignore"):
        paces = np.abs(np.diff(table, axis=0)).max(axis=1, initial=0.0) / step
        _check_count(np.ceil(paces).sum())
    for pace, (before, after) in zip(paces.tolist(), itertools.pairwise(table)):
        rows.extend(before + t * (after - before) for t in _marks(pace)[1:])
    factors = np.array([FACTORS[facts[name].motion] for name in names])
    return [dict(zip(names, (row * factors).tolist())) for row in rows]


def _marks(pace):
    """Fractions of the way at whole steps, then the end: 2.5 steps give 0, 0.4, 0.8, 1."""
    _check_count(pace)
    if pace == 0:
        return [0.0]
    count = math.ceil(pace - 1e-9)
    return [*(k / pace for k in range(count)), 1.0]


def _check_count(count):
    if not count <= MAX_FRAMES:
        raise SceneError(
            f"[motion]: about {count:.3g} frames, more than {MAX_FRAMES}: a step is too small for its range; "
            "make the step larger or the range smaller"
        )


def _slice_text(frames):
    return ":".join("" if part is None else str(part) for part in (frames.start, frames.stop, frames.step))
