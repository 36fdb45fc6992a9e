"""Which kernel, which shape parameter, how many centres: one surface fitted by all of them, and a table.

Accuracy, conditioning, time and data size are measured together, since each can be bought with the others.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.implicit import shape_search
from rbfmuscle.implicit.extraction.sheets import FINER, count_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import DOUBTFUL
from rbfmuscle.implicit.kernels.table import KERNELS, Kernel, get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import PLACEMENTS, SurfaceSample, sample_surface
from rbfmuscle.implicit.selection import WITHIN, spacing, surface_miss
from rbfmuscle.implicit.shape_search import Limits
from rbfmuscle.implicit.surface_epsilon import choose_surface_epsilon
from rbfmuscle.study.experiment.kernel_choice import SOUND, Recommendation, mark_unfit, recommend
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge
from rbfmuscle.study.experiment.sweep_table import pareto_front
from rbfmuscle.validation import NumericalWarning, UsageError, check_mesh

CENTRES = (150, 300)
# Seconds of both searches of one kernel together, the second for the fitted centres.
SECONDS = 4.5
# Points of one timed evaluation, and how often fit and evaluation are timed.
TIMED, REPEATS = 20_000, 3


@dataclass
class KernelStudy:
    """What `study_kernels` found.

    Attributes
    ----------
    rows : list of dict
        One for each kernel and number of centres, the smallest error first; unfit ones (``unfit`` says why) last.
    scan : list of dict
        ``kernel, centres, shape`` (epsilon times the spacing), ``error, condition`` of all that the search tried.
    decimated : dict of int to dict
        For each number of stored numbers, the decimated mesh that takes as many: ``vertices, rms, hausdorff``.
    surfaces : list of (vertices, faces, error)
        Of the rows, in their order, the error signed, positive outside the mesh; None where there is none.
    units : str
    recommended : Recommendation or None
        The row to take and why; None where every one is unfit.
    """

    rows: list
    scan: list = field(default_factory=list)
    decimated: dict = field(default_factory=dict)
    surfaces: list = field(default_factory=list)
    units: str = ""
    recommended: Recommendation | None = None

    def toml(self, row: dict[str, Any]) -> str:
        """The lines of a scene file's model table that give this row."""
        lines = [
            "[muscle.model]",
            'name = "rbf"',
            f'kernel = "{row["kernel"]}"',
            f"centres = {row['centres']}",
        ]
        if row["epsilon"]:
            lines.append(f"epsilon = {row['epsilon']:.6g}")
        if row["bound"]:
            lines.append(f"condition = {row['bound']:g}")
        if row["fit"] != "values":
            lines.append(f'derivatives = "{row["fit"]}"')
        lines.append(f'placement = "{row["placement"]}"')
        return "\n".join(lines)


def study_kernels(
    mesh: MeshLike,
    *,
    kernels: Sequence[str] | None = None,
    centres: Sequence[int] = CENTRES,
    derivatives: str = "all",
    placement: str = FITTED,
    resolution: int = 0,
    criterion: str = "held_out",
    condition: float = np.inf,
    seed: int = 0,
    units: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> KernelStudy:
    """Fit a surface with many kernels and numbers of centres, and measure each fit.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    kernels : list of str, optional
        All by default.
    centres : sequence of int
    derivatives : {"all", "normal"}
        Of Hermite fits; kernels that are not smooth enough are fitted to values on and off the surface.
    placement : {"even", "adaptive", "greedy", "fitted"}
        Fitted centres lie beside the surface, so that the whole of it is met in the least-squares sense
        (`fit_centres`); for Hermite fits to all derivatives, greedy ones for the others.
    resolution : int
        Cells along the longest side of the extracted surfaces; as many as a muscle so slender needs by default.
    criterion : {"held_out", "loo", "gcv", "condition"}
        How epsilon is chosen: by the error at other points of the mesh, or from the centres alone.
    condition : float
        No epsilon beyond it is chosen, and a ridge keeps it in fits to normals; others beyond it are unfit.
    seed : int
    units : str
        Name of the mesh's unit, for the page.
    progress : callable, optional
        Called as ``progress(done, total)``.

    Returns
    -------
    KernelStudy

    Raises
    ------
    UsageError
        On an unknown kernel or placement, or a number of centres below 8.
    MeshError
        On an unusable mesh.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> study = study_kernels(ball, kernels=["cubic"], centres=[40], placement="even", resolution=16)
    >>> study.rows[0]["kernel"]
    'cubic'
    """
    vertices, faces = check_mesh(*(mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)))
    kernels = [get_kernel(name) for name in (kernels or KERNELS)]
    if placement not in (*PLACEMENTS, FITTED):
        raise UsageError(f"placement must be one of {', '.join((*PLACEMENTS, FITTED))}, got {placement!r}")
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    if not condition >= 1.0:
        raise UsageError(f"condition must be a bound of at least 1, got {condition:g}")
    judge = SurfaceJudge(vertices, faces, resolution, seed)
    study, found = KernelStudy([], units=units), []
    ask = Request(derivatives, criterion, placement, float(condition))
    total = len(kernels) * len(centres)
    for count in centres:
        base = "greedy" if placement == FITTED else placement
        sample = sample_surface(vertices, faces, int(count), seed=seed, placement=base)
        for kernel in kernels:
            found.append(measure_row(judge, sample, kernel, ask, study.scan))
            if progress is not None:
                progress(len(found), total)
    mark_unfit([row for row, _ in found], sheets=judge.sheets, condition=condition)
    found.sort(key=lambda pair: (bool(pair[0]["unfit"]), pair[0]["rms"] is None, pair[0]["rms"] or 0.0))
    study.rows, study.surfaces = [row for row, _ in found], [surface for _, surface in found]
    for row in study.rows:
        numbers = row["numbers"]
        if numbers not in study.decimated:
            study.decimated[numbers] = judge.decimated(numbers)
        row["decimated_rms"] = study.decimated[numbers]["rms"]
    _mark_fronts(study.rows)
    study.recommended = recommend(study.rows)
    return study


def _mark_fronts(rows):
    """Mark what no other row beats both in error and in time (or in size)."""
    good = [row for row in rows if not row["unfit"]]
    for row in rows:
        row["front_time"] = row["front_size"] = False
    if not good:
        return
    errors = np.array([row["rms"] for row in good])
    times = np.array([row["fit_time"] + row["evaluation_time"] for row in good])
    for name, cost in (("front_time", times), ("front_size", np.array([float(r["numbers"]) for r in good]))):
        for index in pareto_front(errors, cost):
            good[index][name] = True


def _fit(sample, kernel, row, derivatives):
    return RBFField.fit_surface(
        sample.points, sample.normals, kernel=kernel, epsilon=row["epsilon"] or 1.0, derivatives=derivatives,
        condition=row["bound"] or np.inf,
    )  # fmt: skip


class Request(NamedTuple):
    """What is asked of every kernel."""

    derivatives: str
    criterion: str
    placement: str
    condition: float


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
    if choice.broken and kernel.hermite:  # flat kernels with a ridge have fewer sheets of their own
        left = SECONDS - row["search_time"] - (shape_search.CLOCK() - start)
        limits = Limits(seconds=max(left, 0.5), slow=0, scan=13, bound=min(SOUND, ask.condition))
        with suppress(np.linalg.LinAlgError):  # then what broke without a bound is the reason that is told
            bounded = choose_surface_epsilon(sample.points, sample.normals, limits=limits, **asked)
            if not bounded.broken:
                choice, row["bound"] = bounded, limits.bound
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
    scan: list[dict[str, Any]],
    *,
    confirm: SurfaceJudge | None = None,
) -> tuple[dict[str, Any], Any]:
    """One row of the table and its surface (vertices, faces, distances) or None.

    Parameters
    ----------
    judge : SurfaceJudge
    sample : SurfaceSample
        Of as many centres.
    kernel : Kernel
    ask : Request
    scan : list
        Takes what the search tried.
    confirm : SurfaceJudge, optional
        Measures the row in place of the judge, which then only chooses.
    """
    count, placement, looked = len(sample.points), ask.placement, False
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
                _note_trials(scan, row, choice)
                if choice.broken:
                    raise ValueError(choice.broken)
                looked = ask.criterion == "held_out" and judge.sheets == 1
            looked |= _bound(row, judge, sample, kernel, ask)
            surface = fill_row(row, confirm or judge, sample, kernel, ask.derivatives, looked=looked)
        except (ValueError, np.linalg.LinAlgError) as error:
            row["note"], surface = " ".join(str(error).split()), None
    if said and surface is not None:
        row["note"] = "; ".join([*([row["note"]] if row["note"] else []), str(said[-1].message)])
    return row, surface


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


def _note_trials(scan, row, choice):
    for epsilon, error, condition in choice.tried.tolist():
        shape = epsilon * row["shape"] / choice.epsilon
        scan.append({"kernel": row["kernel"], "centres": row["centres"], "shape": shape, "error": error,
                     "condition": condition})  # fmt: skip


def fill_row(
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
    spent = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        fitted = _fit(sample, kernel, row, derivatives)
        middle = time.perf_counter()
        fitted(judge.points[:TIMED])
        spent.append((middle - start, time.perf_counter() - middle))
    # The least, as the first may compile.
    row["fit_time"], row["evaluation_time"] = (float(t) for t in np.min(spent, axis=0))
    row["condition"] = float(fitted.condition)
    ridge = "Cholesky with a ridge" if row["bound"] else "Cholesky"
    row["solved"] = "eigenvectors" if fitted.condition >= DOUBTFUL else ridge
    gradient = fitted.gradient(judge.points[::5])
    cosine = np.einsum("ij,ij->i", gradient, judge.normals[::5])
    cosine /= np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(float).tiny)
    row["normal_error"] = float(np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2).mean())))
    sheets = judge.sheets
    if not looked:
        seen = count_sheets(fitted, sample.points, judge.distance.unsigned, wanted=sheets)
        if seen.is_open and seen.number <= sheets:
            raise ValueError("the level set is open: it leaves the box of the muscle; take more centres")
        sheets = seen.number
    found = extract_surface(fitted, points=sample.points, resolution=judge.resolution)
    if found.components > sheets:  # these cells alone show them: sheets of its own, or pieces of a thin rim
        seen = count_sheets(
            fitted, sample.points, judge.distance.unsigned, boxes=(FINER,), wanted=judge.sheets
        )
        sheets = max(sheets, seen.number)
    row["components"], row["spurious"] = sheets, max(sheets - judge.sheets, 0)
    row["volume_error"] = found.volume / judge.volume - 1.0
    row["rms"], row["hausdorff"], error, (row["low"], row["high"]) = judge.apart(found.vertices, found.faces)
    row["worst"] = judge.worst(found, sample.points)
    # a field of slope one by the mesh's own normals: outside is where the nearest triangle looks
    error = np.copysign(error, judge.distance.signed(found.vertices))
    if row["spurious"]:
        row["note"] = f"{row['spurious']} spurious sheets; {row['note']}".rstrip("; ")
    return found.vertices, found.faces, error


def _stored(kernel, derivatives, count):
    """Numbers that a field takes: positions, weights, and normals where the weights act along them."""
    if not kernel.hermite:
        return 3 * count * 4
    return count * (7 if derivatives == "all" else 8)
