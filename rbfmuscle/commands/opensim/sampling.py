"""What ``rbfmuscle paths`` does: sample muscles over their coordinates, fit, and say how well the fits hold."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.models import build_models
from rbfmuscle.opensim.fitted import MOST_COORDINATES, FittedPath, exponents, fit_path, write_paths
from rbfmuscle.sim.joints.skeleton import all_coordinates
from rbfmuscle.sim.loop.nudge import moving_coordinates, nudge, settle
from rbfmuscle.sim.loop.simulate import FrameLoop
from rbfmuscle.sim.plan.reach import build_fields, reached_bones
from rbfmuscle.sim.scene.joint_tables import full_name
from rbfmuscle.sim.scene.motion import Motion, bone_poses, inner_value
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.study.measure.centreline import Centreline, MuscleAtRest
from rbfmuscle.validation import SceneError, SolveError, UsageError

# Every fifth sample is held out of the fit.
HELD_OUT = 5

Ranges = dict[str, tuple[float, float]]


@dataclass
class Samples:
    """A muscle's lengths and moment arms at some poses; a pose that could not be solved has NaN.

    Attributes
    ----------
    coordinates : tuple of str
        Those that the muscle depends on, full names.
    values, arms : (n, d) ndarray
        [radian or scene unit], [scene unit].
    lengths : (n,) ndarray
    """

    muscle: str
    coordinates: tuple[str, ...]
    values: np.ndarray
    lengths: np.ndarray
    arms: np.ndarray


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

    Each pose is reached from rest in a straight line, the muscle settles there, and each coordinate is nudged for its
    moment arm.

    Parameters
    ----------
    scene : Scene
    given : dict of str to (float, float)
        Ranges instead of the coordinates' own.
    samples : int
        Poses for each muscle.
    progress : callable, optional
        Told how many poses are done, and of how many.
    """
    if not scene.muscles:
        raise SceneError(f"scene {scene.name!r} has no muscles, add a [[muscle]]")
    scene = scene.validate().copy()
    scene.sliding = None
    groups = _groups(scene, _ranges(scene, given))
    found, done = [], 0
    for ranges, muscles in groups:
        part = scene.copy()
        part.muscles = [muscle for muscle in scene.muscles if muscle.name in muscles]
        poses = _poses(ranges, samples)
        rows = []
        for row in _measured(part, poses):
            rows.append(row)
            done += 1
            if progress is not None:
                progress(done, samples * len(groups))
        values = np.array([[pose[name] for name in ranges] for pose in poses])
        for k, muscle in enumerate(part.muscles):
            table = np.array([row[k] for row in rows])
            found.append(Samples(muscle.name, tuple(ranges), values, table[:, 0], table[:, 1:]))
    return found


def _measured(scene, poses):
    """For each pose a row for each muscle: its length, then its moment arm about each coordinate of the poses."""
    scene.motion = Motion(poses[:40])  # what bones a muscle may meet is sought along it
    models = build_models(scene)
    rest = [model.snapshot() for model in models]
    lines = {
        m.name: Centreline(MuscleAtRest(scene.muscle(m.name), scene.joints, *m.carried_mesh()))
        for m in models
    }
    fields = build_fields(scene, reached_bones(scene))
    for pose in poses:
        for model, state in zip(models, rest):
            model.restore(state)
        try:
            with FrameLoop(scene, models, fields=fields, surfaces=False) as loop:
                loop.skip(pose)
                with loop.workers.one_thread_each():
                    yield loop.workers.each(
                        lambda stepper, loop=loop, pose=pose: _measure(stepper, loop.here, lines, pose),
                        loop.steppers,
                    )
        except SolveError:
            yield [[np.nan] * (1 + len(pose))] * len(models)


def _measure(stepper, here, lines, names):
    settle(stepper, here)
    line = lines[stepper.name]
    length = line.length(stepper.model.carried_mesh()[0], bone_poses(stepper.scene, here))
    nudged = nudge(stepper, here)
    arms = {name: -(line.length(*n.above) - line.length(*n.below)) / n.span for name, n in nudged.items()}
    return [length, *(arms.get(name, 0.0) for name in names)]


def _poses(ranges, samples):
    from scipy.stats import qmc

    # A power of two of them, as Sobol's points are balanced.
    points = qmc.Sobol(len(ranges), scramble=True, seed=0).random(1 << (samples - 1).bit_length())
    low, high = np.array(list(ranges.values())).T
    return [dict(zip(ranges, row)) for row in (low + points[:samples] * (high - low)).tolist()]


def _groups(scene, ranges):
    """Ranges that muscles depend on, with the names of these muscles, which are sampled together."""
    groups = {}
    for muscle in scene.muscles:
        bones, names = sorted({a.bone for a in muscle.attachments}), set()
        for share in (0.0, 0.37, 0.71, 1.0):
            pose = {name: low + share * (high - low) for name, (low, high) in ranges.items()}
            names |= set(moving_coordinates(scene, bones, pose))
        needed = tuple(name for name in ranges if name in names)
        if not 1 <= len(needed) <= MOST_COORDINATES:
            raise SceneError(
                f"muscle {muscle.name!r} depends on {len(needed)} coordinates ({', '.join(needed)}); OpenSim takes "
                f"1 to {MOST_COORDINATES}: lock some in the scene"
            )
        groups.setdefault(needed, []).append(muscle.name)
    return [({name: ranges[name] for name in needed}, names) for needed, names in groups.items()]


def _ranges(scene, given):
    """The range of every coordinate that moves a muscle: as given, its own, or what the motion covers."""
    moving = set()
    for muscle in scene.muscles:
        moving |= set(moving_coordinates(scene, sorted({a.bone for a in muscle.attachments}), {}))
    found = {}
    for name, facts in all_coordinates(scene.joints).items():
        if name not in moving:
            continue
        moved = [frame[name] for frame in scene.motion.frames if name in frame]
        ends = (given.get(name), facts.range, (min(moved, default=0.0), max(moved, default=0.0)))
        found[name] = next((pair for pair in ends if pair is not None and pair[0] < pair[1]), None)
        if found[name] is None:
            raise UsageError(f"coordinate {name!r} has no range; give --range {name}=LOW:HIGH")
    return found


def report_fits(scene: Scene, sampled: list[Samples], directory: Path, order: int) -> list[str]:
    """Fit every muscle, write the files, and return lines that say how well the fits hold where they were not made."""
    fitted, lines, errors, unit = [], [], [], scene.units
    for found in sampled:
        solved = np.isfinite(found.lengths)
        held = np.arange(len(solved)) % HELD_OUT == HELD_OUT - 1
        use, out = solved & ~held, solved & held
        failed = int((~solved).sum())
        if use.sum() < 2 * (len(found.coordinates) + 1) or not out.any():
            raise SolveError(
                f"muscle {found.muscle!r}: {failed} of {len(solved)} poses failed, too few are left to fit"
            )
        parts = (found.values[use], found.lengths[use], found.arms[use])
        path = fit_path(found.muscle, found.coordinates, *parts, most=order)
        row = held_out_errors(path, found.values[out], found.lengths[out], found.arms[out])
        fitted.append(path)
        head = {"muscle": path.muscle, "order": path.order, "fitted": int(use.sum()), "failed": failed}
        errors.append({**head, **row})
        lines.append(
            f"{path.muscle}: order {path.order} in {', '.join(path.coordinates)}; {int(out.sum())} poses held out: "
            f"length {row['length_rms']:.3g} {unit} RMS, {row['length_max']:.3g} at most; "
            f"arms {row['arm_rms']:.3g} {unit} RMS, {row['arm_max']:.3g} at most"
            + (f"; {failed} poses could not be solved" if failed else "")
        )
    turning = {name: f.motion != "translation" for name, f in all_coordinates(scene.joints).items()}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_paths(directory / "paths.xml", fitted, scene.length(1000.0), turning)
        _write_csv(directory / "errors.csv", errors)
        _write_csv(directory / "paths.csv", _terms_table(scene, fitted))
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}; choose another folder") from None
    lines.append(
        f"{directory / 'paths.xml'}: {len(fitted)} paths; OpenSim puts them in by their names, /forceset/MUSCLE"
    )
    return lines


def held_out_errors(
    path: FittedPath, values: np.ndarray, lengths: np.ndarray, arms: np.ndarray
) -> dict[str, float]:
    """Return root mean square and greatest errors of length and arms at poses that the fit has not seen."""
    length, arm = path.length(values) - lengths, path.arms(values) - arms
    return {
        "held_out": len(values),
        "length_rms": float(np.sqrt(np.mean(length**2))),
        "length_max": float(np.abs(length).max()),
        "arm_rms": float(np.sqrt(np.mean(arm**2))),
        "arm_max": float(np.abs(arm).max()),
    }


def _terms_table(scene, fitted):
    rows = []
    for path in fitted:
        for power, value in zip(exponents(len(path.coordinates), path.order), path.coefficients):
            term = " ".join(f"{n}^{p}" for n, p in zip(path.coordinates, power) if p) or "1"
            rows.append(
                {"muscle": path.muscle, "term": term, "coefficient": repr(float(value)), "unit": scene.units}
            )
    return rows


def _write_csv(file, rows):
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
