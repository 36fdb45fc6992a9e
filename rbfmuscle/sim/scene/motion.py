"""From joint coordinates to the poses of bones: ramps, waypoints and OpenSim motion files."""

import itertools
import math
from pathlib import Path

import numpy as np

from rbfmuscle.sim.scene.options import MotionOptions, did_you_mean
from rbfmuscle.validation import SceneError

MAX_FRAMES = 100_000


class Motion:
    """The frames of a motion, each a dict of "joint.coordinate" -> angle [radian].

    Parameters
    ----------
    frames : list of dict
        One dict a written frame; a coordinate that is absent stays at rest (0).
    options : MotionOptions, optional
        What the frames were made from.
    """

    def __init__(self, frames=None, *, options=None):
        self.frames = [dict(frame) for frame in frames] if frames is not None else [{}]
        self.options = options or MotionOptions()

    @classmethod
    def from_options(cls, options, joints, *, folder=None):
        """Return the motion that ``[motion]`` asks for.

        Parameters
        ----------
        options : MotionOptions
        joints : list of Joint
            Their coordinates are the names that may be used.
        folder : path, optional
            What a relative ``file`` is relative to.

        Raises
        ------
        SceneError
            If a coordinate is unknown, the motion has too many frames, or its file cannot be read.
        """
        known = coordinate_names(joints)
        if options.ramp is not None:
            frames = _ramp_frames({_known(name, known): ramp for name, ramp in options.ramp.items()})
        elif options.waypoints is not None:
            stops = [{_known(name, known): v for name, v in stop.items()} for stop in options.waypoints]
            frames = _waypoint_frames(stops, options.step)
        elif options.file is not None:
            frames = _file_frames(Path(folder or ".") / options.file, known)
        else:
            frames = [{}]
        return cls(frames, options=options)

    @property
    def coordinates(self):
        """Names of the coordinates that change, the one with the widest range first."""
        names = sorted({name for frame in self.frames for name in frame})
        spans = {name: np.ptp([frame.get(name, 0.0) for frame in self.frames]) for name in names}
        return sorted((name for name in names if spans[name] > 0), key=lambda name: -spans[name])

    def sliced(self, frames):
        """Return the motion of the frames in a slice, as ``frames[A:B:S]`` does."""
        chosen = self.frames[frames]
        if not chosen:
            raise SceneError(
                f"frames {_slice_text(frames)} selects none of the {len(self.frames)} frames of the motion"
            )
        return Motion(chosen, options=self.options)

    def __len__(self):
        return len(self.frames)


def coordinate_names(joints):
    """Return every "joint.coordinate" of the joints, in order."""
    return [f"{joint.name}.{name}" for joint in joints for name in joint.axes]


def interpolate(before, after, t):
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


def rotation_about(axis, angle, centre):
    """Return the (4, 4) rotation by ``angle`` [radian] about an axis through ``centre`` (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = np.eye(4)
    pose[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    pose[:3, 3] = centre - pose[:3, :3] @ centre
    return pose


def bone_poses(scene, coordinates):
    """Return the pose of every bone: rest bone coordinates -> world.

    A joint turns its child, and all that hangs on it, about the joint's centre; several coordinates of one
    joint are a product of rotations in the order in which the joint lists its axes. A bone without a joint
    is fixed.

    Parameters
    ----------
    scene : Scene
    coordinates : dict of str -> float
        "joint.coordinate" -> angle [radian]; absent ones are 0.

    Returns
    -------
    dict of str -> (4, 4) ndarray
    """
    joint_of = {joint.child: joint for joint in scene.joints}
    known = set(coordinate_names(scene.joints))
    for name in coordinates:
        if name not in known:
            raise SceneError(f"unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}")
    poses = {}
    for bone in scene.bones:
        chain = []
        name = bone.name
        while name in joint_of and name not in poses:
            chain.append(joint_of[name])
            name = chain[-1].parent
        pose = poses.setdefault(name, np.eye(4))
        for joint in reversed(chain):
            pose = pose @ _joint_transform(joint, coordinates)
            poses[joint.child] = pose
    return {bone.name: poses[bone.name] for bone in scene.bones}


def _joint_transform(joint, coordinates):
    transform = np.eye(4)
    for name, axis in joint.axes.items():
        angle = coordinates.get(f"{joint.name}.{name}", 0.0)
        if angle:
            transform = transform @ rotation_about(axis, angle, joint.centre)
    return transform


def _known(name, known):
    """Return the full coordinate name; a bare coordinate may stand for the only joint that has it."""
    if name in known:
        return name
    owners = [full for full in known if full.split(".", 1)[1] == name]
    if len(owners) == 1:
        return owners[0]
    raise SceneError(f"[motion]: unknown coordinate {name!r}, {did_you_mean(name, known)}")


def _ramp_frames(ramps):
    """All coordinates go together; the one that needs most steps sets the pace, its last may be short."""
    pace = max((abs(ramp.end - ramp.start) / ramp.step for ramp in ramps.values()), default=0.0)
    return [
        {name: math.radians(r.start + t * (r.end - r.start)) for name, r in ramps.items()}
        for t in _marks(pace)
    ]


def _waypoint_frames(stops, step):
    names = list(dict.fromkeys(name for stop in stops for name in stop))
    table = np.array([[stop.get(name, np.nan) for name in names] for stop in stops])
    for column in range(len(names)):  # what a waypoint does not mention stays where it was
        held = 0.0
        for row in range(len(stops)):
            held = table[row, column] = held if np.isnan(table[row, column]) else table[row, column]
    rows = [table[0]]
    for before, after in itertools.pairwise(table):
        pace = np.abs(after - before).max() / step
        rows.extend(before + t * (after - before) for t in _marks(pace)[1:])
    return [dict(zip(names, np.radians(row).tolist())) for row in rows]


def _marks(pace):
    """Fractions of the way at whole steps, then the end: 2.5 steps give 0, 0.4, 0.8, 1."""
    if pace > MAX_FRAMES:
        raise SceneError(f"[motion]: more than {MAX_FRAMES} frames, a step is too small for its range")
    if pace == 0:
        return [0.0]
    count = math.ceil(pace - 1e-9)
    return [*(k / pace for k in range(count)), 1.0]


def _file_frames(path, known):
    """Read an OpenSim motion (.mot or .sto): a header up to ``endheader``, column names, rows."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise SceneError(f"[motion]: cannot read {path}: {error.strerror}") from None
    ends = [row for row, line in enumerate(lines) if line.strip().lower() == "endheader"]
    if not ends or len(lines) < ends[0] + 3:
        raise SceneError(
            f"[motion]: {path} is no OpenSim motion: no 'endheader' line with columns and rows after it"
        )
    header = dict(line.lower().replace(" ", "").split("=", 1) for line in lines[: ends[0]] if "=" in line)
    factor = 1.0 if header.get("indegrees", "no") in ("no", "false", "0") else math.pi / 180
    labels = lines[ends[0] + 1].split()
    used = {column: name for column, label in enumerate(labels) if (name := _match(label, known))}
    if not used:
        raise SceneError(
            f"[motion]: {path} has none of the scene's coordinates ({', '.join(known) or 'no joints'})"
        )
    rows = [line.split() for line in lines[ends[0] + 2 :] if line.strip()]
    if len(rows) > MAX_FRAMES:
        raise SceneError(f"[motion]: {path} has {len(rows)} rows, more than {MAX_FRAMES}")
    return [_file_row(row, used, factor, len(labels), f"{path} row {k + 1}") for k, row in enumerate(rows)]


def _file_row(row, used, factor, width, place):
    if len(row) != width:
        raise SceneError(f"[motion]: {place} has {len(row)} values, the header names {width}")
    try:
        values = {name: float(row[column]) * factor for column, name in used.items()}
    except ValueError as error:
        raise SceneError(f"[motion]: {place}: {error}") from None
    for name, value in values.items():
        if not math.isfinite(value):
            raise SceneError(f"[motion]: {place}: {name} is {value}")
    return values


def _match(label, known):
    """A column is ``joint.coordinate``, ``coordinate`` alone or ``.../joint/coordinate/value``."""
    parts = label.removesuffix("/value").split("/")
    for name in (label, ".".join(parts[-2:]), parts[-1]):
        if name in known:
            return name
        owners = [full for full in known if full.split(".", 1)[1] == name]
        if len(owners) == 1:
            return owners[0]
    return None


def _slice_text(frames):
    return ":".join("" if part is None else str(part) for part in (frames.start, frames.stop, frames.step))
