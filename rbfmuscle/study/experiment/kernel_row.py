"""One row of a kernel study: a kernel, its shape parameter chosen, its centres fitted, its surface measured."""

from __future__ import annotations

import time
import warnings
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit import shape_search
from rbfmuscle.implicit.extraction.sheets import FINER, count_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import DOUBTFUL
from rbfmuscle.implicit.kernels.table import Kernel, get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import SurfaceSample
from rbfmuscle.implicit.selection import WITHIN, spacing, surface_miss
from rbfmuscle.implicit.shape_search import Limits
from rbfmuscle.implicit.surface_epsilon import choose_surface_epsilon
from rbfmuscle.study.experiment.kernel_choice import SOUND
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge
from rbfmuscle.study.experiment.workers import threads_limited
from rbfmuscle.validation import NumericalWarning

# Seconds of both searches of one kernel together, the second for the fitted centres.
SECONDS = 4.5
# Points of one timed evaluation, and the processor time after which enough of them, or of fits, are made [s].
TIMED, MEASURED = 20_000, 0.05


class Request(NamedTuple):
    """What is asked of every kernel."""

    derivatives: str
    criterion: str
    placement: str
    condition: float


class Measured(NamedTuple):
    """What one row found.

    Attributes
    ----------
    row : dict
        As in `KernelStudy.rows`, without times.
    surface : tuple or None
        Vertices, faces, and the vertices' signed distances from the mesh.
    sample : SurfaceSample
        The centres that were fitted.
    tried : list of dict
        As in `KernelStudy.scan`.
    """

    row: dict[str, Any]
    surface: tuple[Floats, Integers, Floats] | None
    sample: SurfaceSample
    tried: list[dict[str, Any]]


def _fit(sample, kernel, row, derivatives):
    return RBFField.fit_surface(
        sample.points, sample.normals, kernel=kernel, epsilon=row["epsilon"] or 1.0, derivatives=derivatives,
        condition=row["bound"] or np.inf,
    )  # fmt: skip


def _choose(row, judge, sample, kernel, ask, *, last):
    """Choose epsilon for these centres and write it into the row; the choice, for the map."""
    start = shape_search.CLOCK()
    # What is only to place centres needs none of the slow fits.
    limits = Limits(seconds=max(SECONDS - row["search_time"], 0.5), condition=ask.condition, doubt=1.0)
    if not last:
        limits.slow, limits.scan = 0, 13
    asked = {
        "kernel": kernel, "criterion": ask.criterion, "derivatives": ask.derivatives, "held_out": judge.held_out,
        "distance": judge.distance.unsigned if last else None,
    }  # fmt: skip
    choice = choose_surface_epsilon(sample.points, sample.normals, limits=limits, **asked)
    spent = limits.spent if ask.criterion == "held_out" else len(choice.tried)
    bound = min(SOUND, ask.condition)
    # flat kernels with a ridge have fewer sheets of their own, and may err as little as without
    if last and kernel.hermite and (choice.broken or choice.condition > bound):
        left = SECONDS - row["search_time"] - (shape_search.CLOCK() - start)
        limits = Limits(seconds=max(left, 0.5), slow=0, scan=13, bound=bound)
        with suppress(np.linalg.LinAlgError):  # then what broke without a bound is the reason that is told
            bounded = choose_surface_epsilon(sample.points, sample.normals, limits=limits, **asked)
            if not bounded.broken and (choice.broken or bounded.objective <= WITHIN * choice.objective):
                choice, row["bound"] = bounded, bound
        spent += limits.spent
    row["epsilon"] = choice.epsilon
    row["shape"] = float(choice.epsilon * spacing(sample.points).mean())
    row["fits"] += spent
    row["search_time"] += shape_search.CLOCK() - start
    if choice.stopped:
        row["note"] = f"{row['note']}; search stopped after {choice.stopped}".lstrip("; ")
    return choice


def measure_row(
    judge: SurfaceJudge,
    sample: SurfaceSample,
    kernel: Kernel,
    ask: Request,
    *,
    confirm: SurfaceJudge | None = None,
) -> Measured:
    """One row of the table, its times left open, and its surface.

    Parameters
    ----------
    judge : SurfaceJudge
    sample : SurfaceSample
        Of as many centres.
    kernel : Kernel
    ask : Request
    confirm : SurfaceJudge, optional
        Measures the row in place of the judge, which then only chooses.
    """
    count, placement, looked, tried = len(sample.points), ask.placement, False, []
    if placement == FITTED and not (kernel.hermite and ask.derivatives == "all"):
        placement = "greedy"
    row = {
        "kernel": kernel.name, "centres": count, "placement": placement, "epsilon": 0.0, "placed": 0.0, "shape": None,
        "fit": ask.derivatives if kernel.hermite else "values", "rms": None, "low": None, "high": None,
        "hausdorff": None, "worst": [], "normal_error": None, "volume_error": None,
        "components": None, "spurious": None, "condition": None, "bound": 0.0, "solved": None,
        "fit_time": None, "evaluation_time": None, "fits": 0, "search_time": 0.0,
        "numbers": _stored(kernel, ask.derivatives, count),
        "note": "" if kernel.hermite else "values on and off the surface, the kernel is not C2",
    }  # fmt: skip
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", NumericalWarning)
        try:
            if placement == FITTED:
                if kernel.has_epsilon:
                    _choose(row, judge, sample, kernel, ask, last=False)
                row["placed"] = row["epsilon"]
                sample = fit_sample(
                    sample, judge.vertices, judge.faces, kernel=kernel, epsilon=row["epsilon"] or 1.0
                )
            if kernel.has_epsilon:  # what was best for the greedy centres need not be so for these
                choice = _choose(row, judge, sample, kernel, ask, last=True)
                tried = _trials(row, choice)
                if choice.broken:
                    raise ValueError(choice.broken)
                looked = ask.criterion == "held_out" and judge.sheets == 1
            looked |= _bound(row, judge, sample, kernel, ask)
            surface = _fill_row(row, confirm or judge, sample, kernel, ask.derivatives, looked=looked)
        except (ValueError, np.linalg.LinAlgError) as error:
            row["note"], surface = " ".join(str(error).split()), None
    if said and surface is not None:
        row["note"] = "; ".join([*([row["note"]] if row["note"] else []), str(said[-1].message)])
    return Measured(row, surface, sample, tried)


def _bound(row, judge, sample, kernel, ask):
    """Bound the condition by a ridge where that costs no more than 2 % of the error, or where it is asked for.

    Whether it is bounded; its sheets are then looked at and as many as they should be.
    """
    if not kernel.hermite or row["bound"]:
        return False
    plain, bound = _fit(sample, kernel, row, ask.derivatives), min(SOUND, ask.condition)
    if plain.condition <= bound:
        return False
    reach = spacing(sample.points).mean()
    try:
        with_ridge = _fit(sample, kernel, row | {"bound": bound}, ask.derivatives)
    except np.linalg.LinAlgError:
        return False  # the row has its fit without
    missed = [surface_miss(field, judge.held_out, reach) for field in (plain, with_ridge)]
    if missed[1] > WITHIN * missed[0] and plain.condition <= ask.condition:
        return False
    if not count_sheets(with_ridge, sample.points, judge.distance.unsigned, wanted=judge.sheets).sound(
        judge.sheets
    ):
        return False
    row["bound"] = bound
    return True


def _trials(row, choice):
    """What the search tried, by epsilon times the spacing."""
    unit = row["shape"] / choice.epsilon
    return [
        {"kernel": row["kernel"], "centres": row["centres"], "shape": epsilon * unit, "error": error,
         "condition": condition}
        for epsilon, error, condition in choice.tried.tolist()
    ]  # fmt: skip


def time_row(row: dict[str, Any], sample: SurfaceSample, derivatives: str, points: Floats) -> None:
    """Write what a fit, and the values at 20,000 points, cost into a row [s of processor time, one thread].

    Parameters
    ----------
    row : dict
    sample : SurfaceSample
        The centres that were fitted.
    derivatives : str
    points : (n, 3) ndarray
        Of the mesh [length].
    """
    kernel = get_kernel(row["kernel"])
    with warnings.catch_warnings(), threads_limited(1):
        warnings.simplefilter("ignore", NumericalWarning)  # it stands in the row's note
        try:
            fitted = _fit(sample, kernel, row, derivatives)
        except np.linalg.LinAlgError as error:  # at the edge: it could be solved when it was measured
            row["unfit"] = " ".join(str(error).split())
            return
        row["fit_time"] = _spent(lambda: _fit(sample, kernel, row, derivatives))
        fitted(points[:TIMED])
        row["evaluation_time"] = _spent(lambda: fitted(points[:TIMED]))


def _spent(work):
    """Processor time of some work, done as often as a coarse clock needs [s]."""
    start, runs = time.process_time(), 0
    while runs == 0 or time.process_time() - start < MEASURED:
        work()
        runs += 1
    return (time.process_time() - start) / runs


def _fill_row(
    row: dict[str, Any],
    judge: SurfaceJudge,
    sample: SurfaceSample,
    kernel: Kernel,
    derivatives: str,
    *,
    looked: bool = False,
) -> tuple[Floats, Integers, Floats]:
    """Fit with the row's epsilon and write what is measured into the row; the surface and its signed distances.

    Parameters
    ----------
    row : dict
    judge : SurfaceJudge
    sample : SurfaceSample
    kernel : Kernel
    derivatives : str
    looked : bool
        Whether the search has looked for sheets and found as many as there should be.
    """
    fitted = _fit(sample, kernel, row, derivatives)
    row["condition"] = float(fitted.condition)
    ridge = "Cholesky with a ridge" if row["bound"] else "Cholesky"
    row["solved"] = "eigenvectors" if fitted.condition >= DOUBTFUL else ridge
    gradient = fitted.gradient(judge.points[::5])
    cosine = np.einsum("ij,ij->i", gradient, judge.normals[::5])
    cosine /= np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(float).tiny)
    row["normal_error"] = float(np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2).mean())))
    found, sheets = _surface_and_sheets(fitted, judge, sample, looked)
    row["components"], row["spurious"] = sheets, max(sheets - judge.sheets, 0)
    row["volume_error"] = found.volume / judge.volume - 1.0
    rms, greatest, error, interval = judge.apart(found.vertices, found.faces)
    row["worst"] = judge.worst(found, sample.points)
    # a field of slope one by the mesh's own normals: outside is where the nearest triangle looks
    error = np.copysign(error, judge.distance.signed(found.vertices))
    if row["spurious"]:
        row["note"] = f"{row['spurious']} spurious sheets; {row['note']}".rstrip("; ")
    row["rms"], row["hausdorff"], (row["low"], row["high"]) = rms, greatest, interval  # last: it is whole
    return found.vertices, found.faces, error


def _surface_and_sheets(fitted, judge, sample, looked):
    """The extracted surface, and how many sheets the field has."""
    sheets = judge.sheets
    if not looked:
        seen = count_sheets(fitted, sample.points, judge.distance.unsigned, wanted=sheets)
        if seen.is_open and seen.number <= sheets:
            raise ValueError("the level set is open: it leaves the box of the muscle; take more centres")
        sheets = seen.number
    try:
        found = extract_surface(fitted, points=sample.points, resolution=judge.resolution)
    except ValueError as error:
        if sheets > judge.sheets:
            raise ValueError(f"{sheets} sheets where the mesh has {judge.sheets}") from error
        raise
    if found.components > sheets:  # these cells alone show them: sheets of its own, or pieces of a thin rim
        seen = count_sheets(
            fitted, sample.points, judge.distance.unsigned, boxes=(FINER,), wanted=judge.sheets
        )
        sheets = max(sheets, seen.number)
    return found, sheets


def _stored(kernel, derivatives, count):
    """Numbers that a field takes: positions, weights, and normals where the weights act along them."""
    if not kernel.hermite:
        return 3 * count * 4
    return count * (7 if derivatives == "all" else 8)
