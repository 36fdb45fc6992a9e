"""Rows of ``metrics.csv``, made from what was recorded: of a frame, and of moment arms and joints
along the motion.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, to_world
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, percentiles, unit_text
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.motion import bone_poses, shown_value
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene, guessed_muscles
from rbfmuscle.simulation.frame import Frame

Coordinates = Mapping[str, float]
# A slope is fitted over the frames within so many degrees, or millimetres of a shift, and over the
# frames next to it. In motions by one degree moment arms then ripple about smooth curves by at most
# 0.3 mm RMS (docs/validation.md).
ARM_REACH = 8.0
JUMP = 5.0  # the change of a moment arm is taken within so many degrees
ROUGH = 2.0  # steps over which lengths have second differences [degree]
# Activations that differ by less are the same.
_ALIKE = 1e-9
# Coordinates that change by less [radian or scene unit] rest.
_STILL = 1e-9
# Bones of a joint that are nearer than this at rest [mm] meet there; others, as a tendon's end, are
# held apart.
MEETING = 10.0
# Vertices of a bone whose distance to the other is taken, at most.
_VERTICES = 2000


def surface_depth(vertices: Floats, probes: list[BoneDistance], poses: dict[str, Floats]) -> Floats:
    """Greatest depth (n,) of vertices (n, 3) in the bones, of poses (4, 4) by name; 0 where in none
    [scene unit].
    """
    out = np.zeros(len(vertices))
    for probe in bones_about(vertices, probes, poses):
        pose = poses[probe.name]
        back = np.eye(4)
        back[:3, :3] = pose[:3, :3].T
        back[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
        np.maximum(out, probe.depth(vertices, pose=back), out=out)
    return out


def bones_about(
    vertices: Floats, probes: list[BoneDistance], poses: dict[str, Floats]
) -> list[BoneDistance]:
    """The bones whose boxes, where they are now, meet the box of the points (n, 3)."""
    if not probes or len(vertices) == 0:
        return []
    # Column by column, which takes a tenth of the time of both at once.
    low, high = (np.array([end(column) for column in vertices.T]) for end in (np.min, np.max))
    placed = np.array([poses[probe.name] for probe in probes])
    ends = np.array([probe.bounds for probe in probes])
    middle = np.einsum("bij,bj->bi", placed[:, :3, :3], ends.mean(axis=1)) + placed[:, :3, 3]
    half = np.einsum("bij,bj->bi", np.abs(placed[:, :3, :3]), 0.5 * (ends[:, 1] - ends[:, 0]))
    met = np.all((middle - half < high) & (middle + half > low), axis=1)
    return [probe for probe, near in zip(probes, met) if near]


def bone_depth(
    surface: MeshDistance, probes: list[BoneDistance], poses: dict[str, Floats]
) -> float:
    """Greatest depth of any bone vertex in a closed, outward surface in the world, 0 where none is
    [scene unit].
    """
    near = bones_about(surface.vertices, probes, poses)
    depths = [
        surface.depth(probe.vertices, pose=poses[probe.name]).max(initial=0.0) for probe in near
    ]
    return float(max(depths, default=0.0))


def frame_rows(
    scene: Scene,
    frame: Frame,
    before: Coordinates | None,
    measured: Mapping[str, Mapping[str, float]],
) -> list[Row]:
    """Rows of one frame from values by muscle and quantity; ``before`` are the last frame's
    coordinates, or None.
    """
    # The coordinate that moved most to reach the frame, else the first, and its value there.
    now = frame.coordinates
    names = scene.motion.coordinates or list(now)
    name = ""
    angle = 0.0
    if names:
        earlier = now if before is None else before
        name = max(names, key=lambda n: abs(now.get(n, 0.0) - earlier.get(n, 0.0)))
        angle = shown_value(scene, name, now.get(name, 0.0))
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
    *,
    lengths: Mapping[str, Mapping[int, float]],
    shortest: Mapping[str, Mapping[int, float]],
    fibres: Mapping[str, Mapping[int, Floats]],
    activations: Mapping[str, Mapping[int, float]],
) -> list[Row]:
    """Rows of the moment arms, and of how rough lengths are, from each frame's coordinates [radian
    or scene unit].

    By muscle and frame: lengths, shortest paths, lengths (N,) of fibres [scene unit], and
    activations of those that contract.

    Where the activation of a muscle changes its moment arm is NaN: the change of length is not the
    joint's alone.
    """
    rows = []
    known = all_coordinates(scene.joints)
    guessed = guessed_muscles(scene.guesses)
    places = {index: place for place, index in enumerate(path)}
    for muscle, found in lengths.items():
        active = activations.get(muscle, {})
        arms = [
            row._replace(muscle=muscle, value=float(moments))
            for moments, row in _moments(scene, path, found, active)
        ]
        rows += arms
        for name in dict.fromkeys(row.coordinate for row in arms):
            if known[name].motion != "rotation":
                continue
            mine = [row for row in arms if row.coordinate == name]
            for part in _stretches(mine, places, active):
                rows += _smoothness(part, guessed=muscle in guessed)
                rows += _roughness(part, found, shortest.get(muscle, {}))
    for muscle, of_fibres in fibres.items():
        for moments, row in _moments(scene, path, of_fibres, activations.get(muscle, {})):
            for quantity, value in percentiles("fibre_moment_arm", moments).items():
                rows.append(row._replace(muscle=muscle, quantity=quantity, value=value))
    return rows


def _stretches(
    arms: Sequence[Row], places: Mapping[int, int], active: Mapping[int, float]
) -> list[list[Row]]:
    """Moment arms of a muscle in parts of frames that follow each other, in one direction and at
    one activation; ``places`` are those of the frames in the motion.
    """
    parts: list[list[Row]] = []
    for arm in arms:
        if math.isnan(arm.value):
            continue
        goes_on = False
        if parts:
            part = parts[-1]
            last = part[-1]
            step = arm.coordinate_value - last.coordinate_value
            before = last.coordinate_value - part[-2].coordinate_value if len(part) > 1 else step
            alike = abs(active.get(arm.frame, 0.0) - active.get(last.frame, 0.0)) <= _ALIKE
            goes_on = places[arm.frame] == places[last.frame] + 1 and step * before > 0.0 and alike
        if not goes_on:
            parts.append([])
        parts[-1].append(arm)
    return parts


def _roughness(
    arms: Sequence[Row], lengths: Mapping[int, float], paths: Mapping[int, float]
) -> list[Row]:
    """Second differences over `ROUGH` degrees of a muscle's length and of its shortest path, at the
    places of its moment arms, and how much the length's exceeds the greatest of the path.

    None where the frames, of one stretch, are farther apart or span less than twice as much.
    """
    angles = np.array([arm.coordinate_value for arm in arms])
    farthest = np.abs(np.diff(angles)).max(initial=0.0)
    if farthest > ROUGH * (1.0 + 1e-6) or np.ptp(angles) < 2.0 * ROUGH - 1e-9:
        return []
    order = np.argsort(angles)
    angles = angles[order]
    # Nearer to an end there is no second difference.
    inside = (angles >= angles[0] + ROUGH - 1e-9) & (angles <= angles[-1] - ROUGH + 1e-9)
    bends = []
    for found in (lengths, paths):
        along = np.array([found[arm.frame] for arm in arms])[order]
        before, after = (np.interp(angles + way, angles, along) for way in (-ROUGH, ROUGH))
        bends.append(np.abs(before - 2.0 * along + after)[inside])
    allowed = bends[1][np.isfinite(bends[1])].max(initial=0.0)
    rows = []
    for place, length, shortest in zip(order[inside], *bends):
        values = {
            "length_roughness": length,
            "path_roughness": shortest,
            "roughness_beyond_path": max(0.0, length - allowed),
        }
        rows += [arms[place]._replace(quantity=q, value=float(v)) for q, v in values.items()]
    return rows


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


def _moments(scene, path, found, active):
    """Moment arms along a path, each with a row that says where, as `moment_arms` finds them; NaN
    where a coordinate moves alone while the activation changes. Lengths () or (N,), and
    activations, are by frame.
    """
    unknown = np.full(np.shape(next(iter(found.values()))), math.nan)
    lengths = np.array([found.get(index, unknown) for index in path])
    known = all_coordinates(scene.joints)
    shifts = {name for name, fact in known.items() if fact.motion == "translation"}
    reach = dict.fromkeys(shifts, from_mm(ARM_REACH, scene.units))
    frames = list(path.values())
    arms = moment_arms(frames, lengths, reach, [active.get(index, 0.0) for index in path])
    everywhere = moment_arms(frames, lengths, reach) if active else arms
    for (index, coordinates), moments, wanted in zip(path.items(), arms, everywhere):
        for name, whole in wanted.items():
            angle = shown_value(scene, name, coordinates.get(name, 0.0))
            unit = "1" if name in shifts else scene.units
            moment_arm = moments.get(name, np.full_like(whole, np.nan))
            yield moment_arm, Row(index, name, angle, "", "moment_arm", 0.0, unit)


def moment_arms(
    path: Sequence[Mapping[str, float]],
    lengths: ArrayLike,
    reach: Mapping[str, float] | None = None,
    activations: Sequence[float] | None = None,
) -> list[dict[str, Floats]]:
    """Moment arms -dl/dq along a motion, for each frame by coordinate that moves alone before or
    after it, at one activation.

    A parabola is fitted to the ``lengths`` [scene unit] of the frames within `ARM_REACH` degrees,
    or within the ``reach`` of a shift [scene unit], and always of the three nearest ones in the
    order of the motion, as far as the coordinate goes on alone and in one direction and
    ``activations`` (n,) stay: of second order at the ends too, where there are three. ``path``
    holds the coordinates of each frame; lengths (n,), or of several lines (n, m), are NaN where not
    known. Moment arms (), or (m,), are in scene units per radian, or 1.
    """
    values, found = np.asarray(lengths, dtype=float), [dict[str, Floats]() for _ in path]
    active = np.zeros(len(path)) if activations is None else np.asarray(activations)
    for name, first, last in _single_motions(path, values, active):
        at = np.array([path[k].get(name, 0.0) for k in range(first, last + 1)])
        wide = (reach or {}).get(name, math.radians(ARM_REACH))
        for k in range(first, last + 1):
            near = np.abs(at - at[k - first]) <= wide
            start = max(0, min(k - first - 1, len(at) - 3))
            near[start : start + 3] = True
            away, long = at[near] - at[k - first], values[first : last + 1][near]
            slope = np.polyfit(away, long, min(2, len(away) - 1))[-2]
            found[k].setdefault(name, -slope)
    return found


def _single_motions(path, lengths, active):
    """Name, first and last frame of each stretch in which one coordinate moves alone and in one
    direction, at one activation.
    """
    stretches = []
    for k, (before, after) in enumerate(itertools.pairwise(path)):
        moved = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in {*before, *after}}
        moved = {name: change for name, change in moved.items() if abs(change) > _STILL}
        if len(moved) != 1 or not np.isfinite(lengths[k : k + 2]).all():
            continue
        if abs(active[k + 1] - active[k]) > _ALIKE:
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
