"""What ``rbfmuscle paths`` does: sample muscles over their coordinates, keep every sample, fit, and say how well."""

import csv
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def parse_ranges(scene: Scene, texts: list[str]) -> dict[str, tuple[float, float]]:
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


class Sampling:
    """Muscles at quasi-random poses of the coordinates that they depend on.

    Each pose is reached from rest in a straight line, the muscle settles there, and each coordinate is nudged for its
    moment arm. A sample depends on nothing but its own place in the sequence, so that a sampling can be gone on with.

    Parameters
    ----------
    scene : Scene
    directory : path
    ranges : dict of str to (float, float)
        Instead of the coordinates' own.
    samples : int
        Poses for each muscle.
    kind : {"sobol", "halton"}
    """

    def __init__(self, scene: Scene, directory: Path, ranges: dict, *, samples: int, kind: str) -> None:
        if not scene.muscles:
            raise SceneError(f"scene {scene.name!r} has no muscles, add a [[muscle]]")
        self.scene = scene.validate().copy()
        self.scene.sliding = None
        if not self.scene.output.moment_arms:
            output: Any = self.scene.output.changed("moment_arms", True, place="")
            self.scene.output = output
        self.directory, self.samples, self.kind = Path(directory), samples, kind
        self.ranges = {name: self._range(name, ranges) for name in self._all_needed()}
        self.needs = {muscle.name: self._needed(muscle) for muscle in self.scene.muscles}
        for name, needed in self.needs.items():
            if not 1 <= len(needed) <= MOST_COORDINATES:
                raise SceneError(
                    f"muscle {name!r} depends on {len(needed)} coordinates ({', '.join(needed)}); OpenSim takes 1 to "
                    f"{MOST_COORDINATES}: lock some in the scene"
                )
        self.known = self._open()

    @property
    def missing(self) -> int:
        """Poses still to be sampled, counted once for all muscles that share it."""
        return sum(len(self._waiting(group)) for group in self._groups())

    def run(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Sample what is missing; every sample is on disk before the next is begun."""
        total, done = self.missing, 0
        for group in self._groups():
            waiting = self._waiting(group)
            if not waiting:
                continue
            scene = self._part(group)
            models = build_models(scene)
            rest = [model.snapshot() for model in models]
            lines = {
                m.name: Centreline(MuscleAtRest(scene.muscle(m.name), scene.joints, *m.carried_mesh()))
                for m in models
            }
            fields = build_fields(scene, reached_bones(scene))
            for index in waiting:
                for model, state in zip(models, rest):
                    model.restore(state)
                self._keep(self._sample(scene, models, lines, fields, index))
                done += 1
                if progress is not None:
                    progress(done, total)

    def table(self, muscle: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates (n, d), lengths (n,), arms (n, d) of a muscle's samples, and whether each is held out (n,)."""
        rows = [row for row in self.known.values() if row["muscle"] == muscle and row["length"] is not None]
        rows = sorted((row for row in rows if row["sample"] < self.samples), key=lambda row: row["sample"])
        names = self.needs[muscle]
        values = np.array([[row["q"][name] for name in names] for row in rows]).reshape(-1, len(names))
        arms = np.array([[row["arms"].get(name, 0.0) for name in names] for row in rows]).reshape(
            -1, len(names)
        )
        held = np.array([row["sample"] % HELD_OUT == HELD_OUT - 1 for row in rows], dtype=bool)
        return values, np.array([row["length"] for row in rows]), arms, held

    def _sample(self, scene, models, lines, fields, index):
        """A row for each muscle at one pose; its length is None where the pose cannot be solved."""
        pose = self._pose(self.needs[models[0].name], index)
        rows = {
            m.name: {"muscle": m.name, "sample": index, "q": pose, "length": None, "arms": {}} for m in models
        }
        try:
            with FrameLoop(scene, models, fields=fields, surfaces=False) as loop:
                loop.skip(pose)
                with loop.workers.one_thread_each():
                    found = loop.workers.each(
                        lambda stepper: self._measure(stepper, loop.here, lines), loop.steppers
                    )
        except SolveError:
            return list(rows.values())
        for stepper, (length, arms) in zip(loop.steppers, found):
            rows[stepper.name].update(length=length, arms=arms)
        return list(rows.values())

    def _measure(self, stepper, here, lines):
        settle(stepper, here)
        line, arms = lines[stepper.name], {}
        length = line.length(stepper.model.carried_mesh()[0], bone_poses(self.scene, here))
        for name, (span, below, above) in nudge(stepper, here).items():
            arms[name] = -(line.length(*above) - line.length(*below)) / span
        return length, arms

    def _pose(self, names, index):
        from scipy.stats import qmc

        engine = {"sobol": qmc.Sobol, "halton": qmc.Halton}[self.kind](len(names), scramble=True, seed=0)
        # A power of two of them, as Sobol's points are balanced; the same ones first however many are made.
        point = engine.random(1 << index.bit_length())[index]
        low, high = np.array([self.ranges[name] for name in names]).T
        return dict(zip(names, (low + point * (high - low)).tolist()))

    def _groups(self):
        """Muscles that depend on the same coordinates are sampled together."""
        groups = {}
        for muscle, names in self.needs.items():
            groups.setdefault(names, []).append(muscle)
        return list(groups.values())

    def _waiting(self, group):
        return [k for k in range(self.samples) if any((name, k) not in self.known for name in group)]

    def _part(self, group):
        """The scene with some muscles, and a motion that spans their ranges."""
        scene = self.scene.copy()
        scene.muscles = [muscle for muscle in scene.muscles if muscle.name in group]
        names = self.needs[group[0]]
        scene.motion = Motion([self._pose(names, k) for k in range(min(self.samples, 40))])
        return scene

    def _needed(self, muscle):
        bones, names = sorted({a.bone for a in muscle.attachments}), set()
        for share in (0.0, 0.37, 0.71, 1.0):
            pose = {name: low + share * (high - low) for name, (low, high) in self.ranges.items()}
            names |= set(moving_coordinates(self.scene, bones, pose))
        return tuple(name for name in self.ranges if name in names)

    def _all_needed(self):
        found = set()
        for muscle in self.scene.muscles:
            found |= set(moving_coordinates(self.scene, sorted({a.bone for a in muscle.attachments}), {}))
        return [name for name in all_coordinates(self.scene.joints) if name in found]

    def _range(self, name, given):
        facts = all_coordinates(self.scene.joints)[name]
        moved = [frame[name] for frame in self.scene.motion.frames if name in frame]
        for ends in (given.get(name), facts.range, (min(moved, default=0.0), max(moved, default=0.0))):
            if ends is not None and ends[0] < ends[1]:
                return ends
        raise UsageError(f"coordinate {name!r} has no range; give --range {name}=LOW:HIGH")

    def _open(self):
        """What is there already; another scene or other ranges in the same folder are refused."""
        ask = {"scene": self._fingerprint(), "points": self.kind, "ranges": self.ranges}
        ask["step"] = self.scene.output.moment_arms.step
        plan, file = self.directory / "plan.json", self.directory / "samples.jsonl"
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            before = json.loads(plan.read_text()) if plan.is_file() else None
            text = file.read_text(encoding="utf-8") if file.is_file() else ""
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None
        except ValueError:
            raise UsageError(f"{plan} is not readable; give another folder") from None
        if before not in (None, json.loads(json.dumps(ask))):
            raise UsageError(
                f"{self.directory} holds samples of another scene or other ranges; give another folder"
            )
        plan.write_text(json.dumps(ask, indent=1) + "\n")
        whole = text[: text.rfind("\n") + 1]  # without the last line of a sampling that was killed
        if whole != text:
            file.write_text(whole, encoding="utf-8")
        lines = whole.splitlines()
        known = {}
        for line in lines:
            row = json.loads(line)
            known[row["muscle"], row["sample"]] = row
        return known

    def _fingerprint(self):
        facts = self.scene.resolved()
        for key in ("motion", "output", "file", "opensim"):
            facts.pop(key, None)
        facts["muscles"] = sorted(json.dumps(m, default=str, sort_keys=True) for m in facts["muscles"])
        return hashlib.sha256(json.dumps(facts, default=str, sort_keys=True).encode()).hexdigest()

    def _keep(self, rows):
        with (self.directory / "samples.jsonl").open("a", encoding="utf-8") as file:
            for row in rows:
                self.known[row["muscle"], row["sample"]] = row
                file.write(json.dumps(row) + "\n")


def report_fits(sampling: Sampling, order: int) -> list[str]:
    """Fit every muscle, write the files, and return lines that say how well the fits hold where they were not made."""
    fitted, lines, errors = [], [], []
    scene, unit = sampling.scene, sampling.scene.units
    for muscle in sampling.needs:
        values, lengths, arms, held = sampling.table(muscle)
        failed = sampling.samples - len(values)
        if (~held).sum() < 2 * (len(sampling.needs[muscle]) + 1) or not held.any():
            raise SolveError(
                f"muscle {muscle!r}: {failed} of {sampling.samples} poses failed, too few are left to fit"
            )
        path = fit_path(
            muscle, sampling.needs[muscle], values[~held], lengths[~held], arms[~held], most=order
        )
        row = held_out_errors(path, values[held], lengths[held], arms[held])
        fitted.append(path)
        errors.append(
            {"muscle": muscle, "order": path.order, "fitted": int((~held).sum()), "failed": failed, **row}
        )
        lines.append(
            f"{muscle}: order {path.order} in {', '.join(path.coordinates)}; {int(held.sum())} poses held out: "
            f"length {row['length_rms']:.3g} {unit} RMS, {row['length_max']:.3g} at most; "
            f"arms {row['arm_rms']:.3g} {unit} RMS, {row['arm_max']:.3g} at most"
            + (f"; {failed} poses could not be solved" if failed else "")
        )
    facts = all_coordinates(scene.joints)
    turning = {name: fact.motion != "translation" for name, fact in facts.items()}
    directory = sampling.directory
    write_paths(directory / "paths.xml", fitted, scene.length(1000.0), turning)
    _write_csv(directory / "errors.csv", errors)
    _write_csv(directory / "paths.csv", _terms_table(scene, fitted))
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
