"""Paths of muscles for OpenSim: sample muscles over their coordinates, fit, and say how well the fits hold."""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.threads import each
from rbfmuscle.importers.opensim.fitted import MOST_COORDINATES, fit_path, write_paths
from rbfmuscle.metrics.centreline import Centreline
from rbfmuscle.models import build_models
from rbfmuscle.scene.joints.skeleton import all_coordinates
from rbfmuscle.scene.joints.tables import full_name
from rbfmuscle.scene.motion import bone_poses, inner_value
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.validation import SceneError, SolveError, UsageError

# Every fifth sample is held out of the fit.
HELD_OUT = 5
# Of the polynomials that are tried.
HIGHEST_ORDER = 7
# Of the central differences, to either side [degree, or mm of a shift].
STEP = 1.0
# A muscle has settled where no contact point moves by more than this share of its size in a solve.
MOST_SOLVES, SETTLED = 60, 3e-7

Ranges = dict[str, tuple[float, float]]


@dataclass
class Samples:
    """A muscle's lengths and moment arms at some poses; a pose that could not be solved has NaN."""

    muscle: str
    coordinates: tuple[str, ...]  # that the muscle depends on, full names
    values: np.ndarray  # (n, d) [radian or scene unit]
    lengths: np.ndarray  # (n,) [scene unit]
    arms: np.ndarray  # (n, d) [scene unit]


def parse_ranges(scene: Scene, texts: list[str]) -> Ranges:
    """Return the ranges that --range asks for, by full name [radian or scene unit]."""
    known, found = list(all_coordinates(scene.joints)), {}
    for text in texts:
        name, _, ends = text.partition("=")
        try:
            low, high = (float(end) for end in ends.split(":"))
        except ValueError:
            raise UsageError(
                f"--range {text!r} is not COORDINATE=LOW:HIGH, for instance hip.flexion=0:60"
            ) from None
        full = full_name(name, known, place="--range")
        if not -np.inf < low < high < np.inf:
            raise UsageError(f"--range {text!r}: the range must go upwards between two numbers")
        found[full] = (inner_value(scene, full, low), inner_value(scene, full, high))
    return found


def sample_muscles(
    scene: Scene, given: Ranges, *, samples: int, progress: Callable[[int, int], None] | None = None
) -> list[Samples]:
    """Return lengths and moment arms of every muscle at quasi-random poses of the coordinates that it depends on.

    Each of the ``samples`` poses is reached from rest in a straight line and the muscle settles there. A moment arm is
    minus the central difference of the length over `STEP` to both sides, the muscle settling there too. Ranges that are
    ``given`` stand for the coordinates' own; ``progress`` is called with the poses that are done, and of how many.
    """
    scene = scene.validate().copy()
    scene.sliding = None
    groups, found, done = _groups(scene), [], 0
    ranges = {name: _range(scene, name, given) for names in groups for name in names}
    for names, muscles in groups.items():
        part = scene.copy()
        part.muscles = muscles
        values = _poses([ranges[name] for name in names], samples)
        rows = []
        for row in _measured(part, [dict(zip(names, pose)) for pose in values.tolist()]):
            rows.append(row)
            done += 1
            if progress is not None:
                progress(done, samples * len(groups))
        for muscle, table in zip(muscles, np.array(rows).transpose(1, 0, 2)):
            found.append(Samples(muscle.name, names, values, table[:, 0], table[:, 1:]))
    return found


def _measured(scene, poses):
    """For each pose a row for each muscle: its length, then its moment arm about each coordinate of the poses."""
    scene.motion = Motion(poses[:40])  # what bones a muscle may meet is sought along it
    models = build_models(scene)
    rest = [model.snapshot() for model in models]
    lines = {m.name: Centreline(scene.muscle(m.name), scene.joints, *m.material_mesh()) for m in models}
    fields = build_fields(scene, find_contact_pairs(scene))
    for pose in poses:
        for model, state in zip(models, rest):
            model.restore(state)
        try:
            yield _row(FrameLoop(scene, models, fields=fields, surfaces=False), lines, pose)
        except SolveError:
            yield np.full((len(models), 1 + len(pose)), np.nan)


def _row(loop, lines, pose):
    """Length and moment arms (n, 1 + d) of the muscles at a pose."""
    here, arms = _settled(loop, lines, pose), []
    facts = all_coordinates(loop.scene.joints)
    for name, value in pose.items():
        turns = facts[name].motion != "translation"
        step = math.radians(STEP) if turns else loop.scene.length(STEP)
        ends = [facts[name].honoured(value + side * step) for side in (-1.0, 1.0)]
        below, above = (_settled(loop, lines, {**pose, name: end}) for end in ends)
        arms.append(-(above - below) / (ends[1] - ends[0]))
    return np.stack([here, *arms], axis=1)


def _settled(loop, lines, pose):
    """Lengths (n,) of the muscles when they have come to rest at a pose, or have had `MOST_SOLVES`."""
    loop.skip(pose)
    with loop.working():
        each(lambda stepper: _settle(stepper, loop.here), loop.steppers)
    poses, found = bone_poses(loop.scene, loop.here), []
    for stepper in loop.steppers:
        line = lines[stepper.name]
        belly = line.length(stepper.model.material_mesh()[0], poses)
        found.append(belly + line.tendon_length(poses.tendons))
    return np.array(found)


def _settle(stepper, here):
    points = stepper.model.contact_points().copy()
    small = SETTLED * float(np.linalg.norm(np.ptp(points, axis=0)))
    for _ in range(MOST_SOLVES):
        stepper.solve(dict(here))
        before, points = points, stepper.model.contact_points().copy()
        if np.abs(points - before).max() <= small:
            return


def _poses(ranges, samples):
    """Sobol's points (n, d) within the ranges."""
    from scipy.stats import qmc

    # A power of two of them, as Sobol's points are balanced.
    points = qmc.Sobol(len(ranges), scramble=True, seed=0).random(1 << (samples - 1).bit_length())
    low, high = np.array(ranges).T
    return low + points[:samples] * (high - low)


def _groups(scene):
    """Muscles by the coordinates that they depend on; those of a group are sampled together."""
    facts, followers = all_coordinates(scene.joints), {coupling.coordinate for coupling in scene.couplings}
    free = [name for name, fact in facts.items() if name not in followers and not fact.locked]
    groups = {}
    for muscle in scene.muscles:
        bones = sorted({attachment.bone for attachment in muscle.attachments})
        needed = tuple(name for name in free if _moves(scene, bones, name))
        if not 1 <= len(needed) <= MOST_COORDINATES:
            raise SceneError(
                f"muscle {muscle.name!r} depends on {len(needed)} coordinates ({', '.join(needed)}); OpenSim takes "
                f"1 to {MOST_COORDINATES}: lock some in the scene"
            )
        groups.setdefault(needed, []).append(muscle)
    return groups


def _moves(scene, bones, name):
    """Whether a coordinate moves some bones against each other, from where all others rest."""
    fact, places = all_coordinates(scene.joints)[name], []
    for value in (fact.rest, fact.rest + 0.1, fact.rest - 0.1):
        poses = bone_poses(scene, {name: fact.honoured(value)})
        back = np.linalg.inv(poses[bones[0]])
        places.append([back @ poses[bone] for bone in bones])
    return np.ptp(np.array(places), axis=0).max() > 1e-6


def _range(scene, name, given):
    """The range of a coordinate: as given, its own, or what the motion covers."""
    moved = [frame[name] for frame in scene.motion.frames if name in frame]
    own = all_coordinates(scene.joints)[name].range
    for ends in (given.get(name), own, (min(moved, default=0.0), max(moved, default=0.0))):
        if ends is not None and ends[0] < ends[1]:
            return ends
    raise UsageError(f"coordinate {name!r} has no range; give --range {name}=LOW:HIGH")


def report_fits(scene: Scene, sampled: list[Samples], directory: Path) -> list[str]:
    """Fit every muscle, write the files, and return lines that say how well the fits hold where they were not made."""
    fitted, lines, errors, unit = [], [], [], scene.units
    for found in sampled:
        path, row = _fit(found)
        fitted.append(path)
        errors.append(row)
        lines.append(
            f"{path.muscle}: order {path.order} in {', '.join(path.coordinates)}; {row['held_out']} poses held out: "
            f"length {row['length_rms']:.3g} {unit} RMS, {row['length_max']:.3g} at most; "
            f"arms {row['arm_rms']:.3g} {unit} RMS, {row['arm_max']:.3g} at most"
            + (f"; {row['failed']} poses could not be solved" if row["failed"] else "")
        )
    turning = {name: f.motion != "translation" for name, f in all_coordinates(scene.joints).items()}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_paths(directory / "paths.xml", fitted, scene.length(1000.0), turning)
        with (directory / "errors.csv").open("w", encoding="utf-8", newline="") as out:
            writer = csv.DictWriter(out, fieldnames=list(errors[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(errors)
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}; choose another folder") from None
    return [
        *lines,
        f"{directory / 'paths.xml'}: {len(fitted)} paths; OpenSim puts them in by their names, /forceset/MUSCLE",
    ]


def _fit(found):
    """The path of a muscle, and its errors at poses that the fit has not seen."""
    solved = np.isfinite(found.lengths)
    held = np.arange(len(solved)) % HELD_OUT == HELD_OUT - 1
    use, out, failed = solved & ~held, solved & held, int((~solved).sum())
    if use.sum() < 2 * (len(found.coordinates) + 1) or not out.any():
        raise SolveError(
            f"muscle {found.muscle!r}: {failed} of {len(solved)} poses failed, too few are left to fit"
        )
    parts = (found.values[use], found.lengths[use], found.arms[use])
    path = fit_path(found.muscle, found.coordinates, *parts, most=HIGHEST_ORDER)
    row = {"muscle": path.muscle, "order": path.order, "fitted": int(use.sum()), "failed": failed}
    row["held_out"] = int(out.sum())
    for name, error in (
        ("length", path.length(found.values[out]) - found.lengths[out]),
        ("arm", path.arms(found.values[out]) - found.arms[out]),
    ):
        row |= {f"{name}_rms": float(np.sqrt(np.mean(error**2))), f"{name}_max": float(np.abs(error).max())}
    return path, row
