"""Paths of muscles for OpenSim: lengths and moment arms sampled over the coordinates, fitted by
polynomials, and the file that OpenSim reads.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.fibres import build_bundles
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.arrays import box_size
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.centreline import Centreline
from rbfmuscle.models import build_models
from rbfmuscle.run.writer import write_csv
from rbfmuscle.scene.joints import all_coordinates, exponents
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.objects import Motion, from_mm
from rbfmuscle.scene.scene import Scene, require_complete
from rbfmuscle.simulation.contact_pairs import (
    SAMPLED_POSES,
    Regions,
    build_fields,
    find_contact_pairs,
)
from rbfmuscle.simulation.frame_loop import FrameLoop
from rbfmuscle.validation import SceneError, SolveError, UsageError

FOR_EACH = 20  # poses for each coordinate, where no number is given
GOOD = 1.0  # RMS of moment arms at poses held out, beyond which it is said [mm]
HELD_OUT = 5  # every fifth sample is held out of the fit
HIGHEST_ORDER = 7  # of the polynomials that are tried
STEP = 2.0  # of the central differences, to either side [degree, or mm of a shift]
# A muscle has settled where no contact point moves by more than this share of its size in a solve.
MOST_SOLVES, SETTLED = 60, 2e-6
SHIFT = math.degrees(1.0)  # mm of a shift that count as a radian: one mm as one degree
STILL = 1e-6  # entries of matrices that differ by less are those of one place
MOST_COORDINATES = 6  # OpenSim's function takes up to six coordinates

Ranges = dict[str, tuple[float, float]]
Row = dict[str, str | int | float]


@dataclass
class Samples:
    """Lengths and moment arms of a muscle, or of one of its fibres, at some poses; NaN at a pose
    that could not be solved.
    """

    muscle: str
    coordinates: tuple[str, ...]  # that the muscle depends on, full names
    values: np.ndarray  # (n, d) [radian or scene unit]
    lengths: np.ndarray  # (n,) [scene unit]
    arms: np.ndarray  # (n, d) [scene unit]
    unsettled: int = 0  # poses at which it had not settled after `MOST_SOLVES`


def sample_muscles(
    scene: Scene,
    given: Ranges,
    *,
    samples: int | None = None,
    fibres: int = 0,
    progress: Callable[[int, int], None] | None = None,
    found: list[Samples] | None = None,
) -> list[Samples]:
    """Return lengths and moment arms of every muscle at quasi-random poses of the coordinates that
    it depends on.

    The ``samples`` poses, `FOR_EACH` for each of the coordinates where not given, are gone through
    on a short tour, and the muscles settle at each. Where so many ``fibres`` are asked for, each of
    them is sampled in place of the muscle, by its name and the fibre's number. A moment arm is
    minus the central difference of the length over `STEP` to both sides, the muscle settling there
    too. Ranges that are ``given`` stand for the coordinates' own; one without extent holds its
    coordinate. ``progress`` is called with the poses that are done, and of how many. The samples
    are added to the list ``found``, after an interrupt those of the poses that are done.
    """
    scene = require_complete(scene).with_options({"output.fibres": fibres})
    scene.neighbours = None
    found = [] if found is None else found
    held = {name: low for name, (low, high) in given.items() if low == high}
    groups = _groups(scene, held)
    ranges = _ranges(scene, {name: None for names in groups for name in names}, given)
    counts = {names: samples or FOR_EACH * len(names) for names in groups}
    known = all_coordinates(scene.joints)
    done = 0
    for names, muscles in groups.items():
        part = scene.with_options()
        part.muscles = muscles
        box = {name: ranges[name] for name in names}
        values = _poses(list(box.values()), counts[names])
        rest = np.array([known[name].rest for name in names])
        order = _tour(values, rest, np.ptp(list(box.values()), axis=1))
        poses = [{**held, **dict(zip(names, values[k].tolist()))} for k in order]
        part.motion = Motion(poses)
        models = build_models(part)
        gauges = _Gauges(part, models)
        rows = {}
        try:
            fields = build_fields(part, _reached(part, poses, box))
            for place, row in zip(order, _measured(part, gauges, poses, names, fields)):
                rows[place] = row
                done += 1
                if progress is not None:
                    progress(done, sum(counts.values()))
        finally:
            places = sorted(rows)
            for k, name in enumerate(gauges.names if rows else ()):
                table = np.array([rows[place][k] for place in places])
                capped = int(table[:, -1].sum())
                found.append(
                    Samples(name, names, values[places], table[:, 0], table[:, 1:-1], capped)
                )
    return found


class _Gauges:
    """What is measured at a pose: the centrelines of muscles, or of all the fibres that were asked
    for.
    """

    def __init__(self, scene, models):
        self.scene = scene
        self.models = models
        self.bundles = build_bundles(scene, models)
        self.lines = {
            model.name: Centreline(scene.muscle(model.name), scene.joints, *model.material_mesh())
            for model in models
        }
        self.names = []
        self.counts = []  # gauges of each model
        for model in models:
            names = [model.name]
            if model.name in self.bundles:
                count = len(self.bundles[model.name].rest)
                names = [f"{model.name}_{k + 1}" for k in range(count)]
            self.names += names
            self.counts.append(len(names))

    def lengths(self, here):
        """Lengths (n,) where the models are now, at coordinates."""
        poses = bone_poses(self.scene, here)
        found = []
        for model in self.models:
            if model.name in self.bundles:
                for end in self.scene.muscle(model.name).tendons:
                    poses[end.name]  # its tendon is found when it is first asked for
                found += self.bundles[model.name].at(poses, poses.tendons).lengths.tolist()
            else:
                line = self.lines[model.name]
                belly = line.length(model.material_mesh()[0], poses)
                found.append(belly + line.tendon_length(poses.tendons))
        return np.array(found)


def _reached(scene, poses, ranges):
    """Regions of the bones that the muscles may reach on the way through poses and through the
    corners of the ranges, by muscle and bone.
    """
    corners = [poses[0] | dict(zip(ranges, ends)) for ends in itertools.product(*ranges.values())]
    stops = [*poses, *corners]
    regions: Regions = {}
    for start in range(0, len(stops), SAMPLED_POSES - 1):
        part = scene.with_options()
        # The next part begins where this one ends.
        part.motion = Motion(stops[start : start + SAMPLED_POSES])
        for key, box in find_contact_pairs(part).items():
            known = regions.get(key, box)
            regions[key] = np.stack([np.minimum(known[0], box[0]), np.maximum(known[1], box[1])])
    return regions


def _measured(scene, gauges, poses, names, fields):
    """For each pose and gauge: length, arm about each coordinate of ``names``, whether it did not
    settle.

    A pose is reached from the one before. Where that fails, from rest; where that fails too, it has
    no values.
    """
    rest = [model.snapshot() for model in gauges.models]
    loop = None
    for pose in poses:
        row = None if loop is None else _row(loop, gauges, pose, names)
        if row is None:
            for model, state in zip(gauges.models, rest):
                model.restore(state)
            loop = FrameLoop(scene, gauges.models, bone_sdfs=fields, surfaces=False)
            loop.activations.target = loop.activations.at(0)  # the same in all solves
            row = _row(loop, gauges, pose, names)
        if row is None:
            loop = None
            row = np.array([[np.nan] * (1 + len(names)) + [0.0]] * len(gauges.names))
        yield row


def _row(loop, gauges, pose, names):
    """Length and arms of the gauges at a pose, and whether they did not settle, (n, 2 + d); None
    where it cannot be solved.
    """
    for stepper in loop.steppers:
        stepper.events.clear()
    arms = []
    known = all_coordinates(loop.scene.joints)
    try:
        here = _settled(loop, gauges, pose)
        for name in names:
            value = pose[name]
            turns = known[name].motion != "translation"
            step = math.radians(STEP) if turns else from_mm(STEP, loop.scene.units)
            ends = [known[name].clamped_value(value + side * step) for side in (-1.0, 1.0)]
            below, above = (_settled(loop, gauges, {**pose, name: end}) for end in ends)
            arms.append(-(above - below) / (ends[1] - ends[0]))
    except SolveError:
        return None
    capped = [any(key[2] == "iteration_cap" for key in s.events) for s in loop.steppers]
    return np.stack([here, *arms, np.repeat(capped, gauges.counts)], axis=1)


def _settled(loop, gauges, pose):
    """Lengths (n,) when the muscles rest at a pose, or have had `MOST_SOLVES`: an event."""
    loop.skip(pose)
    with loop.working():
        each(lambda group: _settle(group, loop.here), loop.groups)
    return gauges.lengths(loop.here)


def _settle(group, here):
    """Solve a muscle, alone as neighbours are off, until it rests."""
    (stepper,) = group.steppers
    points = stepper.model.contact_points().copy()
    small = SETTLED * box_size(points)
    for _ in range(MOST_SOLVES):
        group.solve(dict(here))
        before, points = points, stepper.model.contact_points().copy()
        if np.abs(points - before).max() <= small:
            return
    stepper.report("", MOST_SOLVES, "iteration_cap")


def _poses(ranges, samples):
    """Sobol's points (n, d) within the ranges."""
    from scipy.stats import qmc

    # A power of two of them, as Sobol's points are balanced.
    points = qmc.Sobol(len(ranges), scramble=True, seed=0).random(1 << (samples - 1).bit_length())
    low, high = np.array(ranges).T
    return low + points[:samples] * (high - low)


def _tour(values, start, span):
    """The order (n,) of points (n, d) on a short way through all, from near ``start``: always to
    the nearest that is left, in shares of a ``span`` (d,).
    """
    places, here = values / span, start / span
    left = list(range(len(values)))
    order = []
    while left:
        nearest = int(np.argmin(((places[left] - here) ** 2).sum(axis=1)))
        order.append(left.pop(nearest))
        here = places[order[-1]]
    return order


def _groups(scene, held):
    """Muscles by the coordinates that they depend on, without those that are held; those of a group
    are sampled together.
    """
    known = all_coordinates(scene.joints)
    followers = {coupling.coordinate for coupling in scene.couplings}
    free = [name for name, fact in known.items() if name not in followers and not fact.locked]
    for name, value in held.items():
        if name not in free or known[name].clamped_value(value) != value:
            raise UsageError(
                f"{name} cannot be held there: it is locked, follows others or leaves its range"
            )
    free = [name for name in free if name not in held]
    groups = {}
    for muscle in scene.muscles:
        bones = sorted({bone for attachment in muscle.attachments for bone in attachment.bones})
        needed = tuple(name for name in free if _moves(scene, bones, name))
        if not 1 <= len(needed) <= MOST_COORDINATES:
            raise SceneError(
                f"muscle {muscle.name!r} depends on {len(needed)} coordinates "
                f"({', '.join(needed)}); OpenSim takes "
                f"1 to {MOST_COORDINATES}: hold some, or lock them in the scene"
            )
        groups.setdefault(needed, []).append(muscle)
    return groups


def _moves(scene, bones, name):
    """Whether a coordinate moves some bones against each other, from where all others rest."""
    fact, places = all_coordinates(scene.joints)[name], []
    for value in (fact.rest, fact.rest + 0.1, fact.rest - 0.1):
        poses = bone_poses(scene, {name: fact.clamped_value(value)})
        back = np.linalg.inv(poses[bones[0]])
        places.append([back @ poses[bone] for bone in bones])
    return np.ptp(np.array(places), axis=0).max() > STILL


def _ranges(scene, names, given):
    """The range of each coordinate: as given, its own, or what the motion covers; UsageError that
    names all that have none.
    """
    for name in [name for name, (low, high) in given.items() if low < high and name not in names]:
        raise UsageError(
            f"range of {name}: none of the muscles depends on it, or it is locked or follows others"
        )
    found = {}
    known = all_coordinates(scene.joints)
    for name in names:
        moved = [frame[name] for frame in scene.motion.frames if name in frame]
        covered = min(moved, default=0.0), max(moved, default=0.0)
        for ends in (given.get(name), known[name].range, covered):
            if name not in found and ends is not None and ends[0] < ends[1]:
                found[name] = tuple(known[name].clamped_value(end) for end in ends)
                if found[name][0] == found[name][1]:
                    raise UsageError(
                        f"range of {name}: it lies outside the range that clamps the coordinate"
                    )
    missing = [name for name in names if name not in found]
    if missing:
        raise UsageError(
            f"without a range: {', '.join(missing)}; give each LOW:HIGH, or a value that it holds"
        )
    return found


def paths_folder(directory: Path) -> OutputFolder:
    """The folder of fitted paths; UsageError if something in it is in the way."""
    return OutputFolder(directory, "paths", ("paths.xml", "errors.csv"))


def fittable(found: Samples) -> bool:
    """Whether there are poses enough to fit a path, and to tell how well it holds."""
    use, out = _parts(found)
    return use.sum() >= 2 * (len(found.coordinates) + 1) and bool(out.any())


def _parts(found):
    """Which poses (n,) are fitted, and which are held out, of those that could be solved."""
    solved = np.isfinite(found.lengths) & np.isfinite(found.arms).all(axis=1)
    held = np.arange(len(solved)) % HELD_OUT == HELD_OUT - 1
    return solved & ~held, solved & held


def report_fits(
    scene: Scene,
    sampled: list[Samples],
    directory: Path,
    *,
    targets: Mapping[str, str] | None = None,
) -> tuple[list[Row], list[str]]:
    """Fit every muscle and write the files; how well the fits hold where they were not made, as
    rows of ``errors.csv`` and as lines.

    ``targets`` are those of `write_paths`.
    """
    fitted = []
    lines = []
    errors = []
    unit = scene.units
    turning = {name: f.motion != "translation" for name, f in all_coordinates(scene.joints).items()}
    for found in sampled:
        radian = [1.0 if turning[name] else from_mm(SHIFT, unit) for name in found.coordinates]
        path, row = _fit(found, np.array(radian))
        fitted.append(path)
        errors.append(row)
        lines.append(
            f"{path.muscle}: order {path.order} in {', '.join(path.coordinates)}; "
            f"{row['held_out']} poses held out: "
            f"length {row['length_rms']:.3g} {unit} RMS, {row['length_max']:.3g} at most; "
            f"arms {row['arm_rms']:.3g} {unit} RMS, {row['arm_max']:.3g} at most"
            + (", not good: more than 1 mm" if row["arm_rms"] > from_mm(GOOD, unit) else "")
            + (f"; {row['failed']} poses could not be solved" if row["failed"] else "")
            + (f"; at {found.unsettled} poses it did not settle" if found.unsettled else "")
        )
    with paths_folder(directory).staged() as stage:
        write_paths(stage / "paths.xml", fitted, from_mm(1000.0, unit), turning, targets or {})
        write_csv(stage / "errors.csv", [list(errors[0]), *(list(row.values()) for row in errors)])
    lines.append(
        f"{directory / 'paths.xml'}: {len(fitted)} paths; OpenSim puts them in by their names, "
        "/forceset/MUSCLE"
    )
    return errors, lines


def _fit(found, radian):
    """The path of a muscle, and its errors at poses not fitted, arms over a ``radian`` (d,)."""
    use, out = _parts(found)
    count = len(found.lengths)
    failed = count - int(use.sum() + out.sum())
    if not fittable(found):
        raise SolveError(
            f"muscle {found.muscle!r}: {failed} of {count} poses failed, too few are left to fit"
        )
    parts = (found.values[use], found.lengths[use], found.arms[use])
    path = fit_path(found.muscle, found.coordinates, *parts, radian=radian)
    row = {
        "muscle": path.muscle,
        "order": path.order,
        "fitted": int(use.sum()),
        "failed": failed,
        "held_out": int(out.sum()),
        "unsettled": found.unsettled,
    }
    length = path.length(found.values[out]) - found.lengths[out]
    arm = radian * (path.arms(found.values[out]) - found.arms[out])
    for name, error in {"length": length, "arm": arm}.items():
        row |= {
            f"{name}_rms": float(np.sqrt(np.mean(error**2))),
            f"{name}_max": float(np.abs(error).max()),
        }
    return path, row


ARM_WEIGHT = 1.0 / 3.0  # one mm of a length weighs as much as this many mm/rad of a moment arm
FOLDS = 5  # parts of the poses that are left out in turn to choose the order


@dataclass(frozen=True)
class FittedPath:
    """A polynomial for a muscle's length over coordinates (full names); minus its derivatives are
    the moment arms.

    ``order`` is the largest sum of exponents; ``coefficients`` are those of the terms in
    `exponents`, for coordinates in radians or scene units [scene unit].
    """

    muscle: str
    coordinates: tuple[str, ...]
    order: int
    coefficients: np.ndarray

    def length(self, values: np.ndarray) -> np.ndarray:
        """Length (n,) at coordinates (n, d)."""
        return _rows(values, self.order)[0] @ self.coefficients

    def arms(self, values: np.ndarray) -> np.ndarray:
        """Moment arms (n, d) at coordinates (n, d)."""
        return (_rows(values, self.order)[1:] @ self.coefficients).T


def _rows(values, order):
    """Terms (1 + d, n, m) of the length, then of the moment arm of each coordinate."""
    values = np.asarray(values, dtype=float)
    powers = exponents(values.shape[1], order)
    rows = [np.prod(values[:, None, :] ** powers, axis=2)]
    for axis in range(values.shape[1]):
        lower = np.maximum(powers - np.eye(values.shape[1], dtype=int)[axis], 0)
        rows.append(-powers[:, axis] * np.prod(values[:, None, :] ** lower, axis=2))
    return np.array(rows)


def fit_path(
    muscle: str,
    coordinates: tuple[str, ...],
    values: np.ndarray,
    lengths: np.ndarray,
    arms: np.ndarray,
    *,
    radian: np.ndarray | None = None,
) -> FittedPath:
    """Fit a polynomial to lengths (n,) and, by its derivatives, to moment arms (n, d).

    ``values`` (n, d) are the coordinates [radian or scene unit], of which ``radian`` (d,), 1 by
    default, weighs as much as one radian, whatever the scene's unit. The order, at most
    `HIGHEST_ORDER`, is the one whose fit without a fifth of the poses, each in turn, errs least
    there; there are always more equations than terms.
    """
    count, dimension = values.shape
    weights = np.r_[1.0, ARM_WEIGHT * (np.ones(dimension) if radian is None else radian)][:, None]
    wanted = weights * np.vstack([lengths, arms.T])
    group, best = np.arange(count) % FOLDS, (np.inf, 1, np.empty(0))
    for order in range(1, HIGHEST_ORDER + 1):
        if order > 1 and 1.5 * len(exponents(dimension, order)) > 0.8 * count * (1 + dimension):
            break
        rows = weights[:, :, None] * _rows(values, order)
        error = 0.0
        for fold in range(FOLDS):
            out = group == fold
            left_out = rows[:, out] @ _solve(rows[:, ~out], wanted[:, ~out])
            error += np.sum((left_out - wanted[:, out]) ** 2)
        if error < best[0]:
            best = (error, order, _solve(rows, wanted))
    return FittedPath(muscle, coordinates, *best[1:])


def _solve(rows, wanted):
    """Coefficients by least squares; columns are scaled, as powers of coordinates differ by orders
    of magnitude.
    """
    matrix = rows.reshape(-1, rows.shape[2])
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    return np.linalg.lstsq(matrix / size, wanted.ravel(), rcond=None)[0] / size


def write_paths(
    file: Path,
    fitted: list[FittedPath],
    metre: float,
    turning: dict[str, bool],
    targets: Mapping[str, str],
) -> None:
    """Write paths as the set of ``FunctionBasedPath`` that OpenSim loads.

    ``metre`` is its length in scene units; ``turning`` says which coordinates are no shifts, which
    are in metres there. ``targets`` are the paths of coordinates in the OpenSim model; the others
    have the names of the scene.
    """
    add = ElementTree.SubElement
    root = ElementTree.Element("OpenSimDocument", Version="40600")
    paths = add(root, "Set_FunctionBasedPath_")
    objects = add(paths, "objects")
    add(paths, "groups")
    for path in fitted:
        units = np.array([1.0 if turning[name] else metre for name in path.coordinates])
        powers = exponents(len(path.coordinates), path.order)
        numbers = path.coefficients * np.prod(units**powers, axis=1) / metre
        item = add(objects, "FunctionBasedPath", name=f"/forceset/{path.muscle}")
        function = add(add(item, "length_function"), "MultivariatePolynomialFunction")
        own = {name: "/jointset/" + name.replace(".", "/", 1) for name in path.coordinates}
        names = [targets.get(name, own[name]) for name in path.coordinates]
        add(item, "coordinate_paths").text = " ".join(names)
        add(function, "coefficients").text = " ".join(repr(float(value)) for value in numbers)
        add(function, "dimension").text = str(len(path.coordinates))
        add(function, "order").text = str(path.order)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(file, encoding="UTF-8", xml_declaration=True)
