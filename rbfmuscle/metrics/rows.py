"""Rows of ``metrics.csv``, made from what was recorded: of a frame, and of moment arms and joints
along the motion.
"""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.vectors import to_world
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, percentiles, unit_text
from rbfmuscle.scene.guesses import guessed_muscles
from rbfmuscle.scene.joints.joint import all_coordinates
from rbfmuscle.scene.motion import bone_poses, shown_value
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame

Coordinates = Mapping[str, float]
# A slope is fitted over the frames within so many degrees, or millimetres of a shift, and over the
# frames next to it. In motions by one degree moment arms then ripple about smooth curves by at most
# 0.3 mm RMS (docs/validation.md).
REACH = 8.0
JUMP = 5.0  # the change of a moment arm is taken within so many degrees
# Coordinates that change by less [radian or scene unit] rest.
_STILL = 1e-9
# Bones of a joint that are nearer than this at rest [mm] meet there; others, as a tendon's end, are
# held apart.
MEETING = 10.0
# Vertices of a bone whose distance to the other is taken, at most.
_VERTICES = 2000


def frame_rows(
    scene: Scene,
    frame: Frame,
    before: Coordinates | None,
    measured: Mapping[str, Mapping[str, float]],
) -> list[Row]:
    """Rows of one frame from values by muscle and quantity; ``before`` are the last frame's
    coordinates, or None.
    """
    name, angle = _leading_coordinate(scene, frame, before)
    together = dict(measured.get(ALL, {}))
    time = scene.motion.time(frame.index)
    if time is not None:
        together["time"] = time
    together["time_frame"] = frame.wall
    unit = {quantity: unit_text(kind, scene.units) for quantity, (kind, _) in QUANTITIES.items()}
    return [
        Row(frame.index, name, angle, muscle, quantity, value, unit[quantity])
        for muscle, values in {**measured, ALL: together}.items()
        for quantity, value in values.items()
    ]


def moment_arm_rows(
    scene: Scene,
    path: Mapping[int, Coordinates],
    lengths: Mapping[str, Mapping[int, float]],
    fibres: Mapping[str, Mapping[int, Floats]],
) -> list[Row]:
    """Rows of the moment arms, from each frame's coordinates [radian or scene unit] and the lengths
    of muscles, and of their fibres (N,), by frame.
    """
    rows = []
    for muscle, found in lengths.items():
        along = np.array([found.get(index, math.nan) for index in path])
        for moments, row in _moments(scene, path, along):
            rows.append(row._replace(muscle=muscle, value=float(moments)))
    known = all_coordinates(scene.joints)
    turning = [row for row in rows if known[row.coordinate].motion == "rotation"]
    guessed = guessed_muscles(scene.guesses)
    for arms in _by_muscle(turning):
        rows += _smoothness(arms, guessed=arms[0].muscle in guessed)
    for muscle, of_fibres in fibres.items():
        none = np.full(len(next(iter(of_fibres.values()))), math.nan)
        along = np.array([of_fibres.get(index, none) for index in path])
        for moments, row in _moments(scene, path, along):
            for quantity, value in percentiles("fibre_moment_arm", moments).items():
                rows.append(row._replace(muscle=muscle, quantity=quantity, value=value))
    return rows


def _by_muscle(rows: Sequence[Row]) -> list[list[Row]]:
    """Rows of each muscle and coordinate, in the order of the frames."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.muscle, row.coordinate), []).append(row)
    return list(found.values())


def _smoothness(arms: Sequence[Row], *, guessed: bool) -> list[Row]:
    """How far each moment arm departs from where the ones before lead, and, of a muscle whose
    attachments are ``guessed``, how far they went to both sides of zero.

    The departure is the change of slope, from the last `JUMP` degrees (or the last step, where it
    is longer) to those before, over `JUMP` degrees.
    """
    angles = np.array([arm.coordinate_value for arm in arms])
    values = np.array([arm.value for arm in arms])
    found = []
    for k in range(1, len(arms)):
        middle = _before(angles, k)
        first = _before(angles, middle)
        if first < middle < k:
            late = (values[k] - values[middle]) / (angles[k] - angles[middle])
            early = (values[middle] - values[first]) / (angles[middle] - angles[first])
            jump = JUMP * abs(float(late - early))
            found.append(arms[k]._replace(quantity="moment_arm_jump", value=jump))
        if guessed:
            sides = max(values[: k + 1].max(), 0.0), max(-values[: k + 1].min(), 0.0)
            reversal = float(min(sides))
            found.append(arms[k]._replace(quantity="moment_arm_reversal", value=reversal))
    return found


def _before(angles: Floats, k: int) -> int:
    """The last of the angles before the k-th that is `JUMP` degrees away; k where there is none."""
    away = np.flatnonzero(np.abs(angles[:k] - angles[k]) >= JUMP)
    return int(away[-1]) if len(away) else k


def _moments(scene, path, lengths):
    """Moment arms along a path, each with a row that says where, as `moment_arms` finds them."""
    known = all_coordinates(scene.joints)
    shifts = {name for name, fact in known.items() if fact.motion == "translation"}
    names = {name for coordinates in path.values() for name in coordinates}
    reach = reaches(names, shifts, scene.units)
    found = moment_arms(list(path.values()), lengths, reach)
    for (index, coordinates), moments in zip(path.items(), found):
        for name, moment_arm in moments.items():
            angle = shown_value(scene, name, coordinates.get(name, 0.0))
            unit = "1" if name in shifts else scene.units
            yield moment_arm, Row(index, name, angle, "", "moment_arm", 0.0, unit)


def reaches(names: Iterable[str], shifts: Collection[str], units: str) -> dict[str, float]:
    """Over how much of each of some coordinates moment arms are fitted [radian, or of ``shifts``
    scene unit].
    """
    near = from_mm(REACH, units)
    return {name: near if name in shifts else math.radians(REACH) for name in names}


def _leading_coordinate(scene, frame, before):
    """The coordinate that moved most to reach a frame, and its value there [degree or scene
    unit].
    """
    names = scene.motion.coordinates or list(frame.coordinates)
    if not names:
        return "", 0.0
    now = frame.coordinates
    name = names[0]
    if before is not None:
        name = max(names, key=lambda n: abs(now.get(n, 0.0) - before.get(n, 0.0)))
    return name, shown_value(scene, name, now.get(name, 0.0))


def moment_arms(
    path: Sequence[Mapping[str, float]],
    lengths: ArrayLike,
    reach: Mapping[str, float] | None = None,
) -> list[dict[str, Floats]]:
    """Moment arms -dl/dq along a motion, for each frame by coordinate that moves alone before or
    after it.

    A parabola is fitted to the ``lengths`` [scene unit] of the frames within ``reach`` [radian or
    scene unit, `REACH` degrees by default], and always of both neighbours, as far as the coordinate
    goes on alone and in one direction: with two neighbours it is the central difference, at an end
    the difference to the one. ``path`` holds the coordinates of each frame; lengths (n,), or of
    several lines (n, m), are NaN where not known. Moment arms (), or (m,), are in scene units per
    radian, or 1.
    """
    values, found = np.asarray(lengths, dtype=float), [dict[str, Floats]() for _ in path]
    for name, first, last in _single_motions(path, values):
        at = np.array([path[k].get(name, 0.0) for k in range(first, last + 1)])
        wide = math.radians(REACH) if reach is None else reach[name]
        for k in range(first, last + 1):
            near = np.abs(at - at[k - first]) <= wide
            near[max(0, k - first - 1) : k - first + 2] = True
            away, long = at[near] - at[k - first], values[first : last + 1][near]
            slope = np.polyfit(away, long, min(2, len(away) - 1))[-2]
            found[k].setdefault(name, -slope)
    return found


def _single_motions(path, lengths):
    """Name, first and last frame of each stretch in which one coordinate moves alone and in one
    direction.
    """
    stretches = []
    for k, (before, after) in enumerate(itertools.pairwise(path)):
        moved = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in {*before, *after}}
        moved = {name: change for name, change in moved.items() if abs(change) > _STILL}
        if len(moved) != 1 or not np.isfinite(lengths[k : k + 2]).all():
            continue
        ((name, change),) = moved.items()
        if stretches and stretches[-1][:2] == (name, change > 0) and stretches[-1][3] == k:
            stretches[-1] = (*stretches[-1][:3], k + 1)
        else:
            stretches.append((name, change > 0, k, k + 1))
    return [(name, first, last) for name, _, first, last in stretches]


def joint_gaps(scene: Scene, frames: Iterable[int]) -> list[tuple[int, str, str, float]]:
    """How much wider than at rest the bones of a joint are apart, by their vertices, where they
    meet at rest.

    For each frame and such joint: (frame, parent, child, opening [scene unit]).
    """
    vertices = {bone.name: np.asarray(bone.mesh.vertices, dtype=float) for bone in scene.bones}
    pairs = [
        (j.parent, j.child) for j in scene.joints if j.parent in vertices and j.child in vertices
    ]
    trees = {parent: cKDTree(vertices[parent]) for parent, _ in pairs}
    points = {
        child: vertices[child][:: -(-len(vertices[child]) // _VERTICES)] for _, child in pairs
    }
    rest = {(p, c): float(trees[p].query(points[c])[0].min()) for p, c in pairs}
    meeting = [pair for pair in pairs if rest[pair] < from_mm(MEETING, scene.units)]
    found = []
    for frame in frames:
        poses: Mapping[str, Floats] = bone_poses(scene, scene.motion.frames[frame])
        for parent, child in meeting:
            relative = np.asarray(np.linalg.solve(poses[parent], poses[child]), dtype=np.float64)
            moved = to_world(points[child], relative)
            gap = float(trees[parent].query(moved)[0].min())
            found.append((frame, parent, child, gap - rest[parent, child]))
    return found
